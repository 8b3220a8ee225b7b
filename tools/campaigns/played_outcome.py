"""The outcome of a played scenario, and its differences from what the scenario expects."""

from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

from adacd_hil.control.session import SessionSummary
from adacd_hil.lab.report.run_reading import read_run
from adacd_hil.lab.score.evaluation import evaluate
from adacd_hil.records import FaultReason
from firmware_sim.scenario.scenario import COUNTS, ExpectSettings, Scenario


class ScenarioOutcome(NamedTuple):
    """The outcome of a run, named as in `ExpectSettings`. Times, s, since motion start; None: it did not happen.

    fault: reason of the first fault. adaptation_s: of the first adaptation. delay_ms: the longest of all detected
    contacts, None without any. force_N: largest true contact force, 0 without any.
    """

    end: str
    fault: str | None
    fault_s: float | None
    adaptations: int
    adaptation_s: float | None
    contacts: int
    false_alarms: int
    missed: int
    delay_ms: float | None
    force_N: float

    @property
    def text(self) -> str:
        """The outcome in a few words, in the form of `ExpectSettings.text`."""
        return ExpectSettings(
            adaptations=self.adaptations,
            contacts=self.contacts,
            false_alarms=self.false_alarms,
            missed=self.missed,
            end=self.end,
            fault=self.fault,
        ).text


def outcome_of(summary: SessionSummary, truth_path: Path) -> ScenarioOutcome:
    """Return the outcome of a finished run by its logs, as a scenario's `expect` describes it. Raises LogError."""
    run, gathered, _ = read_run(summary.log.path, truth_path)
    metrics = evaluate(run, gathered)
    force_N = None if run.truth is None else run.truth.force_N
    took_s = list(metrics.adaptation_s.values())
    found = [contact for contact in metrics.contacts if contact.delay_ms is not None]
    return ScenarioOutcome(
        end=_end(summary),
        fault=metrics.fault,
        fault_s=metrics.fault_s,
        adaptations=sum(time_s is not None for time_s in took_s),
        adaptation_s=took_s[0] if took_s else None,
        contacts=len(found),
        false_alarms=metrics.false_alarms or 0,
        missed=metrics.missed or 0,
        delay_ms=max((contact.delay_ms for contact in found if contact.delay_ms is not None), default=None),
        force_N=0.0 if force_N is None else float(force_N.max(initial=0.0)),
    )


def _end(summary: SessionSummary) -> str:
    """Return the name of the run's end, as in `firmware_sim.scenario.scenario`."""
    if not summary.has_started:
        return "refused"
    if summary.result is None:
        return "lost"
    return "finished" if summary.result.fault is FaultReason.NONE else "fault"


def expected_of(scenario: Scenario, scheme: str) -> ExpectSettings | None:
    """Return the expected outcome with a healthy host of a scheme, `paper` or `certified`.

    `certified`: `expect_certified` if the file has that. Otherwise `expect`, None if the file lacks it.
    """
    own = scenario.expect_certified if scheme == "certified" else None
    return own or scenario.expect


def deviations(expect: ExpectSettings, outcome: ScenarioOutcome) -> tuple[str, ...]:
    """Return the differences of an outcome from an expectation, a line each; () if it is as expected.

    A time that is expected within bounds but is None is a difference. A bound on delay or force is not checked where
    the outcome is None.
    """
    found = []
    for key in ("end", "fault"):
        wanted, got = getattr(expect, key), getattr(outcome, key)
        if got != wanted:
            found.append(f"{key}: {got or 'none'}, expected {wanted or 'none'}")
    for key in COUNTS:
        least, most, got = getattr(expect, key), getattr(expect, f"{key}_most"), getattr(outcome, key)
        if not least <= got <= (least if most is None else most):
            found.append(f"{key}: {got}, expected {least if most is None else f'{least} to {most}'}")
    for key in ("fault_s", "adaptation_s"):
        pair, time_s = getattr(expect, key), getattr(outcome, key)
        if pair is not None and not (time_s is not None and pair[0] <= time_s <= pair[1]):
            found.append(f"{key}: {_number(time_s)} s, expected {pair[0]:g} to {pair[1]:g} s")
    for key in ("delay_ms", "force_N"):
        bound, got = getattr(expect, key), getattr(outcome, key)
        if bound is not None and got is not None and got > bound:
            unit = next(field.metadata["unit"] for field in fields(ExpectSettings) if field.name == key)
            found.append(f"{key}: {_number(got)} {unit}, expected at most {bound:g} {unit}")
    return tuple(found)


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.4g}"
