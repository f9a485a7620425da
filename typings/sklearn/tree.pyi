# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
from typing import Literal

import numpy as np
from sklearn.base import _Classifier

class DecisionTreeClassifier(_Classifier):
    def __init__(
        self,
        *,
        criterion: Literal["gini", "entropy", "log_loss"] = "gini",
        splitter: Literal["best", "random"] = "best",
        max_depth: int | None = None,
        min_samples_split: float = 2,
        min_samples_leaf: float = 1,
        random_state: int | np.random.RandomState | None = None,
    ) -> None: ...
