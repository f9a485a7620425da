"""Dagster's history in the PostgreSQL database that holds the study's ledger: the same runs, seen from every host."""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

from dagster import StringSource
from dagster._serdes import ConfigurableClass, ConfigurableClassData

from traps_pipeline.errors import TrapsError


class SharedHistory(ConfigurableClass):
    """Named in `dagster.yaml`. variable: that holds the address; the address stands in no file and in no run."""

    def __init__(self, variable: str, inst_data: ConfigurableClassData | None = None) -> None:
        self.variable, self._inst_data = variable, inst_data

    @property
    def inst_data(self) -> ConfigurableClassData | None:
        """What `dagster.yaml` says."""
        return self._inst_data

    @classmethod
    def config_type(cls) -> dict[str, Any]:
        """Fields in `dagster.yaml`."""
        return {"variable": StringSource}

    @classmethod
    def from_config_value(cls, inst_data: ConfigurableClassData | None, config_value: Any) -> Any:
        """Dagster's way to make it: dagster-postgres's own storage. Raises TrapsError where the variable is not set."""
        variable = config_value["variable"]
        address = os.environ.get(variable)
        if not address:
            raise TrapsError(f"{variable} is not set on this host; export the address of the study's database")
        # SQLAlchemy 2.1 takes psycopg 3 for a plain postgresql://, and dagster-postgres's NOTIFY fails with it.
        url = "postgresql+psycopg2://" + address.partition("://")[2]
        storage = import_module("dagster_postgres").DagsterPostgresStorage
        return storage(url, should_autocreate_tables=True, inst_data=inst_data)
