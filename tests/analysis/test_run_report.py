"""The report as a whole: JSON that is complete, a page that needs and allows nothing from outside."""

import base64
import csv
import hashlib
import json
import re
import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hand_made_run import A, M, evaluated, gathered_of, make_run, record, touched_run, without_cycles
from parsed_page import Page

from adacd_hil.device.value_bounds import ValueBound
from adacd_hil.lab.report.page import render
from adacd_hil.lab.report.report_files import write_report, write_run_report
from adacd_hil.lab.report.report_json import JSON_NAME, report_json
from adacd_hil.lab.report.report_tables import timing_tables
from adacd_hil.lab.score.metrics import ReportSource
from adacd_hil.lab.score.verdict import headlines
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import LoggedEvent
from adacd_hil.records import Event, FaultReason, SchemeState

pytestmark = pytest.mark.slow
SOURCE = ReportSource("run.mcap")


def written(run, folder, source=SOURCE):
    return write_run_report(run, folder, source, gathered_of(run))


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    return written(touched_run(), tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def table(report):
    return json.loads(report.html_path.with_name(JSON_NAME).read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def html(report):
    return report.html_path.read_text(encoding="utf-8")


def test_a_report_is_a_page_and_tables(report):
    folder, rows = report.html_path.parent, {}
    for path in folder.glob("*.csv"):
        with path.open(encoding="utf-8", newline="") as table:
            rows[path.stem] = list(csv.DictReader(table))
    assert {path.name for path in folder.iterdir()} == {*(f"{name}.csv" for name in rows), "report.html", "report.json"}
    picked = [
        tuple(row[key] for key in ("number", "link_detected", "tau_ext_Nm_2", "delay_ms")) for row in rows["contacts"]
    ]
    assert picked == [("1", "1", "0", "5"), ("2", "2", "-3", "4"), ("3", "", "0", "")]
    assert [row["section"] for row in rows["parameters"]] == ["A"] * 7 + ["D"] * 7
    assert rows["parameters"][0].items() >= {
        "parameter": "a1", "unit": "kg m²", "true": "0.2", "identified": "0.2", "cad": "0.1786065",
    }.items()  # fmt: skip
    stays = [(row["state"], row["section"], row["start_s"]) for row in rows["states"][:3]]
    assert stays == [("ENABLE", "", "-0.05"), ("ADAPT", "A", "0"), ("MONITOR", "B", "1")]


KEYS = {
    "": "schema verdict is_clean time_zero adaptation_s sections frozen_residual_max_Nm contacts false_alarms "
    "false_alarms_s false_alarm_bound_per_h missed parameters payload_kg certified fault cycle timing data log stretch "
    "paper run",
    "sections.A": "label kind start_s end_s is_complete duration_s",
    "frozen_residual_max_Nm.B": "identified cad cycles",
    "contacts.0": "number section state link onset_s end_s is_armed detected_s delay_ms law_ms ideal_ms link_at_alarm "
    "link_detected direction direction_ok tau_ext_Nm tau_ext_peak_hat_Nm torque_error_ratio true_force_N level kind "
    "link_ok reaction location is_two_sided tau_ext_peak_sigma_Nm impulse_Nm_s impulse_sigma_Nm_s force_N "
    "force_sigma_N lever_m lever_sigma_m blind_deg",
    "parameters.A": "a1 a2 a3 F_v1 F_v2 F_c1 F_c2",
    "cycle": "count duration_s clock scheduler",
    "timing": "is_modelled period_us cycles times_us reaction_us data_age_cycles queues_bytes counts histograms_us",
    "timing.times_us": "lateness sync_to_feedback compute sync_to_command slack",
    "timing.times_us.lateness": "p50 p99 p99.9 max",
    "timing.times_us.slack": "p50 p1 p0.1 min",
    "timing.reaction_us": "count p50 p99 p99.9 max",
    "timing.queues_bytes": "receive transmit log",
    "timing.counts": "overruns frames_lost frames_missing commands_late",
    "timing.counts.overruns": "total per_100000",
    "timing.histograms_us.slack": "edges counts below above",
    "log": "name frames dropped is_complete problem",
    "data": "cycles incomplete worst_incomplete aged devices excesses",
    "paper.0": "quantity paper beside measured",
}


def at(table, path):
    for key in filter(None, path.split(".")):
        table = table[int(key)] if key.isdigit() else table[key]
    return table


@pytest.mark.parametrize("path", KEYS)
def test_the_table_has_the_documented_keys(table, path):
    assert set(at(table, path)) == set(KEYS[path].split())


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("adaptation_s", {"A": 1.0, "D": 0.8}),
        ("frozen_residual_max_Nm.A.identified", None),
        ("contacts.1.direction", [-1, -1]),
        ("false_alarms_s", [8.95]),
        ("missed", 1),
        ("payload_kg", {"A": 0.0, "D": 1.0}),
        ("cycle.count", 9350),
        ("timing.data_age_cycles", [9350, *[0] * 10]),
        ("log", {"name": "run.mcap", "frames": 12, "dropped": 0, "is_complete": True, "problem": ""}),
        ("run.seed", "7"),
    ],
)
def test_the_table_says_what_happened(table, path, value):
    assert at(table, path) == value


