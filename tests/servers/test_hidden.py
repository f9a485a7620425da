"""Hidden characters: the pages' scripts and the templates make the same ones visible in the same way."""

from __future__ import annotations

import shutil

import dagster as dg
import jinja2
import pytest

from tests.pages import CHROMIUM, a_browser
from traps_pipeline.base.terminal import escape_invisible
from traps_pipeline.pipeline.metadata import visible_metadata
from traps_pipeline.report.explorer.site import WEB
from traps_pipeline.report.writing import environment
from traps_pipeline.servers.server import WEB as PAGES

# Overrides, isolates and marks of direction; ESC, BEL, a C1 control, a lone carriage return; what belongs to a text.
HOSTILE = "a\u202eb \u2066c\u2069 \u2067\u2068 \u200e\u200f\u061c \x1b[31md\x07\x9b\x85 e\rf\tg\r\nh\n"
VISIBLE = (
    "a[U+202E]b [U+2066]c[U+2069] [U+2067][U+2068] [U+200E][U+200F][U+061C] "
    "[U+001B][31md[U+0007][U+009B][U+0085] e[U+000D]f\tg\r\nh\n"
)
EMOJI = "❤️ 1️⃣ 👩🏽‍🔬 👩‍🔬"


@pytest.mark.parametrize("jinja", [environment(), environment(PAGES)], ids=["reports", "pages"])
def test_a_template_prints_no_hidden_character(jinja) -> None:
    template: jinja2.Template = jinja.from_string("<p title='{{ text }}'>{{ text }}</p>{{ text | tojson }}{{ 1 }}")
    page = template.render(text=f"<b>{HOSTILE}")
    shown = f"&lt;b&gt;{VISIBLE}"
    assert page.startswith(f"<p title='{shown}'>{shown}</p>\"\\u003cb\\u003ea\\u202eb ") and page.endswith("1")


def test_emoji_and_plain_text_stay_as_they_are() -> None:
    assert escape_invisible(EMOJI) == EMOJI
    assert escape_invisible("عربي, עברית, 中文") == "عربي, עברית, 中文"
    assert escape_invisible("a\u200db\ufe0f") == "a[U+200D]b[U+FE0F]"


def test_metadata_for_dagster_holds_no_hidden_character() -> None:
    table = dg.MetadataValue.table([dg.TableRecord({"error": HOSTILE, "n": 1})])
    path = dg.MetadataValue.path("/study")
    values = visible_metadata(
        {"md": dg.MetadataValue.md(HOSTILE), "table": table, "failing": [{HOSTILE: HOSTILE}, 2], "path": path}
    )
    assert values["path"] is path
    assert values["md"].md_str == VISIBLE
    assert values["table"].records[0].data == {"error": VISIBLE, "n": 1}
    assert values["failing"] == [{VISIBLE: VISIBLE}, 2]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which(CHROMIUM) is None, reason="chromium is not installed")
def test_scripts_and_templates_agree_on_every_character() -> None:
    script = (WEB / "dom.js").read_text(encoding="utf-8")
    texts = [f"a{chr(code)}b" for code in range(0x110000) if not 0xD800 <= code < 0xE000]
    with a_browser() as browser:
        page = browser.new_page()
        page.add_script_tag(content=script)
        changed = page.evaluate("texts => texts.map(visible).filter((text, k) => text !== texts[k])", texts)
        assert page.evaluate("visible", HOSTILE) == VISIBLE and page.evaluate("visible", EMOJI) == EMOJI
        # A text that no script treats as untrusted, as an id.
        assert page.evaluate("text => h('p', null, text).textContent", HOSTILE) == VISIBLE
    assert changed == [escape_invisible(text) for text in texts if escape_invisible(text) != text]
