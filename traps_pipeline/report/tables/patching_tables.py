"""Tabulate indirect effects of activation patching, beside their nulls."""

from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.inside_columns import LAYER, few_marks, few_note, interval, short_names
from traps_pipeline.report.tables.table_columns import MODEL
from traps_pipeline.report.writing import Column, PrintedTable

SITES = {"residual": "residual stream", "attention": "attention", "mlp": "MLP"}


def patching(results: Results) -> list[PrintedTable]:
    """Return indirect effects of patching by site and position group, beside nulls."""
    rows = results.patching
    keys = ["model", "dataset", "into", "site", "layer", "group"]
    nulls = rows.loc[rows["source"] != "pair"]
    null_grid = nulls.pivot_table(index=keys, columns="source", values="effect", observed=True)
    names = ["other scenario", "same side", "other times"]
    pair_effects = rows.loc[(rows["source"] == "pair") & rows["effect"].notna()].astype(dict.fromkeys(keys, object))
    table = pair_effects.merge(
        null_grid.reindex(columns=names).reset_index().astype(dict.fromkeys(keys, object)), on=keys, how="left"
    )
    table = table.assign(
        name=short_names(table["dataset"]),
        where=[SITES.get(site, site) for site in table["site"]],
        place=[[*SITES].index(site) if site in SITES else len(SITES) for site in table["site"]],
        mark=few_marks(table, "n"),
    )
    table = table.sort_values(["model", "name", "into", "place"], kind="stable", ignore_index=True)
    columns = [
        MODEL, Column("name", "Dataset"), Column("into", "Into"), Column("where", "Site"), LAYER,
        Column("group", "Positions"),
        Column("tokens", "Tokens", "ratio"), Column("attributed", "Estimate", "fraction"),
        Column("effect", "Indirect effect", "fraction", mark="mark"),
        *interval(), Column("flips", "Flipped %", "percent"),
        Column("n_flippable", "of", "count"), *(Column(name, name.capitalize(), "fraction") for name in names),
        Column("n", "Pairs", "count"), Column("n_left_out", "Left out", "count"),
    ]  # fmt: skip
    notes = [
        "share of the way from the patched side’s log-odds of abstention to the other side’s; 1 for all positions of "
        "the residual stream by construction; effects of groups need not add up",
        "site: the residual stream as it leaves a block, or what attention or the MLP of a block adds to it; one block "
        "is only a part of what is added, so that its outputs need not reach 1",
        "changed: visual tokens whose pixels differ between the sides; the columns other scenario, same side and other "
        "times are patches from another scenario’s other side, another scenario’s same side, and the item’s own frames "
        "with the other side’s times, in the residual stream alone",
        "estimate: of the indirect effect, to first order, from one backward pass a pair; the rows are those cells of "
        "site, layer and positions whose estimates are largest",
        *few_note(table, of="pairs"),
    ]
    reason = "the experiment asks for no `patching`" if results.is_study else "the paper patches nothing"
    return [PrintedTable("patching", "Activation patching", table, columns, notes, reason)]
