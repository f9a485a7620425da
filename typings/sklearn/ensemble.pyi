# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import _Classifier

class ExtraTreesClassifier(_Classifier):
    def __init__(
        self,
        n_estimators: int = 100,
        *,
        criterion: Literal["gini", "entropy", "log_loss"] = "gini",
        max_depth: int | None = None,
        min_samples_split: float = 2,
        min_samples_leaf: float = 1,
        n_jobs: int | None = None,
        random_state: int | np.random.RandomState | None = None,
    ) -> None: ...

class HistGradientBoostingClassifier(_Classifier):
    def __init__(
        self,
        loss: Literal["log_loss"] = "log_loss",
        *,
        learning_rate: float = 0.1,
        max_iter: int = 100,
        max_leaf_nodes: int | None = 31,
        max_depth: int | None = None,
        min_samples_leaf: int = 20,
        random_state: int | np.random.RandomState | None = None,
    ) -> None: ...
    def decision_function(self, X: ArrayLike) -> np.ndarray: ...
