"""The findings of a run, failures first, and its headlines; and the run beside the paper's printed figures.

The paper's numbers are those of its experiment: a run that played anything else is shown without them. Beside them
stands the result of the paper's scheme on the same stream, where it ran beside.
"""

import itertools
import textwrap
from collections.abc import Sequence
from functools import cache
from typing import Final, TypeGuard

import numpy as np

from adacd_hil.lab.score.metrics import (
    Beside,
    CertifiedEvidence,
    CyclicData,
    Fault,
    Finding,
    Metrics,
    PaperRow,
    ReportSource,
)
from adacd_hil.lab.score.report_wording import percent_text, score_sentence
from adacd_hil.lab.score.run_arrays import EMULATOR, Run, Section
from adacd_hil.lab.score.run_faults import Break
from adacd_hil.lab.score.run_judge import uncovered_watch
from adacd_hil.log.logged_run import is_armed_in
from adacd_hil.printable import number_of
from adacd_hil.records import BEGINS_ANEW, JOINTS
from adacd_hil.score.judge import Score
from adacd_hil.score.smallest_push import PUSH_WITHIN
from adacd_hil.score.wording import NONE, found_text
from adacd_hil.settings.arm_settings import ArmSettings
from adacd_hil.settings.configuration_files import load_settings

LISTED: Final = 4
"""Adaptations that are listed one by one."""
_BESIDE: Final = "the paper's scheme on the same stream"
_SHOWS_NOTHING: Final = "this part of the run has no whole adaptation and no cycle in MONITOR: nothing can be judged"
_NO_LOSS: Final = "no cyclic data was late or lost"


def list_findings(
    run: Run, metrics: Metrics, score: Score, faults: tuple[Fault, ...], breaks: tuple[Break, ...]
) -> tuple[Finding, ...]:
    """Return the findings of a run: failures first, then contacts, adaptations and cyclic data, each bad or not.

    A run without cycles has one bad finding.
    """
    if run.cycle.size == 0 and not run.is_cut:
        cause = "; ".join(each.cause for each in breaks) or "the log does not say why"
        return (Finding(f"no cycle was run: {cause}", True),)
    if run.cycle.size == 0:
        return (Finding(_SHOWS_NOTHING, True),)
    evidence, data = metrics.evidence, metrics.data
    adaptation_s = _judged_adaptations(run, metrics)
    done = "identified" if evidence is None else "certified"
    identified = identified_text(adaptation_s, metrics.payload_kg, begun_anew(metrics.sections), done)
    found = score_sentence(score)
    has_wrong = score.missed > 0 or (run.truth is not None and bool(score.false_alarms))
    if run.truth is None:
        found = f"{number_of(len(score.false_alarms), 'detection')}, whose truth is not recorded"
    elif not has_wrong and not score.contacts and all(section.kind != "detection" for section in metrics.sections):
        found = "the arm was not watched for contacts"
    else:
        found = _judged_text(run, found)
    if evidence is not None and not evidence.is_anchored:
        identified += ", with torque offsets that nothing anchors"
    beside = ""
    if evidence is not None and evidence.paper_beside is not None and is_papers_experiment(run):
        beside = _beside_text(list(evidence.paper_beside.adaptation_s.values()))
    grave = _fault_texts(faults)
    for is_last, what in ((True, "the run was broken off"), (False, "the run was broken off and began anew")):
        causes = [each.cause for each in breaks if each.is_last == is_last]
        grave += [f"{what}: {'; '.join(causes)}"] if causes else []
    grave += evidence.revoked if is_revoked(evidence) else ()
    grave += filter(None, [_blind_text(run)])
    if is_margin_below_1(evidence):
        margin = f"smallest margin {evidence.smallest_margin:.2f}"
        grave.append(f"a residual was over its threshold with nobody touching the arm: {margin}")
    findings = [*(Finding(text, True) for text in grave), Finding(found, has_wrong)]
    misread = [contact for contact in metrics.contacts if contact.link_ok is False or contact.direction_ok is False]
    if misread:
        findings.append(Finding(f"link or direction of {number_of(len(misread), 'contact')} is wrong", True))
    if shows_nothing(run, metrics):
        findings.append(Finding(_SHOWS_NOTHING, True))
    elif adaptation_s or not run.is_part:  # a part of a run need not have any
        findings.append(Finding(identified, not adaptation_s or None in adaptation_s.values()))
    findings += [Finding(withheld_text(run)), Finding(beside), Finding(data_text(data), bool(data.excesses))]
    return tuple(finding for finding in findings if finding.text)


