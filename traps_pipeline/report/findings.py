"""State findings of the leading mechanistic figures, one sentence per model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from traps_pipeline.base.terminal import plain
from traps_pipeline.base.wording import count_noun
from traps_pipeline.mechanism.control_rows import MODEL, STATES
from traps_pipeline.protocol.datasets import SHORT
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.claims import CLAIMS, claim_frame
from traps_pipeline.report.tables.control_reports import lead_rows

if TYPE_CHECKING:
    import pandas as pd

_POSITIONS = {"changed": "changed visual tokens", "unchanged": "unchanged visual tokens", "last": "the last token"}


def _join_sentences(sentences: Callable[[Results], Iterator[str]]) -> Callable[[Results], str]:
    return lambda results: " ".join(sentences(results))


def _models(rows: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    for model, group in rows.groupby("model", sort=False, observed=True):
        yield plain(str(model)), group


@_join_sentences
def claims(results: Results) -> Iterator[str]:
    """Yield sentences, by model: which claims hold of it, and which do not since they hold in a control too."""
    says = {claim.name: claim.says for claim in CLAIMS}
    for model, group in _models(claim_frame(results)):
        held = [says[name] for name in group.loc[group["verdict"] == "holds", "claim"]]
        shared = group.loc[group["verdict"].str.endswith(" too")].to_dict("records")
        yield f"{model}: {len(held)} of {count_noun(len(group), 'claim')} are held" + (
            f" ({'; '.join(held)})." if held else "."
        )
        if shared:
            yield f"Not held, since a control does the same: {'; '.join(says[row['claim']] for row in shared)}."


@_join_sentences
def leads(results: Results) -> Iterator[str]:
    """Yield a sentence per model: by how much probes of its hidden states beat the best rival, by dataset."""
    rows = lead_rows(results)
    for model, group in _models(rows.loc[rows["subject"] == MODEL]):
        parts = [
            f"{SHORT[row['target']]} {row[STATES]:.2f}, {row['rival']} {row[row['rival']]:.2f} "
            f"(lead {row['lead']:+.2f}, {row['lead_low']:+.2f} to {row['lead_high']:+.2f})"
            for row in group.to_dict("records")
        ]
        yield f"{model}, AUROC of states and of the best rival: {'; '.join(parts)}."


@_join_sentences
def patching(results: Results) -> Iterator[str]:
    """Yield a sentence per model: the token positions with the largest effect at first and last layer."""
    rows = results.patching
    rows = rows.loc[(rows["source"] == "pair") & (rows["site"] == "residual") & rows["effect"].notna()]
    for model, group in _models(rows.loc[rows["group"] != "all"]):
        cells = group.groupby(["layer", "group"], observed=True)
        means = cells.agg(effect=("effect", "mean"), panels=("effect", "size")).reset_index()
        panels = len(group[["dataset", "into"]].drop_duplicates())
        best = (
            max(means.loc[means["layer"] == layer].to_dict("records"), key=lambda row: row["effect"])
            for layer in (group["layer"].min(), group["layer"].max())
        )
        shares = (
            f"{row['effect']:.2f} by {_POSITIONS.get(row['group'], row['group'])} at layer {row['layer']} (mean of the "
            f"{row['panels']} of {panels} panels patched there)"
            for row in best
        )
        prompt = " and ".join(sorted({*group["prompt"]}))
        yield f"In {model} under {prompt}, of the output’s difference a patch gives {' and '.join(shares)}."
