"""Write `assets/published/audit.csv`: `python -m tools.paper_audit`."""

from tools.paper_audit.recomputed import recomputed
from traps_pipeline.scoring.published import PUBLISHED

if __name__ == "__main__":
    recomputed().to_csv(PUBLISHED / "audit.csv", index=False)
