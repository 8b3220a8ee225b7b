"""What only the certified scheme can be asked: its test, how well its parameters are known, and its margins.

*Margin* of a channel: the smallest threshold / |residual| of any cycle in which nothing touches the arm; below 1 it
would have been a false alarm. Per section, adaptations included, since detection is on there too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adacd_hil.analysis.beside import Beside, largest_of
from adacd_hil.analysis.run import CertifiedStream, Mask, Run
from adacd_hil.analysis.sections import Section, rows_of
from adacd_hil.analysis.touches import bank_channels
from adacd_hil.records import JOINTS, SchemeState


@dataclass(frozen=True)
class Estimate:
    """A parameter at the end of an adaptation and the standard deviation that the scheme gives it, in its unit."""

    value: float
    std: float


@dataclass(frozen=True)
class ChannelMargin:
    """A channel of the bank over a section: cut-off and smoothing, rad/s; then per joint, where nothing touches.

    residual_max_Nm: largest. threshold_Nm: median of the threshold. margin: see the module's first lines.
    """

    cutoff_rad_s: float
    smoothing_rad_s: float | None
    residual_max_Nm: tuple[float, float]
    threshold_Nm: tuple[float, float]
    margin: tuple[float, float]


@dataclass(frozen=True)
class Evidence:
    """Of each adaptation: how often the frozen model was tested, for how long the last time, and the parameters.

    margins: by section. promotions: refined models that took over in the run.
    """

    tests: dict[str, int]
    test_s: dict[str, float | None]
    estimates: dict[str, dict[str, Estimate]]
    margins: dict[str, tuple[ChannelMargin, ...]]
    promotions: int
    paper_beside: Beside | None

    @property
    def smallest_margin(self) -> float | None:
        """The smallest of all margins where the certified model was in force or was learnt."""
        values = [min(row.margin) for rows in self.margins.values() for row in rows]
        return min(values, default=None)


def evaluate_certified(
    run: Run, stream: CertifiedStream, sections: Sequence[Section], free: Mask, beside: Beside | None
) -> Evidence:
    """Judge a run of the certified scheme. free: cycles (n,) in which nothing touches the arm."""
    adaptations = [section for section in sections if section.kind == "adaptation"]
    stays = {section.label: _tests(run, section) for section in adaptations}
    margins = {}
    for section in sections:
        if section.kind in ("adaptation", "detection"):
            rows = rows_of(run, section) & free & np.isfinite(stream.threshold).all(axis=(1, 2))
            if rows.any():
                margins[section.label] = _margins(run, stream, rows)
    return Evidence(
        tests={label: len(lengths_s) for label, lengths_s in stays.items()},
        test_s={label: lengths_s[-1] if lengths_s else None for label, lengths_s in stays.items()},
        estimates={section.label: _estimates(run, stream, section) for section in adaptations},
        margins=margins,
        promotions=int(np.maximum(np.diff(stream.promotions, prepend=0.0), 0.0).sum()),
        paper_beside=beside,
    )


def last_row(run: Run, section: Section) -> int:
    """Give the row with an adaptation's result: the next section's first cycle, which still learns."""
    return int(np.flatnonzero(rows_of(run, section))[-1]) + int(section.is_complete)


def _tests(run: Run, section: Section) -> list[float]:
    """Give the lengths of the stays in CERTIFY of a section, s."""
    inside = np.concatenate(([False], (run.state == SchemeState.CERTIFY) & rows_of(run, section), [False]))
    edges = np.flatnonzero(inside[1:] != inside[:-1])
    time_s = np.append(run.time_s(), section.end_s)
    return [float(time_s[end] - time_s[start]) for start, end in edges.reshape(-1, 2)]


def _estimates(run: Run, stream: CertifiedStream, section: Section) -> dict[str, Estimate]:
    row = last_row(run, section)
    values = np.concatenate((run.theta_hat[row], stream.theta_further[row]))
    names = run.parameter_names + run.settings.further_names
    return {
        name: Estimate(float(value), float(std))
        for name, value, std in zip(names, values, stream.theta_std[row], strict=True)
    }


def _margins(run: Run, stream: CertifiedStream, rows: Mask) -> tuple[ChannelMargin, ...]:
    found = []
    for place, (cutoff, smoothing) in enumerate(bank_channels(run.settings)):
        residual, threshold = np.abs(stream.tau_ext[rows, place]), stream.threshold[rows, place]
        share, middle = (residual / threshold).max(axis=0), np.median(threshold, axis=0)
        found.append(
            ChannelMargin(
                cutoff_rad_s=cutoff,
                smoothing_rad_s=smoothing,
                residual_max_Nm=largest_of(residual) or (0.0, 0.0),
                threshold_Nm=(float(middle[0]), float(middle[1])),
                margin=(_inverse(float(share[0])), _inverse(float(share[JOINTS - 1]))),
            )
        )
    return tuple(found)


def _inverse(share: float) -> float:
    return 1.0 / share if share > 0.0 else float("inf")
