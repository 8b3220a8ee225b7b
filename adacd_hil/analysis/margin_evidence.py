"""What only the certified scheme can be asked: its test, how well its parameters are known, and its margins.

*Margin* of a channel: the smallest threshold / |residual| of any cycle in which nothing touches the arm; below 1 it
would have been a false alarm. Per section, adaptations included, since detection is on there too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adacd_hil.analysis.distribution import Distribution
from adacd_hil.analysis.logged_run import CertifiedStream, Run
from adacd_hil.analysis.score.paper_beside import Beside, larger
from adacd_hil.analysis.sections import Section, rows_of
from adacd_hil.analysis.smallest_push import SmallestPush
from adacd_hil.records import JOINTS, SchemeState, Vector
from adacd_hil.scheme.model.bank import channels_of
from adacd_hil.settings.configuration import Settings


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

    margins: by section. promotions: refined models that took over in the run. is_anchored: whether each certificate
    says what anchors all its offsets; logs from before there were anchors say nothing. revoked: why certificates were
    taken back, in order. smallest_push: None where nothing was armed.
    """

    tests: dict[str, int]
    test_s: dict[str, float | None]
    estimates: dict[str, dict[str, Estimate]]
    margins: dict[str, tuple[ChannelMargin, ...]]
    promotions: int
    paper_beside: Beside | None
    is_anchored: bool
    revoked: tuple[str, ...]
    smallest_push: SmallestPush | None

    @property
    def smallest_margin(self) -> float | None:
        """The smallest of all margins where the certified model was in force or was learnt."""
        values = [min(row.margin) for rows in self.margins.values() for row in rows]
        return min(values, default=None)


def evaluate_certified(
    run: Run,
    stream: CertifiedStream,
    sections: Sequence[Section],
    margins: dict[str, tuple[ChannelMargin, ...]],
    promotions: int,
    beside: Beside | None,
    smallest_push: SmallestPush | None,
) -> Evidence:
    """Judge a run of the certified scheme. margins, promotions, smallest_push: of all its cycles, see `untouched`."""
    adaptations = [section for section in sections if section.kind == "adaptation"]
    stays = {section.label: _tests(run, section) for section in adaptations}
    return Evidence(
        tests={label: len(lengths_s) for label, lengths_s in stays.items()},
        test_s={label: lengths_s[-1] if lengths_s else None for label, lengths_s in stays.items()},
        estimates={section.label: _estimates(run, stream, section) for section in adaptations},
        margins=margins,
        promotions=promotions,
        paper_beside=beside,
        is_anchored=all(event.level == "info" for _, event in run.events if event.name == "certificate"),
        revoked=tuple(event.message for _, event in run.events if event.name == "revoked"),
        smallest_push=smallest_push,
    )


def last_row(run: Run, section: Section) -> int:
    """Give the row with an adaptation's result: the next section's first cycle, which still learns."""
    time_s = run.time_s()
    end = int(rows_of(time_s, section, float(time_s[-1])).stop)
    return end - 1 + int(section.is_complete)


def _tests(run: Run, section: Section) -> list[float]:
    """Give the lengths of the stays in CERTIFY of a section, s."""
    time_s = run.time_s()
    rows = rows_of(time_s, section, float(time_s[-1]))
    inside = np.concatenate(([False], run.state[rows] == SchemeState.CERTIFY, [False]))
    edges = np.flatnonzero(inside[1:] != inside[:-1]) + rows.start
    time_s = np.append(time_s, section.end_s)
    return [float(time_s[end] - time_s[start]) for start, end in edges.reshape(-1, 2)]


def _estimates(run: Run, stream: CertifiedStream, section: Section) -> dict[str, Estimate]:
    row = last_row(run, section)
    values = np.concatenate((run.theta_hat[row], stream.theta_further[row]))
    names = run.parameter_names + run.settings.further_names
    return {
        name: Estimate(float(value), float(std))
        for name, value, std in zip(names, values, stream.theta_std[row], strict=True)
    }


class MarginGatherer:
    """Gathers the margins of one section, cycles at a time."""

    def __init__(self, settings: Settings) -> None:
        self._channels = channels_of(settings)
        self._residual: Vector | None = None  # largest (channels, 2)
        self._share: Vector | None = None  # largest residual / threshold (channels, 2)
        self._thresholds = [[Distribution() for _ in range(JOINTS)] for _ in self._channels]

    def add(self, tau_ext: Vector, threshold: Vector) -> None:
        """Take in cycles in which nothing touches the arm: residuals and thresholds (k, channels, 2), k > 0."""
        self._residual = larger(self._residual, tau_ext)
        self._share = larger(self._share, np.abs(tau_ext) / threshold)
        for place, distributions in enumerate(self._thresholds):
            for joint, distribution in enumerate(distributions):
                distribution.add(threshold[:, place, joint])

    def margins(self) -> tuple[ChannelMargin, ...]:
        """Sum up each channel; nothing has to have been gathered for none."""
        if self._residual is None or self._share is None:
            return ()
        found = []
        for place, (cutoff, smoothing) in enumerate(self._channels):
            residual, share = self._residual[place].tolist(), self._share[place].tolist()
            middle = [distribution.median() for distribution in self._thresholds[place]]
            found.append(
                ChannelMargin(
                    cutoff_rad_s=cutoff,
                    smoothing_rad_s=smoothing,
                    residual_max_Nm=(residual[0], residual[1]),
                    threshold_Nm=(middle[0], middle[1]),
                    margin=(_inverse(share[0]), _inverse(share[JOINTS - 1])),
                )
            )
        return tuple(found)


def _inverse(share: float) -> float:
    return 1.0 / share if share > 0.0 else float("inf")
