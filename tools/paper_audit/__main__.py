"""Write `assets/published/audit.csv`, and the tables that the paper prints across: `python -m tools.paper_audit`."""

from tools.paper_audit.arranged import arranged
from tools.paper_audit.recomputed import recomputed
from traps_pipeline.scoring.published import PUBLISHED, as_printed


def main() -> None:
    """Write all that is derived from the other published files."""
    recomputed().to_csv(PUBLISHED / "audit.csv", index=False)
    tables = as_printed("tables").set_index("name", drop=False)
    for name, (text, columns) in arranged().items():
        (PUBLISHED / f"arranged_{name}.csv").write_text(text, encoding="utf-8")
        tables.loc[name, ["file", "columns"]] = [f"arranged_{name}", columns]
    tables.to_csv(PUBLISHED / "tables.csv", index=False)


if __name__ == "__main__":
    main()
