"""Read the paper's results (`assets/published`) in the units of a study's tables."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import ASSETS

if TYPE_CHECKING:
    import pandas as pd

PUBLISHED = ASSETS / "published"
_RENAMED = {"acc": "acc_pct", "abs_rec": "abs_rec_pct", "false_abs": "false_abs_pct"}


def published(name: str) -> pd.DataFrame:
    """Return one published file as numbers (units: `assets/published/README.md`).

    Percentages are percent, PECS and AUROC fractions. name: the file's stem, e.g. `probe_transfer`. Raises TrapsError
    that lists the files for another name.
    """
    return _read(name).copy()


def as_printed(name: str) -> pd.DataFrame:
    """Return one published file as texts, with the digits that the paper prints.

    An empty cell is an empty text. Raises TrapsError that lists the files for another name.
    """
    return _read(name, texts=True).copy()


def published_digest() -> str:
    """Return the digest of `assets/published`, behind the paper's tables and figures."""
    files = {file.name: file.read_text(encoding="utf-8") for file in sorted(PUBLISHED.glob("*.csv"))}
    return digest(files)[:16]


def published_cells() -> pd.DataFrame:
    """Return the paper's table per dataset as rows of a study's cells, shares as fractions.

    Columns model, dataset, regime, epoch, n_pairs, acc, abs_rec, false_abs, pecs, and their `_std` over runs (null for
    the single greedy run of qwen3-vl-8b). A cell has one epoch: `corrected`; on chaotic_ill_posed it is `original`, or
    `verification` for the replication models.
    """
    rows = published("behavioral_per_dataset")
    cells = rows.loc[:, ["model", "dataset", "regime", "epoch", "n_pairs"]]
    for share, printed_column in _RENAMED.items():
        cells[share], cells[f"{share}_std"] = rows[printed_column] / 100, rows[f"{share}_std"] / 100
    cells["pecs"], cells["pecs_std"] = rows["pecs"], rows["pecs_std"]
    return cells


def published_overall() -> pd.DataFrame:
    """Return the printed overall leaderboard: model, regime, acc, abs_rec, false_abs, pecs, as fractions."""
    rows = published("overall")
    shares = {share: rows[printed_column] / 100 for share, printed_column in _RENAMED.items()}
    return rows.loc[:, ["model", "regime"]].assign(**shares, pecs=rows["pecs"])


@cache
def _read(name: str, texts: bool = False) -> pd.DataFrame:
    import pandas as pd

    path = PUBLISHED / f"{name}.csv"
    if not path.is_file():
        file_names = ", ".join(sorted(file.stem for file in PUBLISHED.glob("*.csv")))
        raise TrapsError(f"no published table {name!r}; known: {file_names}")
    return pd.read_csv(path, dtype=str, keep_default_na=False) if texts else pd.read_csv(path)
