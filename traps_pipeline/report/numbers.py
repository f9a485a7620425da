"""Parse printed numbers, for files that other programs read."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

NONE = "–"  # a cell without a number
_PRINTED_NUMBER = re.compile(r"([+−-]?(?:\d+(?:\.\d*)?|\.\d+))(%?)")


def as_numbers(values: pd.Series) -> pd.Series:
    """Return a printed column as numbers, a dash as missing; text stays unchanged.

    A number in percent stays in percent in a field whose name ends in `_pct`, and becomes a fraction in any other.
    """
    import pandas as pd

    texts = [None if value is None or value != value or value in ("", NONE) else str(value) for value in values]
    matches = [_PRINTED_NUMBER.fullmatch(text) for text in texts if text is not None]
    if not matches or not all(matches) or len({match[2] for match in matches if match}) > 1:
        return values
    scale = 100.0 if matches[0] and matches[0][2] and not str(values.name).endswith("_pct") else 1.0
    numbers = [None if t is None else float(t.removesuffix("%").replace("−", "-")) / scale for t in texts]
    are_integers = scale == 1.0 and all(number is None or number.is_integer() for number in numbers)
    return pd.Series(numbers, values.index, "Int64" if are_integers and None not in numbers else "Float64", values.name)
