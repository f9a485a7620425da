# The names that this project uses, with their types: to infer them from the source takes pyright minutes.
import numpy as np
from numpy.typing import ArrayLike

def multipletests(
    pvals: ArrayLike,
    alpha: float = 0.05,
    method: str = "hs",
    maxiter: int = 1,
    is_sorted: bool = False,
    returnsorted: bool = False,
) -> tuple[np.ndarray, np.ndarray, float, float]: ...