def shows_nothing(run: Run, metrics: Metrics) -> bool:
    """Return whether a part of a run has neither a detection section nor an adaptation: then nothing can be judged.

    In a log that was cut, an adaptation without its end doesn't count. False for a whole run.
    """
    is_watched = any(section.kind == "detection" for section in metrics.sections)
    return run.is_part and not is_watched and not _judged_adaptations(run, metrics)


def _judged_adaptations(run: Run, metrics: Metrics) -> dict[str, float | None]:
    """Return the adaptations of a run by label: their time, s, None for one without an end.

    Of a cut log only those that came to their end, as the cut may have ended others.
    """
    times_s = metrics.adaptation_s
    return {label: time_s for label, time_s in times_s.items() if time_s is not None or not run.is_cut}


def _judged_text(run: Run, found: str) -> str:
    """Return `found`, with the time that the truth covers unless it covers all of MONITOR.

    If it covers nothing of MONITOR, return words on that instead.
    """
    uncovered = uncovered_watch(run)
    if not uncovered.any():
        return found
    is_told = is_armed_in(run.state) & ~uncovered
    if not is_told.any():
        return "the arm was watched, but the truth of that time is not recorded"
    first_s, last_s = run.time_s()[is_told][[0, -1]]
    return f"{found}, from {first_s:.2f} to {last_s:.2f} s: the truth covers no more"


def _blind_text(run: Run) -> str:
    """Return a text on the cycles of MONITOR in which no touch of some joint can be told, "" without.

    In such a cycle each channel of the joint has a threshold above the joint's rated torque, or a residual that isn't
    finite. The first cycle of each stay in MONITOR isn't looked at.
    """
    by = run.certified
    values = (run.tau_ext_hat, run.threshold) if by is None else (by.tau_ext, by.threshold)
    can_alarm = np.isfinite(values[0]) & (values[1] <= np.array(run.settings.arm.rated_torque_Nm))
    sees = np.any(can_alarm.reshape(len(run.state), -1, JOINTS), axis=1)
    watched = is_armed_in(run.state) & np.concatenate(([False], is_armed_in(run.state[:-1])))
    share = 1.0 - float(np.all(sees[watched], axis=1).mean()) if watched.any() else 0.0
    return (
        f"a joint was blind in {percent_text(share)} of MONITOR: no residual, or no threshold up to its rated torque"
        if share
        else ""
    )


_HEADLINE_LETTERS: Final = 160
"""Enough for a fault's device, a difference of two signals with long names, its value and its bounds."""


def is_good(metrics: Metrics, source: ReportSource) -> bool:
    """Return whether a report is good: no finding is bad, and log and truth have all that the findings are about."""
    return metrics.is_clean and source.is_complete


def headlines(metrics: Metrics, source: ReportSource) -> list[str]:
    """Return the lines of a first screen: bad findings, the whole notice on log and truth, the other findings.

    A finding is cut at `_HEADLINE_LETTERS`. Findings on the paper's scheme beside, and on cyclic data without a loss,
    are left out.
    """
    lines: dict[bool, list[str]] = {True: [], False: [source.notice] if source.notice else []}
    for text, is_bad in metrics.findings:
        if not text.startswith((_BESIDE, _NO_LOSS)):
            plain = text.replace(", none false", ", no false alarm") if metrics.false_alarms == 0 else text
            line = textwrap.shorten(plain[:1].upper() + plain[1:], _HEADLINE_LETTERS, placeholder=" …")
            lines[is_bad].append(line)
    return lines[True] + lines[False]


