"""The verdict on a run: one sentence, what went wrong first."""

import itertools
from typing import Final, TypeGuard

from adacd_hil.analysis.cyclic_data import CyclicData, data_text
from adacd_hil.analysis.endings import Fault
from adacd_hil.analysis.logged_run import Run
from adacd_hil.analysis.margin_evidence import Evidence
from adacd_hil.analysis.score.judge import Score
from adacd_hil.analysis.score.score_words import number_of, score_sentence
from adacd_hil.analysis.sections import Section

LISTED: Final = 4
"""Adaptations that are listed one by one."""


def give_verdict(
    run: Run,
    sections: tuple[Section, ...],
    score: Score,
    adaptation_s: dict[str, float | None],
    payload_kg: dict[str, float | None],
    evidence: Evidence | None,
    faults: tuple[Fault, ...],
    causes: tuple[str, ...],
    data: CyclicData,
) -> str:
    """Say in one sentence how the run went. causes: what ended attempts without a fault."""
    if run.cycle.size == 0:
        cause = "; ".join(causes) or "the log does not say why"
        return f"No cycle was run: {cause}."
    done = "identified" if evidence is None else "certified"
    identified = identified_text(adaptation_s, payload_kg, begun_anew(sections), done)
    found = score_sentence(score)
    if run.truth is None:
        found = f"{number_of(len(score.false_alarms), 'detection')}, whose truth is not recorded"
    text = f"{found}; {identified}"
    if evidence is not None and not evidence.is_anchored:
        text += ", with torque offsets that nothing anchors"
    if evidence is not None and evidence.paper_beside is not None:
        text += _beside_text(list(evidence.paper_beside.adaptation_s.values()))
    if is_margin_below_1(evidence):
        text = f"a residual was over its threshold with nobody touching the arm: {_margin_text(evidence)}; {text}"
    if is_revoked(evidence):
        text = "; ".join((*evidence.revoked, text))
    broken = f"the run was broken off: {'; '.join(causes)}" if causes else ""
    text = "; ".join(filter(None, (*_fault_texts(faults), broken, text, data_text(data))))
    return text[:1].upper() + text[1:] + "."


def is_margin_below_1(evidence: Evidence | None) -> bool:
    """Tell whether some residual was over its threshold while nobody touched the arm."""
    return evidence is not None and evidence.smallest_margin is not None and evidence.smallest_margin < 1.0


def is_revoked(evidence: Evidence | None) -> TypeGuard[Evidence]:
    """Tell whether some certificate was taken back."""
    return evidence is not None and bool(evidence.revoked)


def _margin_text(evidence: Evidence | None) -> str:
    margin = None if evidence is None else evidence.smallest_margin
    return "" if margin is None else f"smallest margin {margin:.2f}"


def _fault_texts(faults: tuple[Fault, ...]) -> list[str]:
    """Say which faults there were: the first, and the one that the run ended in."""
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
        return f"; the paper's scheme on the same stream took {_summary(times_s, 'did not end')}"
    took = " and ".join("did not end" if time_s is None else f"took {time_s:.2f} s" for time_s in times_s)
    if None not in times_s:
        took = took.replace(" and took", " and")
    return f"; the paper's scheme on the same stream {took}"


def _summary(times_s: list[float | None], failed: str) -> str:
    """Sum up many adaptations, of which some took their time: the shortest, the longest, and how many failed."""
    took_s = [time_s for time_s in times_s if time_s is not None]
    text = f"{min(took_s):.2f} to {max(took_s):.2f} s, {len(took_s)} times"
    return text if len(took_s) == len(times_s) else f"{text}, and {failed} {len(times_s) - len(took_s)} times"


def begun_anew(sections: tuple[Section, ...]) -> frozenset[str]:
    """Name the adaptations with which the arm began again after a fault, or after what broke an attempt off."""
    pairs = itertools.pairwise(sections)
    return frozenset(now.label for before, now in pairs if now.kind == "adaptation" and before.kind != "payload")


def identified_text(
    adaptation_s: dict[str, float | None], payload_kg: dict[str, float | None], anew: frozenset[str], done: str
) -> str:
    """Say how long the model took to be `done`, identified or certified. anew: see `begun_anew`."""
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
