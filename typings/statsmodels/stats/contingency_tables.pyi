# The names that this project uses, with their types: to infer them from the source takes pyright minutes.
from numpy.typing import ArrayLike

class _TestResults:
    statistic: float
    pvalue: float

def mcnemar(table: ArrayLike, exact: bool = True, correction: bool = True) -> _TestResults: ...