def is_margin_below_1(evidence: CertifiedEvidence | None) -> TypeGuard[CertifiedEvidence]:
    """Return whether some residual was over its threshold in a cycle free of contact; False without margins."""
    return evidence is not None and evidence.smallest_margin is not None and evidence.smallest_margin < 1.0


def is_revoked(evidence: CertifiedEvidence | None) -> TypeGuard[CertifiedEvidence]:
    """Return whether some certificate was taken back; False for the paper's scheme."""
    return evidence is not None and bool(evidence.revoked)


def withheld_text(run: Run) -> str:
    """Return a text on the last certificate that was withheld: how long, s since motion start, and why; "" without.

    Of more than one, each ended by a certificate, it has the number.
    """
    begun_s: float | None = None
    spans, cause = list[str](), ""
    for t_ns, event in run.events:
        at_s = (t_ns - run.zero_ns) * 1e-9
        why, consequence, _ = event.message.partition(f"; {BEGINS_ANEW}")
        if consequence:
            begun_s, cause = at_s if begun_s is None else begun_s, why
        elif event.name == "certificate" and begun_s is not None:
            spans.append(f"from {begun_s:.2f} to {at_s:.2f} s")
            begun_s = None
    if begun_s is not None:
        spans.append(f"from {begun_s:.2f} s on")
    if not spans:
        return ""
    what = "a certificate was withheld" if len(spans) == 1 else f"certificates were withheld {len(spans)} times, last"
    return f"{what} {spans[-1]}: {cause}"


def _fault_texts(faults: tuple[Fault, ...]) -> list[str]:
    """Return a text of the first fault and, if there are more, one of the last; [] without a fault.

    From three faults on, the first text begins with their number.
    """
    if not faults:
        return []
    last = faults[-1]
    listed = [faults[0]] if len(faults) == 1 else [faults[0], last]
    count = f"{len(faults)} faults, the first and the last: " if len(faults) > 2 else ""
    texts = []
    for fault in listed:
        how = "the run ended in FAULT" if fault.is_last else "FAULT"
        cause = f": {fault.cause}" if fault.cause else ""
        after = "" if fault.is_last else ", after which it began anew"
        texts.append(f"{how} ({fault.reason}) at {fault.at_s:.2f} s{cause}{after}")
    return [count + texts[0], *texts[1:]]


def _beside_text(times_s: list[float | None]) -> str:
    if not any(time_s is not None for time_s in times_s):
        return ""
    if len(times_s) > LISTED:
        return f"{_BESIDE} took {_summary(times_s, 'did not end')}"
    took = " and ".join("did not end" if time_s is None else f"took {time_s:.2f} s" for time_s in times_s)
    if None not in times_s:
        took = took.replace(" and took", " and")
    return f"{_BESIDE} {took}"


def _summary(times_s: list[float | None], failed: str) -> str:
    """Return a phrase on many adaptations: the shortest and the longest time, and how many have None: no end.

    times_s: at least one isn't None. failed: words for the latter, such as "not identified".
    """
    took_s = [time_s for time_s in times_s if time_s is not None]
    text = f"{min(took_s):.2f} to {max(took_s):.2f} s, {len(took_s)} times"
    return text if len(took_s) == len(times_s) else f"{text}, and {failed} {len(times_s) - len(took_s)} times"


def begun_anew(sections: tuple[Section, ...]) -> frozenset[str]:
    """Return the labels of adaptations that follow another section than a payload change: a fault, or a broken attempt.

    The first section is not among them.
    """
    pairs = itertools.pairwise(sections)
    return frozenset(now.label for before, now in pairs if now.kind == "adaptation" and before.kind != "payload")


