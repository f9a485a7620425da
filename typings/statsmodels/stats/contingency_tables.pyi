# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
from numpy.typing import ArrayLike

class _TestResults:
    statistic: float
    pvalue: float

def mcnemar(table: ArrayLike, exact: bool = True, correction: bool = True) -> _TestResults: ...
