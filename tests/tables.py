"""Every table of the package, by name."""

from traps_pipeline.benchmark import tables as benchmark
from traps_pipeline.judging import people_tables
from traps_pipeline.judging import tables as judging
from traps_pipeline.mechanism import control_tables
from traps_pipeline.mechanism import tables as mechanism
from traps_pipeline.models import tables as models
from traps_pipeline.scoring import people_tables as scores_of_people
from traps_pipeline.scoring import tables as scoring
from traps_pipeline.storage.tables import Table

PACKAGES = (benchmark, models, judging, people_tables, scoring, scores_of_people, mechanism, control_tables)
TABLES = {value.name: value for package in PACKAGES for value in vars(package).values() if isinstance(value, Table)}