def identified_text(
    adaptation_s: dict[str, float | None], payload_kg: dict[str, float | None], anew: frozenset[str], done: str
) -> str:
    """Return a phrase with the times until the model was `done`, "identified" or "certified".

    adaptation_s: s by label, None: not done. payload_kg: true ones by label, None: unknown; their change is named
    behind a later time, unless the first model was not done. anew: labels from `begun_anew`. More than LISTED
    adaptations are summed up.
    """
    if not adaptation_s:
        return "the arm never moved to adapt"
    labels = list(adaptation_s)
    if all(time_s is None for time_s in adaptation_s.values()):
        return f"the model was not {done}"
    if len(labels) > LISTED:
        return f"the model was {done} in {_summary(list(adaptation_s.values()), f'not {done}')}"
    if adaptation_s[labels[0]] is None:
        later_s = [time_s for time_s in adaptation_s.values() if time_s is not None]
        return f"the model was not {done} at first, then in {' and in '.join(f'{time_s:.2f} s' for time_s in later_s)}"
    text = f"the model was {done} in {adaptation_s[labels[0]]:.2f} s"
    for before, label in itertools.pairwise(labels):
        old, new, time_s = payload_kg[before], payload_kg[label], adaptation_s[label]
        change = "it began anew" if label in anew else "the payload change"
        if old is not None and new is not None and new != old:
            change = f"{new - old:g} kg" if new > old else f"taking off {old - new:g} kg"
        text += f", but not again after {change}" if time_s is None else f" and again in {time_s:.2f} s after {change}"
    return text


_EXPERIMENT = "paper"
"""The scenario that is the paper's experiment, and the configuration that has its arm."""
_ADAPTED, _ADAPTED_AGAIN, _PAYLOAD = "First adaptation", "Adaptation after the payload change", "Payload"
_FROZEN = tuple(f"Frozen residual {which} payload, joints 1 / 2" for which in ("without", "with"))
_CAD = tuple(f"The CAD model's, {which} payload" for which in ("without", "with"))
_FIRST_CONTACT: Final = "First contact detected at"
_COUNTED = _FOUND, _DELAY, _FALSE = "Contacts detected", "Median delay", "False alarms"
FROZEN_BY_SECTION = tuple(f"Frozen residual, {which} detection section, joints 1 / 2" for which in ("first", "second"))
CAD_BY_SECTION = tuple(f"The CAD model's, {which} detection section" for which in ("first", "second"))
BETA, HOLD, FILTERS = "Bound β of eq. (15)", "Hold T of eq. (15)", "Filter a / b"
SMALLEST_MARGIN: Final = "Smallest threshold / residual"
_ELSEWHERE = {
    _ADAPTED_AGAIN: "Second adaptation",
    _PAYLOAD: "Payload in the second adaptation",
    **dict(zip((*_FROZEN, *_CAD), (*FROZEN_BY_SECTION, *CAD_BY_SECTION), strict=True)),
}
"""Quantities by the names that hold for any run."""


def is_papers_experiment(run: Run) -> bool:
    """Return whether the emulator played the paper's scenario with the paper's arm, by lengths and CAD model."""
    played = (run.metadata.get("scenario"), run.metadata.get(EMULATOR + "scenario"))
    arm, papers = run.settings.arm, _papers_arm(run.settings.arm.profile)
    return _EXPERIMENT in played and (arm.link_length_m, arm.cad_theta) == (papers.link_length_m, papers.cad_theta)


@cache
def _papers_arm(profile: str) -> ArmSettings:
    return load_settings(_EXPERIMENT, profile).arm


_WITHIN: Final = "within ±0.15"
_PAPERS: Final = {
    _ADAPTED: "5.2 s",
    _ADAPTED_AGAIN: "about 5.3 s",
    _PAYLOAD: "1 kg",
    **dict.fromkeys(_FROZEN, _WITHIN),
    _CAD[0]: "larger; joint 2 good",
    _CAD[1]: "much larger, both joints",
    _FIRST_CONTACT: "10 s",
}
"""The paper's figures by quantity."""


