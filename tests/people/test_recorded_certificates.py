"""People certify a recorded pair: three who answer its control rightly, and three who cannot know its void."""

from __future__ import annotations

import pandas as pd
import pytest

from traps_pipeline.people.recorded_certificates import certification

RIGHT, WRONG, UNKNOWN = "right", "wrong", "unknown"


def labels(**sides: str) -> pd.DataFrame:
    """Return labels of one scenario; sides: what each person in turn says, as "right wrong unknown"."""
    return pd.DataFrame(
        [
            {
                "task": "answerability",
                "dataset": "occlusion",
                "scenario_id": "cars-0001",
                "side": side,
                "annotator": f"person {number}",
                "abstained": said == UNKNOWN,
                "correct": said == RIGHT if side == "control" else None,
            }
            for side, words in sides.items()
            for number, said in enumerate(words.split())
        ],
        columns=pd.Index(["task", "dataset", "scenario_id", "side", "annotator", "abstained", "correct"]),
    )


@pytest.mark.parametrize(
    ("control", "void", "counts"),
    [
        ("", "", (0, 0)),
        ("right right right", "unknown unknown unknown", (3, 3)),
        ("right right", "unknown unknown unknown", (2, 3)),
        ("right right right", "unknown unknown wrong", (3, 2)),
        ("right right right wrong wrong wrong", "unknown unknown unknown", (0, 3)),  # no majority
        ("right right right unknown", "unknown unknown unknown right right", (3, 3)),
    ],
)
def test_a_side_counts_the_people_who_agree_where_they_are_most(
    control: str, void: str, counts: tuple[int, int]
) -> None:
    assert certification(labels(control=control, void=void), ["cars-0001"]) == {"cars-0001": counts}


def test_labels_of_ill_posed_questions_and_of_other_scenarios_certify_nothing() -> None:
    said = labels(control="right right right", void="unknown unknown unknown")
    assert certification(said.assign(dataset="occlusion_ill_posed"), ["cars-0001"]) == {"cars-0001": (0, 0)}
    assert certification(said, ["cars-0002"]) == {"cars-0002": (0, 0)}


def test_one_person_counts_once() -> None:
    said = labels(control="right right right", void="unknown unknown unknown").assign(annotator="jd")
    assert certification(said, ["cars-0001"]) == {"cars-0001": (1, 1)}
