# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
from typing import overload

import numpy as np
from numpy.typing import ArrayLike

@overload
def proportion_confint(
    count: float, nobs: float, alpha: float = 0.05, method: str = "normal", alternative: str = "two-sided"
) -> tuple[float, float]: ...
@overload
def proportion_confint(
    count: ArrayLike, nobs: ArrayLike, alpha: float = 0.05, method: str = "normal", alternative: str = "two-sided"
) -> tuple[np.ndarray, np.ndarray]: ...