def compare_with_paper(run: Run, metrics: Metrics) -> tuple[PaperRow, ...]:
    """Return a row per figure: measured, the paper's, and that of the paper's scheme on the same stream.

    The last figure is None if the paper's scheme is the run's own. For a run that is not the paper's experiment, the
    paper's figures are None, and rows without another figure are left out.
    """
    settings, evidence = run.settings, metrics.evidence
    detections = [section.label for section in metrics.sections if section.kind == "detection"]
    frozen = [metrics.frozen_residual_max_Nm[label] for label in detections]
    cad, payloads = [residual.cad for residual in frozen], list(metrics.payload_kg.values())[1:2]
    same = {
        _PAYLOAD: NONE if payloads in ([], [None]) else f"{payloads[0]:g} kg",
        **{name: _residual_text(cad, place) for place, name in enumerate(_CAD)},
    }
    ours = same | _figures(metrics, [residual.identified for residual in frozen])
    if run.truth is None:
        ours[_FOUND] = str(len(metrics.contacts))
    a, b = settings.filter.a_rad_s, settings.filter.b_rad_s
    settled = (
        (BETA, "0.1 Nm", f"{settings.termination.beta_Nm:g} Nm"),
        (HOLD, "5 s", f"{settings.termination.hold_s:g} s"),
        ("Threshold, joints 1 / 2", "0.15 Nm", _pair(settings.detector.threshold_Nm)),
        (FILTERS, "10 / 10 rad/s", f"{a:g} / {b:g} rad/s"),
        ("Estimator", "least squares", settings.estimator.law.replace("_", " ")),
    )
    rate = f"{1e3 / settings.bus.period_us:g} kHz"
    if evidence is None:
        rows = [PaperRow(quantity, paper, None, ours[quantity]) for quantity, paper in _PAPERS.items()]
        rows += [PaperRow(quantity, paper, None, value) for quantity, paper, value in settled]
        return _of_what_was_played(run, [*rows, PaperRow("Control rate", "1 kHz", None, rate)])
    theirs, beside = dict.fromkeys(ours, NONE), evidence.paper_beside
    if beside is not None:
        theirs = same | _figures(beside, [beside.frozen_residual_max_Nm[label] for label in detections])
    papers = _PAPERS | dict.fromkeys(_COUNTED, NONE)
    rows = [PaperRow(quantity, paper, theirs[quantity], ours[quantity]) for quantity, paper in papers.items()]
    certified = (
        f"{settings.certified.beta_Nm:g} Nm, of the frozen model",
        _tests_text(list(evidence.test_s.values())),
        _threshold_text(evidence, detections),
        f"{', '.join(f'{cutoff:g}' for cutoff in settings.certified.cutoffs_rad_s)} rad/s",
        "least squares from a prior",
    )
    rows += [PaperRow(*row, value) for row, value in zip(settled, certified, strict=True)]
    margin = evidence.smallest_margin
    push = f"Smallest push found within {PUSH_WITHIN}, estimated, joints 1 / 2"
    rows += [
        PaperRow(SMALLEST_MARGIN, NONE, NONE, NONE if margin is None else f"{margin:.2f}"),
        PaperRow(push, NONE, NONE, _push_text(evidence)),
        PaperRow("Control rate", "1 kHz", rate, rate),
    ]
    if beside is None:
        rows = [row._replace(beside=NONE) for row in rows]
    return _of_what_was_played(run, rows)


def _figures(found: Metrics | Beside, frozen: list[tuple[float, float] | None]) -> dict[str, str]:
    """Return a scheme's figures as text by quantity. frozen: residuals of the detection sections, Nm by joint."""
    times_s = list(found.adaptation_s.values())
    seen_s = [contact.detected_s for contact in found.contacts if contact.detected_s is not None]
    armed = [contact for contact in found.contacts if contact.is_armed]
    delays_ms = [contact.delay_ms for contact in armed if contact.delay_ms is not None]
    return {
        _ADAPTED: _seconds(times_s, 0),
        _ADAPTED_AGAIN: _seconds(times_s, 1),
        **{name: _residual_text(frozen, place) for place, name in enumerate(_FROZEN)},
        _FIRST_CONTACT: f"{seen_s[0]:.2f} s" if seen_s else NONE,
        _FOUND: NONE if found.missed is None else found_text(len(delays_ms), len(armed)),
        _DELAY: f"{float(np.median(delays_ms)):.1f} ms" if delays_ms else NONE,
        _FALSE: NONE if found.false_alarms is None else str(found.false_alarms),
    }


