# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
import numpy as np
from numpy.typing import ArrayLike

def cho_solve(
    c_and_lower: tuple[np.ndarray, bool], b: ArrayLike, overwrite_b: bool = False, check_finite: bool = True
) -> np.ndarray: ...
