"""Let somebody read two events without the key: write sheets of frames with their questions, and score the answers.

    python -m bench.blind_reading sheets FOLDER --key KEY.csv
    python -m bench.blind_reading score FOLDER/answers.csv --key KEY.csv

A sheet is a clip: twelve frames from first to last, and below them its two questions with their numbers. Sheets and
numbers are in a random order. A reader fills in `answers.csv` by each sheet alone: the answer, or `unknown` where the
asked scene's end is in no frame.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from bench.quick import parse
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import TWO_EVENTS_RELEASED, WORKSPACES
from traps_pipeline.benchmark.filmed_lanes import trajectories_of
from traps_pipeline.benchmark.records import two_events_lines
from traps_pipeline.models.reading.judged_answers import is_correct
from traps_pipeline.protocol.two_events import CLIPS
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec

FRAMES, COLUMNS = 12, 3
LINE_PX = 30  # height of a question below the frames
UNKNOWN = "unknown"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("sheets", "score"), nargs="?", default="sheets")
    parser.add_argument(
        "path", type=Path, nargs="?", default=WORKSPACES / "reading", help="folder of sheets, or the answers"
    )
    parser.add_argument(
        "--key", type=Path, default=WORKSPACES / "reading-key.csv", help="where the right answers are; not shown"
    )
    parser.add_argument("--records", type=Path, default=TWO_EVENTS_RELEASED)
    parser.add_argument("--scenarios", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parse(parser, scenarios=1)
    specs = {id_: line.spec for id_, line in two_events_lines(arguments.records).items()}
    if arguments.command == "sheets":
        rng = np.random.default_rng(arguments.seed)
        write_sheets(chosen(specs, arguments.scenarios, rng), arguments.path, arguments.key, arguments.records, rng)
    else:
        read = scored(pd.read_csv(arguments.path, dtype=str), pd.read_csv(arguments.key, dtype=str), specs)
        print_scores(read)


def chosen(specs: dict[str, TwoEventsSpec], count: int, rng: np.random.Generator) -> list[TwoEventsSpec]:
    """Return scenarios of as many families as possible, in a random order."""
    frame = pd.DataFrame({"id": list(specs), "family": [spec.family for spec in specs.values()]})
    frame = frame.iloc[rng.permutation(len(frame))]
    turn = frame.groupby("family").cumcount().to_numpy()
    return [specs[id_] for id_ in frame["id"].iloc[np.argsort(turn, kind="stable")[:count]]]


def write_sheets(specs: list[TwoEventsSpec], folder: Path, key: Path, records: Path, rng: np.random.Generator) -> None:
    """Write a picture of each clip, the questions without answers, and the key elsewhere."""
    if key.absolute().is_relative_to(folder.absolute()):
        raise TrapsError(f"{key}: lies in the folder of the sheets, where a reader sees it; name another place")
    folder.mkdir(parents=True, exist_ok=True)
    clips = [(spec, clip) for spec in specs for clip in CLIPS]
    order, rows = rng.permutation(len(clips)), []
    for sheet, place in enumerate(order, 1):
        spec, clip = clips[place]
        asked = [each for each in spec.questions() if each.item.clip == clip]
        asked = [asked[int(k)] for k in rng.permutation(len(asked))]
        numbers = [len(rows) + k + 1 for k in range(len(asked))]
        lines = [f"{number}. {each.text}" for number, each in zip(numbers, asked, strict=True)]
        cv2.imwrite(str(folder / f"sheet{sheet:03d}.png"), sheet_of(spec, clip, lines, records)[..., ::-1])
        for number, each in zip(numbers, asked, strict=True):
            rows.append((number, f"sheet{sheet:03d}.png", each.text, each.item.item_id, each.answer))
    table = pd.DataFrame(rows, columns=pd.Index(["number", "sheet", "question", "item_id", "truth"]))
    table[["number", "sheet", "question"]].assign(answer="").to_csv(folder / "answers.csv", index=False)
    table[["number", "item_id", "truth"]].to_csv(key, index=False)
    print(f"{len(rows)} questions on {len(clips)} sheets in {folder}; the key is in {key}")


def sheet_of(spec: TwoEventsSpec, clip: str, lines: list[str], records: Path) -> np.ndarray:
    """Return a clip's frames in rows, and lines of text below them, RGB."""
    world = spec.world(trajectories_of(spec, records / "trajectories" / f"{spec.scenario_id}.npz")["qpos"])
    poses = world.clip(CLIPS[clip])
    with Renderer(world.model, world.camera) as renderer:
        frames = [*renderer.frames(poses[np.linspace(0, len(poses) - 1, FRAMES).round().astype(int)])]
    rows = [np.concatenate(frames[at : at + COLUMNS], axis=1) for at in range(0, FRAMES, COLUMNS)]
    text = np.full((LINE_PX * len(lines) + LINE_PX // 2, rows[0].shape[1], 3), 255, np.uint8)
    for k, line in enumerate(lines, 1):
        cv2.putText(text, line, (12, LINE_PX * k), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([*rows, text])


def scored(answers: pd.DataFrame, key: pd.DataFrame, specs: dict[str, TwoEventsSpec]) -> pd.DataFrame:
    """Return the key with what was answered, the side, the family, and whether it is right. Raises TrapsError."""
    read = key.merge(answers[["number", "answer"]], on="number", how="left")
    empty = read.loc[read["answer"].fillna("").str.strip() == "", "number"].tolist()
    if empty:
        raise TrapsError(f"questions {', '.join(empty[:5])}: {len(empty)} have no answer; write one, or {UNKNOWN}")
    is_right, families = [], []
    for row in read.to_dict("records"):
        spec, answer = specs[row["item_id"].split(":")[1]], row["answer"].strip()
        families.append(spec.family)
        if answer.lower() == UNKNOWN or pd.isna(row["truth"]):
            is_right.append(answer.lower() == UNKNOWN and pd.isna(row["truth"]))
        else:
            is_right.append(bool(is_correct(answer, row["truth"], spec.answer_type, spec.labels, spec.aliases)))
    return read.assign(right=is_right, family=families, side=np.where(read["truth"].isna(), "void", "control"))


def print_scores(read: pd.DataFrame) -> None:
    print(f"right: {read['right'].mean():.3f} of {len(read)}")
    print(read.groupby("side")["right"].agg(["mean", "size"]).round(3).to_string())
    wrong = read.loc[~read["right"], ["number", "item_id", "truth", "answer"]]
    print(read.pivot_table(values="right", index="family").round(2).to_string())
    print(wrong.to_string(index=False) if len(wrong) else "none wrong")


if __name__ == "__main__":
    main()