def _of_what_was_played(run: Run, rows: Sequence[PaperRow]) -> tuple[PaperRow, ...]:
    """Return the rows; for a run that is not the paper's experiment without the paper's figures.

    Then quantities have their names of `_ELSEWHERE`, and empty rows are left out.
    """
    if is_papers_experiment(run):
        return tuple(rows)
    return tuple(
        row._replace(quantity=_ELSEWHERE.get(row.quantity, row.quantity), paper=None)
        for row in rows
        if {row.beside, row.measured} - {None, NONE}
    )


def _tests_text(times_s: list[float | None]) -> str:
    """Return the durations of the tests as text; of more than LISTED the shortest and the longest.

    times_s: None: no test.
    """
    found = [time_s for time_s in times_s if time_s is not None]
    if len(times_s) > LISTED and found:
        return f"tests of {min(found):.2f} to {max(found):.2f} s"
    return "test of " + (" and ".join(NONE if t is None else f"{t:.2f} s" for t in times_s) or NONE)


def _threshold_text(evidence: CertifiedEvidence, detections: list[str]) -> str:
    """Return the range of the slowest channel's thresholds as text: of their medians in the detection sections.

    NONE without any.
    """
    found = [h for label in detections for row in evidence.margins.get(label, ())[:1] for h in row.threshold_Nm]
    return f"{min(found):.3f} to {max(found):.3f} Nm" if found else NONE


def _push_text(evidence: CertifiedEvidence) -> str:
    """Return the median and the worst smallest push that is found, of both joints, as text; NONE if unknown."""
    if evidence.smallest_push is None:
        return NONE
    median, worst = (
        " / ".join(f"{joint[name]:.2f}" for joint in evidence.smallest_push.push_Nm) for name in ("p50", "max")
    )
    return f"median {median}, at worst {worst} Nm"


def _seconds(times_s: list[float | None], index: int) -> str:
    if index >= len(times_s):
        return NONE
    value = times_s[index]
    return "not finished" if value is None else f"{value:.2f} s"


def _pair(values: tuple[float, float] | None) -> str:
    if values is None:
        return NONE
    return f"{values[0]:g} Nm" if values[0] == values[1] else f"{values[0]:g} / {values[1]:g} Nm"


def _residual_text(frozen: list[tuple[float, float] | None], index: int) -> str:
    values = frozen[index] if index < len(frozen) else None
    return NONE if values is None else f"{values[0]:.3f} / {values[1]:.3f} Nm"


def data_text(data: CyclicData) -> str:
    """Return the verdict's clause on cyclic data that was late, lost or repeated; "" if the drives never had torque.

    Of the devices it names only the worst for missing data and the worst for repeated data.
    """
    if not data.cycles:
        return ""
    if data.incomplete is None:
        return "whether cyclic data was late or lost is not in the log"
    said = []
    if data.incomplete:
        said.append(f"{percent_text(data.incomplete)} of the cycles lacked a frame in time")
    if data.aged:
        said.append(f"{percent_text(data.aged)} went by older data")
    missed = {name: shares.no_new_data for name, shares in data.devices.items() if shares.no_new_data}
    repeated = {name: shares.repeated for name, shares in data.devices.items() if shares.repeated}
    for what, found in (("no new data of", missed), ("repeated frames of", repeated)):
        if found:
            name, share = max(found.items(), key=lambda entry: entry[1])
            said.append(f"{what} {name} in {percent_text(share)}")
    if not said:
        return _NO_LOSS
    return ", ".join(said) + (", more than allowed" if data.excesses else "")
