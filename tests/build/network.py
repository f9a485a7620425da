"""Models at the test provider, experiments on the golden study's scenarios, and what came of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from tests.conftest import KEY, ROOT, SMALL, Checkout, Finished
from tests.providers.server import Provider

ITEMS = 48  # of the small study: 12 scenarios in two datasets, two sides
SAMPLING = "temperature: 0.8, top_p: 0.95, max_tokens: 8000"


def entry(name: str, profile: str, more: str = "prices: {input: 1.0, output: 10.0, as_of: 2026-11-01}") -> str:
    return f"""
  - id: {name}
    backend: api
    account: here
    provider_id: openai/{name}
    media: {{profile: {profile}, fps: 5, most: 25}}
    params: {{{SAMPLING}}}
    limits: {{timeout_s: 36, backoff_s: 0.05}}
    {more}
"""


def _account(provider: Provider) -> str:
    return f"accounts:\n  here: {{key: {KEY}, base_url: {provider.url}/v1}}\n"


def register(study: Checkout, provider: Provider, *entries: str) -> None:
    """Put these models at the provider into the registry of a checkout of its own, for all experiments and hosts."""
    assert study.root != ROOT, "this would change the checkout that is tested"
    shipped = (ROOT / "assets" / "models.yaml").read_text()
    registry = shipped.replace("accounts:\n", _account(provider), 1) + "".join(entries)
    (study.root / "assets" / "models.yaml").write_text(registry)


def experiment(study: Checkout, provider: Provider, models: Sequence[str], **more: Any) -> Path:
    """An experiment on the small study's scenarios, in the place of an earlier one. models: entries at the provider,
    or names of the registry's."""
    scenarios = SMALL.read_text()[SMALL.read_text().index("scenarios:") :]
    settings = {"regimes": ["standard", "json"], "runs": [1], **more}
    head = "".join(f"{name}: {value!r}\n".replace("'", '"') for name, value in settings.items())
    entries = "".join(model if "\n" in model else f"\n  - {model}\n" for model in models)
    path = study.workspace.parent / "network.yaml"
    path.write_text(
        f"name: network\npanel: rules\njudged_by_rules: true\n{_account(provider)}models:{entries}{head}{scenarios}"
    )
    return path


def responses(study: Checkout) -> list[dict[str, Any]]:
    files = sorted((study.workspace / "tables" / "responses").rglob("*.parquet"))
    return [row for file in files for row in pq.read_table(file, partitioning=None).to_pylist()]


def ask(study: Checkout, path: Path, *more: str) -> Finished:
    """Run an experiment as far as these tests look."""
    return study.traps("run", path, "--no-preflight", "--until", "responses", *more)


def settled(study: Checkout) -> list[dict[str, Any]]:
    return [row for row in study.ledger_rows("answers") if row["outcome"] != "error"]
