"""What a browser gets of a unit, and the way of labels of confabulation to the table that compares them."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from tests.build.errors import raises
from tests.build.labels import MODEL, labelled_study
from tests.conftest import ROOT, Checkout
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.webguard import personal_tokens, public_name
from traps_pipeline.judging.judging_rows import JUDGE_VALIDATION
from traps_pipeline.protocol.ratings import AXES
from traps_pipeline.servers.annotate import Annotation, SubmittedLabel
from traps_pipeline.servers.server import ServerSettings
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

TEXTS = ["It goes left.", 'He said "left",\nthen stopped.', "Right, <b>surely</b>."]


def test_labels_of_confabulation_go_from_the_pages_to_the_comparison(tmp_path: Path) -> None:
    workspace = labelled_study(tmp_path / "study", TEXTS)
    annotation, file, study = Annotation(workspace), tmp_path / "labels.csv", Checkout(ROOT, workspace.root)
    refused = study.traps("people", "labels", file)
    assert (refused.code, refused.raised) == (1, "people.labels.confabulation_rows")
    seen = set()
    for who in ("ann", "bob"):
        while unit := annotation.next_unit(who, "confabulation"):
            shown = annotation.shown(who, "confabulation", unit)
            assert shown.keys() == {"task", "handle", "question", "why", "trace", "answer"}
            assert MODEL not in json.dumps(shown) and "void" not in json.dumps(shown)
            seen.add(shown["answer"])
            label = dict.fromkeys(AXES, False) | {"hallucinated_premise": True}
            annotation.record(who, SubmittedLabel(handle=shown["handle"], label=label))
    assert seen == set(TEXTS)
    assert annotation.progress("bob", "confabulation") == (3, 3)
    assert "You have labelled all 3" in annotation.unit_page("bob", "confabulation")
    assert "There is nothing to label here" in annotation.unit_page("bob", "answerability")  # its clips are not there
    assert "ann, bob" in study.traps("people", "labels", file).ok().out
    assert [row["invalid_inference"] for row in csv.DictReader(file.open())] == ["0"] * 6
    study.traps("people", "validate", file).ok()
    assert workspace.tables.read(JUDGE_VALIDATION, {})["accuracy"].tolist() == [1.0] * 5


def test_a_study_without_clips_or_answers_says_so(tmp_path: Path) -> None:
    with raises(TrapsError, "servers.annotate.Annotation.__init__"):
        Annotation(Workspace.create(tmp_path / "study", Study(name="empty", panel="rules")))


def test_each_person_has_an_address_of_their_own_that_stays(tmp_path: Path) -> None:
    tokens = personal_tokens("one secret of sixteen", ["jd", "ab"])
    assert set(tokens) < set(personal_tokens("one secret of sixteen", ["ab", "cy", "jd"]))
    assert not set(tokens) & set(personal_tokens("another secret, sixteen", ["jd", "ab"]))
    behind = ServerSettings("127.0.0.1", 3200, tokens, "traps people annotate", "https://labels.example.org/")
    assert {who: address.partition("=")[0] for who, address in behind.addresses().items()} == {
        "jd": "https://labels.example.org/?token",
        "ab": "https://labels.example.org/?token",
    }
    assert public_name("https://labels.example.org:8443") == "labels.example.org:8443"
    for wrong in ("labels.example.org", "http://labels.example.org", "https://labels.example.org/path", "https://"):
        with raises(TrapsError, "base.webguard.public_name"):
            public_name(wrong)