def table_of(run):
    return report_json(evaluated(run), run.metadata, SOURCE)


def test_the_text_says_what_went_wrong_what_to_do_and_where_the_page_is(report):
    lines = report.as_text().splitlines()
    assert lines[0].startswith("NOT GOOD: 2 of 3 contacts detected within 5 ms, 1 missed")
    assert [line.split()[0] for line in lines if line[:1].isdigit() and " s " in line] == ["3"]  # the one missed
    commands = ["adacd-hil thresholds run.mcap", "adacd-hil tune run.mcap"]
    assert [line.strip() for line in lines if line.startswith("    ")] == commands
    assert lines[-1] == f"Report: {report.html_path}"


def test_the_headline_of_a_log_that_is_not_whole_is_its_problem_unless_the_run_went_wrong(report, tmp_path):
    cut = ReportSource("run.mcap", "cut after 12 s", is_complete=False)
    assert replace(report, source=cut).as_text().splitlines()[1] == f"- {cut.notice}"
    made = written(make_run((A, 1000), (M, 1000)), tmp_path, cut)
    assert made.metrics.is_clean
    assert made.as_text().startswith(f"NOT GOOD: {cut.notice}\n")
    page = made.html_path.read_text(encoding="utf-8")
    assert (f"<h1>{cut.notice}</h1>" in page.replace("\u00a0", " "), '<header class="bad">' in page) == (True, True)


def test_the_page_is_well_formed_and_has_no_inline_style_and_no_foreign_element(html):
    page = Page(html)
    assert (page.unbalanced, page.open) == ([], [])
    assert page.tags & {"iframe", "object", "img", "link"} == set()
    assert [(name, value) for name, value in page.attributes if name == "style" or name.startswith("on")] == []
    ids = [value for name, value in page.attributes if name == "id"]
    assert len(ids) == len(set(ids))
    assert len(html.encode()) < 5_000_000


SCRIPT = re.compile(r"<script>(.*?)</script>", re.DOTALL)
POLICY = re.compile(r'Content-Security-Policy" content="([^"]*)"')


def test_the_page_refers_to_nothing_outside_and_its_scripts_ask_for_nothing(html):
    assert re.search(r"https?://|url\((?!#)|@import|src=", SCRIPT.sub("", html)) is None
    asking = r"\b(fetch|XMLHttpRequest|WebSocket|EventSource|sendBeacon|importScripts|Worker|eval)\b|\bimport\s*\("
    assert [re.search(asking, script) for script in SCRIPT.findall(html)] == [None, None]


def digests_of(texts):
    digests = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in texts)
    return " ".join(f"'sha256-{digest}'" for digest in digests)


def test_the_policy_allows_the_pages_own_styles_and_scripts_and_nothing_else(html):
    styles = digests_of(re.findall(r"<style>(.*?)</style>", html, re.DOTALL))
    scripts = digests_of(SCRIPT.findall(html))
    allowed = f"style-src {styles}; script-src {scripts}"
    assert POLICY.findall(html) == [f"default-src 'none'; {allowed}; base-uri 'none'; form-action 'none'"]


@pytest.mark.long
def test_a_page_without_traces_allows_no_script(tmp_path):
    html = written(make_run((A, 1)), tmp_path).html_path.read_text(encoding="utf-8")
    (policy,) = POLICY.findall(html)
    assert ("script-src" in policy, "<script" in html) == (False, False)


