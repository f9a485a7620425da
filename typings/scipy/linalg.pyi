# The names that this project uses, with their types: to infer them from the source takes pyright minutes.
import numpy as np
from numpy.typing import ArrayLike

def cho_solve(
    c_and_lower: tuple[np.ndarray, bool], b: ArrayLike, overwrite_b: bool = False, check_finite: bool = True
) -> np.ndarray: ...
