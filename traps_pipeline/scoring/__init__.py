"""From the panel's verdicts to figures with intervals (docs/spec.md 5)."""

from typing import Any

# A pandas.DataFrame. pandas' own annotations make any selection of one a Series or a DataFrame, whatever is selected.
Frame = Any
