# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

class _KappaResults:
    kappa: float
    kappa_low: float
    kappa_upp: float

def aggregate_raters(data: ArrayLike, n_cat: int | None = None) -> tuple[np.ndarray, np.ndarray]: ...
def cohens_kappa(table: ArrayLike, weights: ArrayLike | None = None) -> _KappaResults: ...
def fleiss_kappa(table: ArrayLike, method: Literal["fleiss", "randolph"] = "fleiss") -> float: ...
