"""How well the state at a void's cut foretells the outcome: what one who knew all poses could learn by rote.

The certificate `open` says of each record that its futures disagree. That leaves a family whose records have something
in common: if a ball on the left ends on the left more often than not, a rule that has seen enough records foretells the
outcome without knowing physics.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FOLDS, SEED = 5, 0
AT_MOST = 0.05  # beyond the commonest outcome
FEWEST = 100  # records of a family; fewer do not tell so little from chance


@dataclass(frozen=True)
class Foretold:
    """Shares of outcomes that are told rightly: by the better of two cross-validated readers of the states, which
    favours them, and by always saying the commonest outcome."""

    best: float
    prior: float

    @property
    def gain(self) -> float:
        """What the state tells beyond the commonest outcome."""
        return self.best - self.prior


def foretold(states: Sequence[Sequence[float] | np.ndarray], outcomes: Sequence[str]) -> Foretold | None:
    """Return how well states (one a record, of any lengths) tell outcomes; None where some outcome is rarer than the
    folds."""
    from sklearn.ensemble import ExtraTreesClassifier
    from sklearn.linear_model import LogisticRegression
    from sklearn.model_selection import StratifiedKFold, cross_val_score
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    counts = Counter(outcomes)
    if not counts or min(counts.values()) < FOLDS:
        return None
    width = max(map(len, states))
    features = np.stack([np.pad(np.asarray(state), (0, width - len(state))) for state in states])
    readers = (
        make_pipeline(StandardScaler(), LogisticRegression(max_iter=2000)),
        ExtraTreesClassifier(300, min_samples_leaf=3, random_state=SEED),
    )
    folds = StratifiedKFold(FOLDS, shuffle=True, random_state=SEED)
    best = max(float(cross_val_score(reader, features, list(outcomes), cv=folds).mean()) for reader in readers)
    return Foretold(best, max(counts.values()) / len(outcomes))
