"""Every table of the package, by name."""

from traps_pipeline.judging import judging_rows as judging
from traps_pipeline.mechanism import control_rows
from traps_pipeline.mechanism import mechanism_rows as mechanism
from traps_pipeline.models.asking import answer_rows as models
from traps_pipeline.people import human_label_rows
from traps_pipeline.people import human_score_rows as scores_of_people
from traps_pipeline.scoring import score_rows as scoring
from traps_pipeline.storage import benchmark_tables
from traps_pipeline.storage.tables import Table

PACKAGES = (benchmark_tables, models, judging, human_label_rows, scoring, scores_of_people, mechanism, control_rows)
TABLES = {value.name: value for package in PACKAGES for value in vars(package).values() if isinstance(value, Table)}
