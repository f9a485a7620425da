# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
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
