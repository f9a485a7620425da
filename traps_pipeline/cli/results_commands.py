"""Write and compare results, with the explorer (`traps results`)."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from traps_pipeline.base.sheets import csv_bytes
from traps_pipeline.base.terminal import plain, text_table, wrap_text
from traps_pipeline.base.wording import count_noun
from traps_pipeline.cli.command import OK, Commands, open_workspace, place_of, print_json


def add(commands: Commands) -> None:
    """Add the `traps results` commands, and `traps site`."""
    text = "write a folder to explore all answers and clips in; it opens from disk"
    parser = commands.add("results site", site, text, example="site --without-clips", json=True)
    parser.add_argument("folder", nargs="?", type=Path, help="default: `site` in the study's folder")
    parser.add_argument("--without-clips", action="store_true", help="leave the clips out, for a small folder")

    text = "write every table, figure and page to one file, or to a folder"
    parser = commands.add("results export", export_results, text, example="results.zip")
    parser.add_argument(
        "folder", nargs="?", type=Path, help="or a file .zip (default: `export.zip` in the study's folder)"
    )

    text = "print this study minus another on their common pairs, with paired intervals"
    parser = commands.add("results compare", compare_studies, text, example=".workspaces/earlier", json=True)
    parser.add_argument("other", type=Path, help="folder of the other study, such as an earlier benchmark version")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write every row to a file")


def site(arguments: argparse.Namespace) -> int:
    from traps_pipeline.report.explorer.site import INDEX, write_site

    workspace = open_workspace(arguments)
    folder = (arguments.folder or workspace.root / "site").absolute()
    summary = write_site(workspace, folder, clips=not arguments.without_clips)
    if arguments.json:
        print_json({"folder": folder, **vars(summary)})
        return OK
    clips = f"{count_noun(summary.clips, 'clip')}, {_megabytes(summary.clip_bytes)}"
    files = f"{count_noun(summary.files, 'file')}, {_megabytes(summary.bytes)}"
    content = f"{count_noun(summary.answers, 'answer')} with {count_noun(summary.votes, 'vote')}"
    print(f"{content}: {files}; {'without clips' if arguments.without_clips else clips}")
    if summary.lacking:
        print(f"{count_noun(len(summary.lacking), 'clip')} missing from the study, {summary.lacking[0]} first")
    print(f"next: open {folder / INDEX}")
    return OK


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB"


def export_results(arguments: argparse.Namespace) -> int:
    from traps_pipeline.report.publish import INDEX, export

    workspace = open_workspace(arguments)
    target = (arguments.folder or workspace.root / "export.zip").absolute()
    count = export(workspace, target, say=lambda line: print(line, flush=True))
    advice = f"unpack it and open {INDEX}" if target.suffix == ".zip" else f"open {target / INDEX}"
    print(f"{count_noun(count, 'file')} in {target}\nnext: {advice}")
    return OK


def compare_studies(arguments: argparse.Namespace) -> int:
    from traps_pipeline.judging.judging_rows import VERDICTS
    from traps_pipeline.scoring.contrasts import version_contrasts
    from traps_pipeline.storage.benchmark_tables import current_rows
    from traps_pipeline.storage.workspace import Workspace

    studies = Workspace.open(arguments.other), Workspace.open(place_of(arguments))
    other_rows, own_rows = (current_rows(study, VERDICTS) for study in studies)
    table = version_contrasts(other_rows, own_rows)
    if arguments.csv:
        arguments.csv.write_bytes(csv_bytes(table))
    if arguments.json:
        print_json(table)
        return OK
    rows = table.to_dict("records")
    changed = [row for row in rows if row["refused"] is None and _differs(row)]
    entries = dict.fromkeys((row["model"], row["regime"]) for row in changed)
    for model, regime in entries:
        cells = [_change(row) for row in changed if (row["model"], row["regime"]) == (model, regime)]
        headings = ("dataset", "metric", "then", "now", "change", "95 % interval", "separable", "missing")
        print(f"{plain(model)}, {regime}\n{text_table(headings, cells, left=(0, 1))}\n")
    for reason in dict.fromkeys(row["refused"] for row in rows if row["refused"]):
        print(wrap_text(f"not compared: {plain(reason)}"))
    pairs = {(row["model"], row["regime"], row["dataset"]): row["n_pairs"] for row in rows}
    n_pairs = sum(count for (*_, dataset), count in pairs.items() if dataset != "overall")
    differ = f"{len(changed)} of {count_noun(len(rows), 'metric')} differ on {count_noun(n_pairs, 'common pair')}"
    print(wrap_text(f"{differ}; --csv FILE and --json have all"))
    return OK


def _differs(row: Mapping[Any, Any]) -> bool:
    """Return whether a metric or the number of missing answers is another one now."""
    pairs = [(row[f"{name}then"], row[f"{name}now"]) for name in ("", "n_missing_")]
    return any(then != now and not (then != then and now != now) for then, now in pairs)


def _change(row: Mapping[Any, Any]) -> list[str]:
    """Return a row of the printed table."""

    def number(name: str, sign: str = "") -> str:
        return "-" if row[name] != row[name] else f"{row[name]:{sign}.3f}"

    interval = "-" if row["ci_low"] != row["ci_low"] else f"[{number('ci_low', '+')}, {number('ci_high', '+')}]"
    separable = "-" if row["p"] != row["p"] else {True: "yes", False: "no"}.get(row["separable"], "too few")
    missing = [int(row[f"n_missing_{side}"]) for side in ("then", "now")]
    numbers = [number("then"), number("now"), number("difference", "+"), interval]
    return [row["dataset"], row["metric"], *numbers, separable, "" if not any(missing) else "{} -> {}".format(*missing)]
