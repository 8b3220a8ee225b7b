"""The report for somebody who never read the paper: contrast, names of states, no paper where it was not played."""

import re
import shlex
from dataclasses import replace
from importlib import resources

import pytest
from hand_made_run import A, M, evaluated, make_certified_run, make_run, touched_run, without_cycles

from adacd_hil.lab.report.next_steps import NextStep, next_steps, origin_words
from adacd_hil.lab.report.page import has_paper
from adacd_hil.lab.report.run_page import report_page
from adacd_hil.lab.score.metrics import ReportSource
from adacd_hil.lab.score.report_wording import STATE_WORDS, uncertain_text
from adacd_hil.lab.score.run_arrays import Run
from adacd_hil.log.reader import LoggedEvent
from adacd_hil.records import BEGINS_ANEW, Event, SchemeState

SOURCE = ReportSource("run.mcap")
CSS = resources.files("adacd_hil.lab.report").joinpath("assets", "report.css").read_text(encoding="utf-8")
LIGHT, DARK = (
    dict(re.findall(r"--(\w+): (#[0-9a-f]{6})", block))
    for block in re.findall(r":root[^{]*\{([^}]*--page[^}]*)\}", CSS)
)
GROUNDS = ("page", "paper", "adaptation", "detection", "payload", "fault", "certify", "react", "stopped")
CURVES = ("identified", "cad", "beside", "joint1", "joint2", "alarm", "bar", "queue_receive", "queue_transmit")


def luminance(colour: str) -> float:
    """Relative luminance by WCAG 2.2."""
    channels = (int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5))
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    darker, lighter = sorted((luminance(one), luminance(other)))
    return (lighter + 0.05) / (darker + 0.05)


@pytest.mark.parametrize("colours", [LIGHT, DARK], ids=["light", "dark"])
def test_text_and_curves_are_told_from_their_ground(colours):
    text = {(ink, ground): contrast(colours[ink], colours[ground]) for ink in ("ink", "muted") for ground in GROUNDS}
    text |= {
        (ink, ground): contrast(colours[ink], colours[ground])
        for ink in ("alarm", "good", "identified")
        for ground in GROUNDS[:2]
    }
    text["ink", "touch"] = contrast(colours["ink"], colours["touch"])  # a contact's number on its band
    assert {pair: ratio for pair, ratio in text.items() if ratio < 4.5} == {}  # WCAG AA
    curves = {curve: contrast(colours[curve], colours["paper"]) for curve in CURVES}
    assert {curve: ratio for curve, ratio in curves.items() if ratio < 3.0} == {}


def test_every_state_has_a_name_in_words():
    assert set(STATE_WORDS) == set(SchemeState)
    assert len(set(STATE_WORDS.values())) == len(SchemeState)


def steps_of(run: Run, source: ReportSource = SOURCE) -> list[NextStep]:
    steps, more = next_steps(evaluated(run), run, source)
    return [*steps, *more]


def test_a_good_run_needs_nothing_and_says_so():
    nothing, *further = steps_of(make_run((A, 1000), (M, 1000)))
    assert nothing.text == "Nothing to do: all went well."
    replayed = "adacd-hil replay run.mcap"
    assert [step.command for step in further] == [replayed, f"{replayed} --set filter.a_rad_s=20"]


def test_a_run_whose_certificate_was_withheld_first_names_it_and_does_not_call_all_well():
    run = make_certified_run()
    assert steps_of(run)[0].text == "Nothing to do: all went well."
    refused = Event("warning", "touch", f"an offset; {BEGINS_ANEW}; `accept` says so")
    texts = [step.text for step in steps_of(replace(run, events=(LoggedEvent(run.zero_ns, refused),)))]
    assert texts[0].startswith("The arm was certified late. Leave it untouched")
    assert "Nothing to do: all went well." not in texts


def on_a_bus(run: Run, **said: str) -> Run:
    return replace(run, metadata={"interface": "socketcan", "channel": "can1", "config": "lab", **said})


def faulted(**said: str) -> Run:
    return on_a_bus(make_run((A, 100), (SchemeState.FAULT, 50)), **said)


