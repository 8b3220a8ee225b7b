"""Templates of pages: they escape every text, and what is not escaped is the package's own."""

import dataclasses
import re
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from hand_made_run import evaluated, make_certified_run, react, touch, touched_run
from jinja2 import UndefinedError
from parsed_page import Page

from adacd_hil.lab.report import page
from adacd_hil.lab.report.page import render, render_page
from adacd_hil.lab.report.report_tables import timing_tables
from adacd_hil.lab.report.run_page import report_page
from adacd_hil.lab.runs.run_pages import ListedRun, runs_page, trend_page
from adacd_hil.lab.runs.run_summary import BROKEN, CERTIFIED, GOOD, CertificateState, RunSummary
from adacd_hil.lab.runs.run_trend import trends
from adacd_hil.lab.score.metrics import ReportSource
from adacd_hil.lab.score.run_arrays import Run

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
TEMPLATES = sorted((ROOT / "adacd_hil" / "lab" / "report" / "templates").iterdir())
EVIL = """'"><evil>&</script></style></title></svg><script>alert(1)</script>"""


def spoilt(value: Any) -> Any:
    """Append markup to every text in a value; a run's own are not shown, and a figure's name is the program's."""
    if isinstance(value, str):
        return value + EVIL
    if isinstance(value, tuple):
        return type(value)(*map(spoilt, value)) if hasattr(value, "_fields") else tuple(map(spoilt, value))
    if isinstance(value, list):
        return [spoilt(item) for item in value]
    if isinstance(value, dict):
        return {key: spoilt(item) for key, item in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type | Run):
        fields = (field.name for field in dataclasses.fields(value))
        return replace(value, **{name: spoilt(getattr(value, name)) for name in fields})
    return value


@pytest.fixture
def spoiling(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every text that a template is given be markup, but the styles and scripts, which are files of the package."""

    def render_spoilt(template: str, **values: Any) -> str:
        own = ("styles", "scripts")
        return render(template, **{name: value if name in own else spoilt(value) for name, value in values.items()})

    monkeypatch.setattr(page, "render", render_spoilt)


def certified_run() -> Run:
    run = make_certified_run()
    touch(run, 3000, 250, (5.0, 1.0), link=2)
    run = react(run, 3005, link=2, force_N=-9.0, force_sigma=0.5, lever_m=0.2, lever_sigma=0.01)
    return replace(run, log_start_ns=0)


def page_of(run: Run) -> str:
    return report_page(evaluated(run), run, ReportSource("run.mcap", "cut"))


def run_summaries() -> list[RunSummary]:
    """Two runs with another threshold each, and one whose log is broken."""
    run = RunSummary(
        "a", Path("runs/a/run.mcap"), GOOD, "all good", datetime(2026, 11, 25), "log", "lab", "lab", "P", "paper",
        "can", "1", CertificateState(CERTIFIED, 2.0, 2), (0.1, 0.1), 1.5, 8, 8, 0, (0.1, 0.1), (0.01, 0.01),
        (0.0, 0.0), (0.001, 0.001), 52.0,
    )  # fmt: skip
    return [run, replace(run, name="b", threshold_Nm=(0.2, 0.1)), replace(run, name="c", status=BROKEN)]


def page_of_a_folder(_: Run) -> str:
    good, _, broken = run_summaries()
    return runs_page(Path("runs"), [ListedRun(good, Path("runs/a/report.html")), ListedRun(broken, None, "no log")])


def page_of_a_communication_test(run: Run) -> str:
    timing = timing_tables(evaluated(run).timing)
    heading = {"over": "commtest", "headline": "good", "is_good": True, "problems": ("event: late",)}
    return render_page("communication_test_page.html.j2", "test", **heading, timing=timing)


PAGES = {
    "paper": (page_of, touched_run),
    "certified": (page_of, certified_run),
    "folder": (page_of_a_folder, touched_run),
    "trend": (lambda _: trend_page(trends(run_summaries())), touched_run),
    "communication test": (page_of_a_communication_test, touched_run),
}


@pytest.mark.usefixtures("spoiling")
@pytest.mark.parametrize("name", PAGES)
def test_whatever_text_a_template_is_given_stays_text(name):
    write, make = PAGES[name]
    html = write(make())
    parsed = Page(html)
    assert html.count("&lt;evil&gt;") > 15
    assert "<evil" not in html
    assert (parsed.tags & {"evil"}, parsed.unbalanced, parsed.open) == (set(), [], [])
    assert html.count("alert(1)") == html.count("&lt;script&gt;alert(1)") + html.count("\\u003cscript\\u003ealert(1)")


def test_a_template_that_asks_for_what_it_is_not_given_is_an_error():
    with pytest.raises(UndefinedError, match="'settling_s' is undefined"):
        render("definitions.html.j2", run=touched_run(), motion_start_s=None)


def test_what_is_not_escaped_is_the_packages_own_and_says_why():
    unescaped = []
    for template in TEMPLATES:
        lines = template.read_text(encoding="utf-8").splitlines()
        for before, line in zip(["", *lines], lines, strict=False):
            unescaped += re.findall(r"{{ (\S+)\|\s*safe", line)
            assert "safe" not in line or "{#" in line or " safe: " in before, f"{template.name}: {line}"
            assert "autoescape" not in line
    assert sorted(unescaped) == ["script.text", "style.text"]
