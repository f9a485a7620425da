"""Read an experiment: models and questions of a YAML file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationInfo, field_validator, model_validator

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.names import Name
from traps_pipeline.base.paths import ASSETS
from traps_pipeline.base.suggestions import did_you_mean, nearest_name
from traps_pipeline.base.yamlfile import name_file_in_errors, parse_yaml_model, read_yaml
from traps_pipeline.benchmark.corrections import categories_of, corrected_scenarios, current_benchmark, of_study
from traps_pipeline.benchmark.records import refuse_recorded
from traps_pipeline.models.registry.entries import LOCAL, get_model, local_models
from traps_pipeline.models.registry.judges import load_panel, load_panels, require_panel
from traps_pipeline.models.registry.user_registry import UserRegistry, add_entries
from traps_pipeline.pipeline.wanted import evaluations_of
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.protocol.datasets import DATASETS, REPLACED, SCHEMAS, TWO_EVENTS, UNPAIRED, datasets_of_category
from traps_pipeline.protocol.regimes import BY_NAME, PAPER_REGIMES, REGIMES, fields_of
from traps_pipeline.storage.study import Asked, MechanismSettings, Settings, Study

EXPERIMENTS = ASSETS / "experiments"
LITE = "lite"  # the name of the set of 200 scenarios in LITE_FILE
LITE_FILE = ASSETS / "lite.yaml"


class Experiment(Settings):
    """The fields of an experiment's file. benchmark, scenarios, per_family and panel are copied to the study."""

    name: Name = Field(pattern=r"^[a-z0-9-]+$", description="of the experiment in `study.yaml`")
    description: str = Field(default="", description="one line, printed when it runs")
    benchmark: str = Field(default="released", description="name of the benchmark: released, or a private one")
    scenarios: list[str] | None = Field(default=None, min_length=1, description="their ids, or `lite`; all if absent")
    per_family: int | None = Field(default=None, ge=1, description="the first n scenarios of each family")
    datasets: list[str] = Field(default=list(DATASETS), description="datasets, arms or variations")
    models: list[str] = Field(min_length=1, description="ids of the registry, or whole entries")
    regimes: list[str] = Field(default=list(PAPER_REGIMES), description="prompts under which the models are asked")
    runs: list[Annotated[int, Field(ge=1)]] = Field(default=[1], min_length=1, description="independent repetitions")
    panel: str | None = Field(default=None, description="who judges; null: as `--panel` or `study.yaml` says")
    judged_by_rules: bool | None = Field(default=None, description="let the panel `rules` judge any model")
    epoch: str | None = Field(default=None, description="name of the campaign, kept beside every answer")
    budget_usd: float | None = Field(default=None, ge=0.0, description="for all calls over the network, ever")
    model_budgets_usd: dict[str, Annotated[float, Field(ge=0.0)]] | None = Field(
        default=None, description="by model or judge, besides"
    )
    allow_unknown_prices: bool | None = Field(default=None, description="ask models without a price")
    mechanism: MechanismSettings | None = Field(default=None, description="local models to read and steer")
    canary: bool = Field(default=False, description="ask twenty fixed items again in each epoch")
    own: UserRegistry = Field(default=UserRegistry(), description="models, judges and panels of this file")

    @model_validator(mode="before")
    @classmethod
    def _collect_own_entries(cls, data: Any) -> Any:
        """Move described (not named) models, `judges`, `panels`, `accounts` to `own`."""
        if not isinstance(data, dict):
            return data
        if "own" in data:
            raise ValueError("own: describe models under `models`, and judges under `judges`")
        own_fields = {name: value for name, value in data.items() if name not in ("accounts", "judges", "panels")}
        registry_fields = {name: data[name] for name in ("accounts", "judges", "panels") if name in data}
        models = data.get("models")
        if isinstance(models, list):
            registry_fields["models"] = [model for model in models if isinstance(model, dict)]
            own_fields["models"] = [model.get("id", "?") if isinstance(model, dict) else model for model in models]
        return own_fields | {"own": registry_fields}

    @field_validator("scenarios", mode="before")
    @classmethod
    def _lite(cls, value: Any) -> Any:
        return read_yaml(LITE_FILE)["scenarios"] if value == LITE else value

    @field_validator("datasets", "regimes")
    @classmethod
    def _require_known(cls, values: list[str], info: ValidationInfo) -> list[str]:
        names = (*DATASETS, *UNPAIRED) if info.field_name == "datasets" else REGIMES
        unknown = [value for value in values if value not in names]
        if unknown or not values:
            if gone := [value for value in unknown if value in REPLACED]:
                raise ValueError(
                    f"{', '.join(gone)} went with 0.3: {TWO_EVENTS} takes the place of such arms; ask that"
                )
            suggestion = did_you_mean(unknown[0], names) if unknown else ""
            raise ValueError(f"{unknown or 'nothing'} given; choose from {', '.join(names)}{suggestion}")
        return values

    @model_validator(mode="after")
    def _check_schemas(self) -> Experiment:
        schemas = [dataset for dataset in self.datasets if dataset in SCHEMAS]
        objects = [regime for regime in self.regimes if BY_NAME[regime].fields]
        if schemas and objects:
            raise ValueError(
                f"datasets {', '.join(schemas)} ask for an object of their own, and so does the regime {objects[0]}: "
                "leave one of them out"
            )
        _ = self.study  # report an invalid study (two subsets, a wrong epoch) as an error of this file
        return self

    @property
    def study(self) -> Study:
        """The study of a new workspace for this experiment."""
        fields = ("benchmark", "scenarios", "per_family", "panel", "epoch", "budget_usd", "model_budgets_usd")
        fields += ("allow_unknown_prices", "mechanism", "judged_by_rules")
        values = {name: getattr(self, name) for name in fields}
        return Study(**{name: value for name, value in values.items() if value is not None})

    @property
    def forms(self) -> set[str]:
        """The regimes whose calls ask for more than plain text: an object of a schema, or log-probabilities."""
        is_structured = self.canary or any(fields_of(r, d) for r in self.regimes for d in self.datasets)
        return {r for r in self.regimes if BY_NAME[r].first_token} | ({"json"} if is_structured else set())

    @property
    def asked(self) -> Asked:
        """The experiment's datasets, models, regimes and runs, in the study's format."""
        values = {name: tuple(getattr(self, name)) for name in ("datasets", "models", "regimes", "runs")}
        return Asked(**values, mechanism=self.mechanism is not None)

    def judged(self, study: Study | None, panel: str | None, *, judged_by_rules: bool = False) -> Study:
        """Return the study's settings with the panel of the command, else of the experiment.

        Without either it keeps the panel of `study` (None: a new study). Raises TrapsError for no panel, for two, and
        if rules would judge models without an explicit request.
        """
        base = study or self.study
        if panel is not None and self.panel not in (None, panel):
            raise TrapsError(
                f"--panel {panel}: experiment {self.name} names the panel {self.panel!r}; edit one of them"
            )
        if panel is None and study is not None and study.panel and self.panel not in (None, study.panel):
            raise TrapsError(
                f"study.yaml: panel is {study.panel!r}, experiment {self.name} has {self.panel!r}; "
                "edit one of them, or name another --workspace"
            )
        panel_name = panel or (base.panel if study else self.panel) or self.panel or ""
        is_judged_by_rules = judged_by_rules or bool(self.judged_by_rules) or base.judged_by_rules
        require_panel(panel_name, self.models, judged_by_rules=is_judged_by_rules)
        return base.model_copy(update={"panel": panel_name, "judged_by_rules": is_judged_by_rules})

    def check_study(self, study: Study, path: Path) -> None:
        """Raise TrapsError if a study has another panel, epoch or `mechanism` section."""
        for name in ("panel", "epoch"):
            old, new = getattr(study, name), getattr(self, name)
            if new is not None and new != old:
                raise TrapsError(
                    f"{path}: {name} is {old!r}, experiment {self.name} has {new!r}; "
                    "edit one of them, or name another --workspace"
                )
        if self.mechanism is not None and study.mechanism not in (None, self.mechanism):
            raise TrapsError(
                f"{path}: its `mechanism` differs from that of experiment {self.name}; edit one of them, or remove it "
                "from study.yaml to use the experiment's (states and steered answers that still apply are kept)"
            )

    def cells(self) -> list[Cell]:
        """Return the experiment's cells in order of models, up to its runs. Raises TrapsError for an unknown model."""
        return [Cell(dataset, evaluation) for evaluation in evaluations_of(self.asked) for dataset in self.datasets]


