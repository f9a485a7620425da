# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, _Classifier

class Pipeline(_Classifier):
    steps: list[tuple[str, BaseEstimator]]
    def __init__(self, steps: Sequence[tuple[str, BaseEstimator]], *, verbose: bool = False) -> None: ...
    def decision_function(self, X: ArrayLike) -> np.ndarray: ...
    def __getitem__(self, ind: int | str) -> BaseEstimator: ...

def make_pipeline(*steps: BaseEstimator, verbose: bool = False) -> Pipeline: ...