def test_the_gravest_finding_is_the_pages_heading_and_the_others_a_list_below_it(html, report):
    heading = re.search(r"<h1>(.*?)</h1>", html)[1].replace("\u00a0", " ")
    further = re.findall(r"<li>(.*?)</li>", re.search(r'<ul class="further">(.*?)</ul>', html, re.DOTALL)[1])
    assert heading.startswith("2 of 3 contacts detected within 5 ms, 1 missed")
    assert (len(heading.split()), len(further)) == (13, 1)


def test_the_first_screen_of_a_bad_run_has_one_cause_and_a_list():
    run = make_run((A, 100), (SchemeState.FAULT, 50), (A, 100), (SchemeState.FAULT, 50))
    cause = "drive1: " + "an error with a very long name, " * 30
    run = replace(run, events=(LoggedEvent(int(run.t_ns[100]), Event("error", "supervisor", f"x; {cause}")),))
    first, *further = headlines(evaluated(run), SOURCE)
    assert (first[:30], len(first) <= 160, len(further) >= 2) == ("FAULT (DRIVE) at 0.10 s: drive1"[:30], True, True)
    again = make_run((A, 1000), (M, 500), (SchemeState.PAYLOAD, 20), (A, 100))
    assert "not again" in headlines(evaluated(again), SOURCE)[0]


def test_the_headline_of_a_value_outside_its_bounds_has_the_value():
    run = make_run((A, 100), (SchemeState.FAULT, 50), reason=FaultReason.SENSOR)
    bound = ValueBound("torque_of_channel_2 - torque_of_channel_1", "Nm", 0, 1, -0.2, 0.2)
    cause = f"Sensor1: {bound.describe((4.05156, 0.2))}"
    run = replace(run, events=(LoggedEvent(int(run.t_ns[100]), Event("error", "supervisor", f"x; {cause}")),))
    assert headlines(evaluated(run), SOURCE)[0].endswith(cause)


def test_every_curve_of_the_plan_has_its_place_on_the_page(html):
    plan = json.loads(re.search(r'id="trace-plan">(.*?)</script>', html)[1])
    planned = {f"panel-{panel['name']}" for track in plan["tracks"] for panel in track["panels"]}
    assert set(re.findall(r'<figure class="trace scripted" id="([^"]*)"', html)) == planned
    assert {"panel-residual1", "panel-theta-a1", "panel-time-slack", "panel-queues"} <= planned


def row_of(html, title):
    """Give the cells of the row of a table that begins with a title."""
    row = re.search(rf"<tr><td[^>]*>(?:<b>)?{re.escape(title)}.*?</tr>", html)[0]
    return re.findall(r"<td[^>]*>(.*?)</td>", row)[1:]


def test_the_page_tables_the_times(html):
    titles = ("Lateness", "SYNC → command", "Reaction", "Slack", "periods skipped", "queue to the log", "0")
    assert {title: row_of(html, title) for title in titles} == {
        "Lateness": ["4.7", "9.3", "9.3", "9.3"],
        "SYNC → command": ["604.7", "609.3", "609.3", "609.3"],
        "Reaction": ["204.0", "209.0", "209.0", "209.0"],
        "Slack": ["166.2", "−62.8", "−67.0", "−67.5"],
        "periods skipped": ["349", "3732.6"],
        "queue to the log": ["18512", "18698"],
        "0": ["9350", "100.000 %"],
    }


def tables_of(run):
    return render("timing.html.j2", timing=timing_tables(evaluated(run).timing), traces=None)


def test_lockstep_times_are_said_to_be_modelled_and_a_run_without_a_reaction_has_dashes():
    html = tables_of(make_run())
    assert "Lockstep: these are times of the model of bus and host" in html
    assert row_of(html, "Reaction") == ["–"] * 4


def test_the_page_of_a_log_without_cycles_is_well_formed(tmp_path):
    page = Page(written(without_cycles(make_run((A, 1))), tmp_path).html_path.read_text("utf-8"))
    assert page.unbalanced == []


@pytest.mark.long
def test_a_folder_that_cannot_be_made_is_a_log_error(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(LogError, match=r"report in .*taken can't be written"):
        written(make_run((A, 10)), tmp_path / "taken")


@pytest.mark.parametrize(
    ("attachments", "why"),
    [
        ({}, r"run\.mcap has no attachment config\.toml"),
        ({"config.toml": b"[fliter]\n"}, r"config\.toml: unknown key `fliter`; did you mean `filter`"),
    ],
)
def test_a_log_without_a_readable_configuration_cannot_be_reported(tmp_path, attachments, why):
    record(tmp_path / "run.mcap", make_run((A, 10)), attachments)
    with pytest.raises(LogError, match=why):
        write_report(tmp_path / "run.mcap", None, tmp_path)


BROWSE = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[2] / "tools" / "browse_report.py")))
in_chromium = pytest.mark.skipif(BROWSE.chromium() is None, reason="no Chromium to open the page in")