def test_a_fault_on_a_bus_leads_to_the_doctor_of_that_arm_and_to_nothing_else_on_the_first_screen():
    run = faulted()
    page = report_page(evaluated(run), run, SOURCE)
    first, _, folded = page.partition("<details")
    assert re.findall(r"<code>(.*?)</code>", first) == ["adacd-hil doctor -i socketcan -c can1 --config lab.toml"]
    assert ("false alarms</dt>" in page, "adacd-hil replay run.mcap" in folded) == (False, True)


def test_a_fault_of_an_emulated_arm_is_played_again():
    run = faulted(interface="embedded", config="certified", scenario="idle")
    assert steps_of(run)[0].command == "adacd-hil demo --config certified --scenario idle"
    own = faulted(interface="embedded", config="certified", scenario="my-hit")
    assert steps_of(own)[0].command == "adacd-hil demo --config certified --scenario my-hit.toml"


def test_a_run_without_a_cycle_is_not_told_to_be_replayed():
    run = make_run((A, 1))
    steps, more = next_steps(evaluated(run), on_a_bus(without_cycles(run)), SOURCE)
    assert ([step.command.split()[1] for step in steps], more) == (["doctor"], [])


def test_what_a_log_says_of_itself_is_quoted_for_the_shell():
    steps = steps_of(faulted(config="$(reboot)\n;", channel="a b", interface="-x;y"), ReportSource("a'b.mcap"))
    words = ["adacd-hil", "doctor", "-i", "-x;y", "-c", "a b", "--config", "$(reboot)\\u000a;.toml"]
    assert shlex.split(steps[0].command) == words
    assert "\n" not in steps[0].command
    assert shlex.split(steps[-2].command)[-1] == "a'b.mcap"


def test_the_head_names_an_emulated_arm_as_such():
    emulated = on_a_bus(make_run(), config="paper", profile="P", interface="embedded", clock="lockstep", version="1")
    assert origin_words(emulated)[:2] == ["configuration paper, arm profile P", "emulated arm, simulated time"]


def test_the_papers_numbers_are_those_of_its_arm_alone():
    run = touched_run()
    own = on_a_bus(run)
    own = replace(own, settings=replace(run.settings, arm=replace(run.settings.arm, link_length_m=(0.4, 0.3))))
    assert (has_paper(evaluated(run)), has_paper(evaluated(own))) == (True, False)
    page = report_page(evaluated(own), own, SOURCE)
    assert "eq. (15)" not in page.partition("How it is computed")[0]
    assert "<h2>Measured</h2>" in page
    assert "run report · arm lab · on socketcan can1</p>" in page


def test_notices_are_written_out_below_the_timeline():
    run = make_run((A, 1000), (M, 1000))
    event = LoggedEvent(int(run.t_ns[500]), Event("warning", "bus", "slow <&>"))
    run = replace(run, events=(event,) * 14)
    page = report_page(evaluated(run), run, SOURCE)
    assert page.count("bus: slow &lt;&amp;&gt;</li>") == 12
    assert "The first 12 of 14 notices." in page


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (-0.0012, 0.0004, "−0.0012 ± 0.0004 Nm"),
        (-0.0001, 0.004, "0.000 ± 0.004 Nm"),
        (0.5, 1e-9, "0.500000 ± 0.000000 Nm"),
        (0.5, None, "–"),
    ],
)
def test_a_small_deviation_does_not_read_as_none(value, sigma, text):
    assert uncertain_text(value, sigma, 3, "Nm") == text


def test_certificates_are_told_clause_by_clause_and_one_that_was_taken_back_is_marked():
    run = make_certified_run()
    told = (("certificate", "offsets anchored; a <push>"), ("revoked", "the load changed"), ("sight", "not of it"))
    events = (LoggedEvent(int(run.t_ns[1100 + row]), Event("info", *each)) for row, each in enumerate(told))
    run = replace(run, events=tuple(events))
    page = report_page(evaluated(run), run, SOURCE)
    section = page.partition("<h2>Certificates</h2>")[2].partition("</details>")[0]
    assert re.findall(r"<li>(.*?)</li>", section) == ["offsets anchored", "a &lt;push&gt;", "the load changed"]
    assert len(re.findall(r"<p>Given at \d+\.\d\d s:", section)) == 1
    assert len(re.findall(r'<p class="bad">Taken back at', section)) == 1
    bare = replace(run, events=())
    assert "<h2>Certificates</h2>" not in report_page(evaluated(bare), bare, SOURCE)
