"""People certify a recorded pair: three who answer its control rightly, and three who cannot know its void."""

from __future__ import annotations

import pandas as pd
import pytest

from traps_pipeline.people.recorded_certificates import certification
from traps_pipeline.protocol.two_events import lane_item, lane_items

RIGHT, WRONG, UNKNOWN = "right", "wrong", "unknown"
COLUMNS = pd.Index(["task", "item_id", "annotator", "abstained", "correct"])


def items(*ids: str) -> pd.DataFrame:
    """Return items of the ids; the side is the last part of an id, as of pairs, or that of the lane that it asks."""
    sides = {id_: lane_item(id_).side if id_.startswith("two_events") else id_.split(":")[-1] for id_ in ids}
    rows = [(id_, id_.split(":")[0], id_.split(":")[1], sides[id_]) for id_ in ids]
    return pd.DataFrame(rows, columns=pd.Index(["item_id", "dataset", "scenario_id", "side"]))


PAIR = items("occlusion:cars-0001:control", "occlusion:cars-0001:void")


def labels(**said_of: str) -> pd.DataFrame:
    """Return labels of items; said_of: what each person in turn says, as "right wrong unknown"."""
    return pd.DataFrame(
        [
            {
                "task": "answerability",
                "item_id": item_id,
                "annotator": f"person {number}",
                "abstained": said == UNKNOWN,
                "correct": said == RIGHT if said != UNKNOWN else None,
            }
            for item_id, words in said_of.items()
            for number, said in enumerate(words.split())
        ],
        columns=COLUMNS,
    )


def of_pair(control: str, void: str) -> pd.DataFrame:
    return labels(**dict(zip(PAIR["item_id"], (control, void), strict=True)))


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
    assert certification(of_pair(control, void), PAIR) == {"cars-0001": counts}


def test_labels_of_ill_posed_questions_and_of_other_scenarios_certify_nothing() -> None:
    said = of_pair("right right right", "unknown unknown unknown")
    ill_posed = items("occlusion_ill_posed:cars-0001:control", "occlusion_ill_posed:cars-0001:void")
    asked = said.assign(item_id=said["item_id"].str.replace("occlusion", "occlusion_ill_posed"))
    assert certification(asked, ill_posed) == {"cars-0001": (0, 0)}
    assert certification(said, items("occlusion:cars-0002:void")) == {"cars-0002": (0, 0)}


def test_one_person_counts_once() -> None:
    said = of_pair("right right right", "unknown unknown unknown").assign(annotator="jd")
    assert certification(said, PAIR) == {"cars-0001": (1, 1)}


def test_of_two_events_people_must_agree_on_all_eight_items() -> None:
    asked = items(*(item.item_id for item in lane_items("cars-e001")))
    words = {"control": "right right right", "void": "unknown unknown unknown"}
    said = {row["item_id"]: words[row["side"]] for row in asked.to_dict("records")}
    assert certification(labels(**said), asked) == {"cars-e001": (3, 3)}
    said |= {"two_events:cars-e001:left.left": "unknown unknown right", "two_events:cars-e001:right.left": ""}
    assert certification(labels(**said), asked) == {"cars-e001": (0, 2)}
