"""Next steps for the reader of a report: a sentence each, with the command for it, the gravest first.

Commands of a page are for the folder of the log: they name it by its file name alone, so that the same log gives the
same page wherever it lies. Names are quoted for the shell.
"""

import shlex
from importlib import resources
from typing import NamedTuple

from adacd_hil.clock import LOCKSTEP
from adacd_hil.lab.report.page import STEPS, went_wrong
from adacd_hil.lab.score.metrics import Metrics, ReportSource
from adacd_hil.lab.score.run_arrays import EMULATOR, Run
from adacd_hil.lab.score.run_faults import find_breaks
from adacd_hil.lab.score.verdict import is_margin_below_1, is_revoked, shows_nothing, withheld_text
from adacd_hil.log.log_files import EMBEDDED
from adacd_hil.printable import in_line
from adacd_hil.settings.toml_files import builtin_names, toml_names


class NextStep(NamedTuple):
    """A next step, and the command for it; "" for a step without a command."""

    text: str
    command: str = ""


def next_steps(metrics: Metrics, run: Run, source: ReportSource) -> tuple[list[NextStep], list[NextStep]]:
    """Return the next steps, the gravest first, STEPS at most, and a second list with the further ones."""
    log = _quoted(source.log_name)
    steps = [NextStep("The log is not whole: see what it lacks.", f"adacd-hil log check {log}")] * bool(
        source.log_problem
    )
    if shows_nothing(run, metrics) and not (metrics.fault or find_breaks(run)):
        return [*steps, NextStep("Report the whole run.")], []
    if run.cycle.size == 0:
        return [*steps, _checked(run, source, "The arm was not moved. Mend the cause above.")], []
    steps += _repairs(metrics, run, source)
    key = "filter.a_rad_s=20" if metrics.evidence is None else "certified.noise_sigmas=8"
    more = [
        NextStep("Check that the log replays to the same decisions.", f"adacd-hil replay {log}"),
        NextStep("See what another setting would have decided.", f"adacd-hil replay {log} --set {key}"),
    ]
    if run.truth is None and metrics.contacts:
        more.insert(0, NextStep("Compare the detections with what you did: the log has no record of the touches."))
    if not steps:
        steps = [NextStep("Nothing to do: all went well.")] * (metrics.is_clean and not source.truth_problem) + more[:1]
        more = more[1:]
    return steps[:STEPS], steps[STEPS:] + more


def _repairs(metrics: Metrics, run: Run, source: ReportSource) -> list[NextStep]:
    """Return a next step for each kind of failure that the run shows; [] if there is none.

    If the run stopped, late frames and a model that was not learned have no step of their own.
    """
    log = _quoted(source.log_name)
    has_stopped = bool(metrics.fault or find_breaks(run)) or (not metrics.adaptation_s and not run.is_part)
    stopped = _checked(run, source, "Mend the cause above.")
    late = _checked(run, source, "Frames came late or were lost, more than allowed.")
    rows = (
        (has_stopped, stopped),
        (not has_stopped and bool(metrics.data.excesses), late),
        (
            is_revoked(metrics.evidence),
            NextStep("The certificate was taken back. Remove the cause, then let the arm learn anew, untouched."),
        ),
        (
            bool(withheld_text(run)) and None not in metrics.adaptation_s.values(),
            NextStep("The arm was certified late. Leave it untouched while it learns; if nobody touched it, the "
                     "notices name the remedy."),
        ),
        (
            not has_stopped and not run.is_cut and None in metrics.adaptation_s.values(),
            NextStep("The model was not learned; the notices may say why. Try another motion.",
                     f"adacd-hil excitation --config {_configuration(run, source)}"),
        ),
        (
            (any(metrics.adaptation_s.values()) and bool(metrics.false_alarms)) or is_margin_below_1(metrics.evidence),
            NextStep("Nobody touched the arm, and a threshold was crossed. If a load was picked up or put down, "
                     "announce it by `payload`; else find thresholds from untouched motion.",
                     f"adacd-hil thresholds {log}"),
        ),
        (
            any(went_wrong(contact) for contact in metrics.contacts),
            NextStep("Contacts were missed, or their link or direction is wrong. Try other thresholds and filters.",
                     f"adacd-hil tune {log}"),
        ),
    )  # fmt: skip
    return [step for is_so, step in rows if is_so]


def _checked(run: Run, source: ReportSource, text: str) -> NextStep:
    """Return a next step: `text`, and the `doctor` command for host, bus and arm.

    For an arm that was emulated in the host's process, or a log that names no interface, the command is `demo`, to play
    the run again.
    """
    interface, channel = run.metadata.get("interface", ""), run.metadata.get("channel", "")
    if interface in ("", EMBEDDED):
        played = f" --scenario {_scenario(run, source)}" if run.metadata.get("scenario") else ""
        played += f" --truth {_truth(run, source)}" if run.metadata.get("truth") else ""
        return NextStep(f"{text} Play it again.", f"adacd-hil demo --config {_configuration(run, source)}{played}")
    bus = f"-i {_quoted(interface)} -c {_quoted(channel or 'can0')}"
    return NextStep(
        f"{text} Check host, bus and arm before the next run.",
        f"adacd-hil doctor {bus} --config {_configuration(run, source)}",
    )


def _configuration(run: Run, source: ReportSource) -> str:
    """Return a run's configuration for a command, quoted for the shell.

    Where the source lacks it, the name in the log's metadata if it is built in, else `<name>.toml`; `my-arm.toml`
    without a name.
    """
    name = run.metadata.get("config", "")
    return _quoted(source.config or (name if name in builtin_names() else f"{name or 'my-arm'}.toml"))


def _scenario(run: Run, source: ReportSource) -> str:
    """Return a run's scenario for `demo`, quoted for the shell.

    Where the source lacks it, the name in the log's metadata, which must have one; with ".toml" unless it is built in.
    """
    name = run.metadata["scenario"]
    is_builtin = name in toml_names(resources.files("firmware_sim") / "scenarios")
    return _quoted(source.scenario or (name if is_builtin else f"{name}.toml"))


def _truth(run: Run, source: ReportSource) -> str:
    """Return a run's truth for `demo`, quoted for the shell.

    Where the source lacks it, the name in the log's metadata, which must have one; with ".toml" if a digest stands
    behind it.
    """
    name, *digest = run.metadata["truth"].split()
    return _quoted(source.truth or (f"{name}.toml" if digest else name))


def _quoted(text: str) -> str:
    return shlex.quote(in_line(text))


def origin_words(run: Run) -> list[str]:
    """Return phrases on a run's arm, bus, scenario, truth and version, without those that the log doesn't name."""
    said = run.metadata
    name, profile, interface = said.get("config", ""), said.get("profile", ""), said.get("interface", "")
    is_own = name not in builtin_names()
    words = [f"arm {name}" if is_own else f"configuration {name}, arm profile {profile}"] if name else []
    if interface == EMBEDDED:
        words.append("emulated arm" + (", simulated time" if said.get("clock") == LOCKSTEP else ""))
    elif interface:
        words.append(f"on {interface} {said.get('channel', '')}".strip())
    if said.get("scenario"):
        words.append(f"scenario {said['scenario']}")
    if truth := said.get("truth", said.get(EMULATOR + "truth")):
        words.append(f"truth {truth}")
    if "version" in said:
        words.append(f"adacd-hil {said['version']}")
    return words
