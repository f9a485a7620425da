"""A chat template is rendered as the library renders it, but can neither loop for ever nor fill the memory."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.models.local.test_adapter import FAMILIES, model
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.local.chat_template import MAX_S, render

TURNS = [{"role": "user", "content": [{"type": "text", "text": "Which colour?"}]}]
SOUND = "{% for m in messages %}{{ m.content[0].text }}{{ eos_token }}{% endfor %}"


@pytest.mark.parametrize("family", FAMILIES)
def test_a_prompt_is_that_of_the_library(family: str) -> None:
    of, (system, user) = model(family), ("Be brief.", "Which colour,\n'red'?")
    content = [{"type": "video"}, {"type": "text", "text": user}]
    turns = [
        {"role": "system", "content": [{"type": "text", "text": system}]},
        {"role": "user", "content": content},
    ]
    by_library = of.processor.apply_chat_template(turns, add_generation_prompt=True, **of.params.template)
    assert of._render(system, user) == by_library


@pytest.mark.slow
@pytest.mark.parametrize(
    "template",
    [
        "{% for i in range(99999) %}{% for j in range(99999) %}{% endfor %}{% endfor %}",
        "{{ 'a' * 10000000000 }}",
        "{{ '%10000000000d' % 1 }}",
        "{{ 'a'.ljust(10000000000) }}",
        "{{ 'a'|center(10000000000) }}",
        "{% for i in range(99999) %}{{ 'a' * 10000000 }}{% endfor %}",
        "{% macro f(x) %}{{ f(x) }}{% endmacro %}{{ f(1) }}",
        "{{ 'a' * 2000000 }}",
        "{{ raise_exception('no system prompt') }}",
        "{{ ",
    ],
)
def test_a_template_without_end_or_measure_is_refused_and_the_next_one_is_rendered(template: str) -> None:
    started = time.process_time(), time.monotonic()
    with pytest.raises(TrapsError, match="its chat template fails"):
        render("foreign", template, TURNS, {})
    assert time.process_time() - started[0] < 1  # it costs this process nothing
    assert time.monotonic() - started[1] < 9 * (MAX_S + 2)
    assert render("mine", SOUND, TURNS, {"eos_token": "</s>"}) == "Which colour?</s>"


@pytest.mark.slow
def test_a_script_that_renders_one_is_run_once(tmp_path: Path) -> None:
    """As in a notebook's script without `if __name__ == "__main__"`, whose first lines may have paid for calls."""
    script = tmp_path / "script.py"
    render_one = f"from {render.__module__} import render\nprint(render('mine', {SOUND!r}, {TURNS!r}, {{}}))\n"
    script.write_text(f"print('paid')\n{render_one}")
    path = os.environ | {"PYTHONPATH": str(ROOT)}
    finished = subprocess.run([sys.executable, script], env=path, capture_output=True, text=True, timeout=200)
    assert finished.stdout.splitlines() == ["paid", "Which colour?"], finished.stderr
