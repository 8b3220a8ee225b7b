"""What the words of a report mean: its last section."""

from html import escape
from typing import Final

from adacd_hil.analysis.run import Run

_CERTIFIED_DEFINITIONS: Final = (
    (
        "Certified",
        "an adaptation lasts until detection is armed: fit, test of the frozen model on motion that it was not fitted "
        "to, and what contacts on the way cost. Residual: of the slowest filter. Law and ideal: of the fastest channel "
        "of the bank.",
    ),
    (
        "Paper's scheme, same stream",
        "it adapts beside, ends by eq. (15) and compares with its own thresholds, but decides nothing. Its detection "
        "is the first sample over its threshold while it is armed, though the arm may already react to the other's.",
    ),
    (
        "Force, lever arm, blind within",
        "at right angles to the link, for one contact without friction; the lever arm counts from joint 2. A force "
        "nearer to link 2's axis than the angle reads as one on link 1.",
    ),
)


def _in_the_log(run: Run) -> str:
    """Say where motion start is in the log."""
    if run.log_start_ns is None:
        return ""
    since_s = (run.zero_ns - run.log_start_ns) * 1e-9
    return f"; it is {since_s:.3f} s after the beginning of the log, from which --from and --until count"


def definitions(run: Run) -> str:
    """Write the section."""
    settling_s = 10.0 / run.a_rad_s
    entries: tuple[tuple[str, str], ...] = (
        ("Times", f"count from motion start, the first cycle of the first adaptation{_in_the_log(run)}."),
        (
            "Frozen residual",
            "largest estimated external torque while detection is armed and nobody touches the arm: outside "
            f"each contact and {settling_s:g} s (10/a) after it, and outside each withdrawal and {settling_s:g} s "
            "after it. In an adaptation the parameters still move, so only the CAD model has one.",
        ),
        (
            "Law",
            "delay of a torque step, −ln(1 − h/τ)/a, for the largest true torque up to the detection; ideal: "
            "the true torque as it was, through the filter alone, to the cycle in which it is over the threshold. "
            "What the delay has beyond that is bus, sensor lag and model error.",
        ),
        (
            "False alarm, missed",
            "a detection that no contact explains: each explains those from its onset until one time constant "
            "after the true torque, filtered, is back within the threshold. Missed is a contact that began while "
            "detection was armed and was not detected.",
        ),
        (
            "Found, at alarm",
            "the link at the end of the isolation window and at the moment of detection. Peak ratio: estimated peak "
            "torque, filter undone, over the true one, at the joint with more of it.",
        ),
    )
    if run.certified is not None:
        entries += _CERTIFIED_DEFINITIONS
    items = "".join(f"<dt>{escape(term)}</dt><dd>{escape(text)}</dd>" for term, text in entries)
    return f'<section class="definitions">\n<h2>How it is computed</h2>\n<dl>{items}</dl>\n</section>'
