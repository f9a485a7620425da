"""Measure how well all poses at a void's cut predict the outcome.

The certificate `open` proves for each record that its futures disagree. A family's records may still have something in
common: if a ball on the left ends on the left more often than not, a rule that has seen enough records predicts the
outcome without knowing physics.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

FOLDS, SEED = 5, 0
MAX_GAIN = 0.05  # maximum accuracy above always giving the commonest outcome
MIN_RECORDS = 100  # records of a family; fewer cannot tell such a leakage from chance


def outcome_leakage(
    states: Sequence[Sequence[float] | np.ndarray], outcomes: Sequence[str]
) -> tuple[float, float] | None:
    """Return the accuracies of predicting outcomes from states, and by the commonest one; None if one is too rare.

    The first is the accuracy of the better of two cross-validated classifiers, which favours them.
    """
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
    classifiers = (
        make_pipeline(StandardScaler(), LogisticRegression(max_iter=2000)),
        ExtraTreesClassifier(300, min_samples_leaf=3, random_state=SEED),
    )
    folds = StratifiedKFold(FOLDS, shuffle=True, random_state=SEED)
    best = max(
        float(cross_val_score(classifier, features, list(outcomes), cv=folds).mean()) for classifier in classifiers
    )
    return best, max(counts.values()) / len(outcomes)
