"""The report for somebody who never read the paper: contrast, names of states, no paper where it was not played."""

import re
from importlib import resources

import pytest

from adacd_hil.analysis.score.wording import STATE_WORDS
from adacd_hil.records import SchemeState

CSS = resources.files("adacd_hil.analysis.report").joinpath("assets", "report.css").read_text(encoding="utf-8")
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
def test_text_and_curves_are_told_from_their_ground(colours: dict[str, str]) -> None:
    text = {(ink, ground): contrast(colours[ink], colours[ground]) for ink in ("ink", "muted") for ground in GROUNDS}
    text |= {
        (ink, ground): contrast(colours[ink], colours[ground]) for ink in ("alarm", "good") for ground in GROUNDS[:2]
    }
    assert {pair: ratio for pair, ratio in text.items() if ratio < 4.5} == {}  # WCAG AA
    curves = {curve: contrast(colours[curve], colours["paper"]) for curve in CURVES}
    assert {curve: ratio for curve, ratio in curves.items() if ratio < 3.0} == {}


def test_every_state_has_a_name_in_words() -> None:
    assert set(STATE_WORDS) == set(SchemeState)
    assert len(set(STATE_WORDS.values())) == len(SchemeState)