@pytest.mark.long
@in_chromium
def test_a_browser_opens_the_page_without_a_word(report):
    seen = BROWSE.browse(report.html_path)
    assert (seen.complaints, seen.requests) == ([], [])


LISTEN = """Object.defineProperty(window, "uPlot", { get() { return this.made; }, set(value) {
  const plots = this.plots = [];
  this.made = class extends value { constructor(...parts) { super(...parts); plots.push(this); } };
} });"""
"""Keeps the panels within reach as uPlot makes them."""
DRAWN_DATA = "plots[0].data"
MIDDLE_OF_A_PANEL = """(() => {
  document.querySelector("#panel-residual1").scrollIntoView({ behavior: "instant" });
  const box = document.querySelector("#panel-residual1 .u-over").getBoundingClientRect();
  return [box.left + box.width / 2, box.top + box.height / 2];
})()"""
LEGEND = """new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(() => resolve(
  [...document.querySelectorAll("#panel-residual1 .u-value")].map((cell) => cell.textContent)))))"""


@pytest.fixture(scope="module")
def panel(report):
    """Give what the panel of joint 1's residual draws of the whole run, of a contact, and its legend in the middle."""
    with BROWSE.open_tab(BROWSE.chromium()) as tab:
        tab.ask("Page.enable")
        tab.ask("Page.addScriptToEvaluateOnNewDocument", source=LISTEN)
        tab.ask("Page.navigate", url=report.html_path.as_uri())
        tab.evaluate(BROWSE.DRAWN)
        whole = tab.evaluate(DRAWN_DATA)
        tab.evaluate(BROWSE.CLOSER)
        x, y = tab.evaluate(MIDDLE_OF_A_PANEL)
        tab.ask("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        legend = [text.replace("−", "-") for text in tab.evaluate(LEGEND)]
        return SimpleNamespace(whole=whole, closer=tab.evaluate(DRAWN_DATA), legend=legend)


HALF_A_STEP = 0.51e-3


@in_chromium
def test_the_whole_run_is_drawn_by_the_smallest_and_the_largest_value_of_each_pixel(panel):
    run = touched_run()
    times_s, cad = np.array(panel.whole[0]), np.array(panel.whole[1])
    starts = np.searchsorted(run.time_s(), times_s[::2] - 5e-4)
    low, high = (extreme.reduceat(run.tau_ext_hat_cad[:, 0], starts) for extreme in (np.minimum, np.maximum))
    assert len(times_s) < len(run.cycle) / 3
    np.testing.assert_allclose(cad[::2], low, rtol=0, atol=HALF_A_STEP)
    np.testing.assert_allclose(cad[1::2], high, rtol=0, atol=HALF_A_STEP)


@in_chromium
def test_a_contact_is_drawn_cycle_by_cycle(panel):
    run = touched_run()
    times_s, cad = np.array(panel.closer[0]), np.array(panel.closer[1])
    rows = np.flatnonzero((run.time_s() > times_s[0] - 5e-4) & (run.time_s() < times_s[-1] + 5e-4))
    assert rows.size == pytest.approx(750, abs=5)
    np.testing.assert_allclose(times_s, run.time_s()[rows], rtol=0, atol=1e-5)
    np.testing.assert_allclose(cad, run.tau_ext_hat_cad[rows, 0], rtol=0, atol=HALF_A_STEP)


@in_chromium
def test_the_legend_has_the_values_under_the_cursor(panel):
    run = touched_run()
    at_s, cad, ours = (float(panel.legend[place]) for place in (0, 1, 2))
    row = int(np.argmin(np.abs(run.time_s() - at_s)))
    assert at_s == pytest.approx(1.95 - 0.15 + 0.375, abs=0.005)  # in the middle of what a contact's card shows
    assert (cad, ours) == pytest.approx((run.tau_ext_hat_cad[row, 0], run.tau_ext_hat[row, 0]), abs=1.1e-3)
