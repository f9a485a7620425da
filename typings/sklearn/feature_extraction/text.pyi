# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
from collections.abc import Iterable
from typing import Self

import numpy as np
from sklearn.base import BaseEstimator

class _Sparse:
    shape: tuple[int, int]
    def toarray(self) -> np.ndarray: ...

class CountVectorizer(BaseEstimator):
    vocabulary_: dict[str, int]
    def __init__(
        self,
        *,
        lowercase: bool = True,
        token_pattern: str | None = ...,
        ngram_range: tuple[int, int] = (1, 1),
        max_df: float = 1.0,
        min_df: float = 1,
        max_features: int | None = None,
        binary: bool = False,
    ) -> None: ...
    def fit(self, raw_documents: Iterable[str], y: None = None) -> Self: ...
    def transform(self, raw_documents: Iterable[str]) -> _Sparse: ...
    def fit_transform(self, raw_documents: Iterable[str], y: None = None) -> _Sparse: ...

class TfidfVectorizer(CountVectorizer): ...