def load_experiment(name: str) -> Experiment:
    """Return an experiment by name or YAML path. Raises TrapsError with known names."""
    path = Path(name) if name.endswith((".yaml", ".yml")) else EXPERIMENTS / f"{name}.yaml"
    if not path.is_file():
        names = sorted(p.stem for p in EXPERIMENTS.glob("*.yaml"))
        raise TrapsError(
            f"no experiment {name[:80]!r}: {str(path)[:200]} is not there; known: {', '.join(names)}, or give the path "
            f"of a YAML file{did_you_mean(name, names)}"
        )
    experiment = parse_yaml_model(Experiment, read_yaml(path), path)
    add_entries(experiment.own, path)
    with name_file_in_errors(path):
        for model in experiment.models:
            get_model(model)
        for panel in (*experiment.own.panels, experiment.panel or ""):
            if nearest_name(panel, load_panels()):  # another one may be the workspace's own
                load_panel(panel)
        pairs = {*experiment.datasets} & {*DATASETS}
        if (experiment.scenarios or experiment.mechanism) and experiment.benchmark == current_benchmark():
            categories = categories_of(of_study(corrected_scenarios(), experiment.study))
            pairs &= {dataset for category in categories for dataset in datasets_of_category(category)}
        if experiment.mechanism is not None and not pairs:
            raise TrapsError(
                f"mechanism: of {', '.join(experiment.datasets)} no dataset with scenarios consists of pairs, on which "
                f"probes are fitted and layers chosen; add one of {', '.join(DATASETS)} and its scenarios"
            )
        if physical := [
            *(model for model in experiment.models if get_model(model).backend in ("observer", "rule")),
            *(dataset for dataset in experiment.datasets if dataset in UNPAIRED and dataset != TWO_EVENTS),
        ]:
            refuse_recorded(", ".join(physical))
        for model in experiment.mechanism.models if experiment.mechanism else ():
            if get_model(model).backend != LOCAL:
                raise TrapsError(
                    f"mechanism.models: {model} is asked through backend {get_model(model).backend}, but only local "
                    f"models have states to read: {', '.join(local_models())}"
                )
    return experiment
