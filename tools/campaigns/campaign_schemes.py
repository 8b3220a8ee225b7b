"""The schemes that a campaign compares, each behind one call: a recording in, an outcome out.

Only the supervisor's rule for a good run is played: adapt from each cycle of `begins` on, armed as soon as the scheme
says so. Nobody reacts, so a detector goes on after an alarm.
"""

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from lab import PERIOD_S, Motion, Recording, paper_motion
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.scheme.kernel import paper_kernel
from adacd_hil.scheme.supervisor.findings import ADAPTED, CONTACT_SHIFT
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings

ADAPTING, TESTING, ARMED = 0, 1, 2
_LEARN = paper_kernel.LEARN
_ARMED = paper_kernel.ARMED


@dataclass(frozen=True)
class Outcome:
    """What a scheme made of n samples.

    phase (n,): ADAPTING, TESTING, ARMED. over (n,): bits of the joints over their threshold, 0 where detection is off.
    tau_ext_hat (n, 2): of the slowest filter, Nm; threshold (n, 2) of it; tau_ext_wide_hat (n, 2): with the filter
    undone. direction (n, 2): sign of what is most over its threshold. armed: the cycle of each arming, in order of
    `begins`, -1 for never; theta (m, p): parameters then.
    """

    phase: NDArray[np.int64]
    over: NDArray[np.int64]
    tau_ext_hat: NDArray[np.float64]
    tau_ext_wide_hat: NDArray[np.float64]
    threshold: NDArray[np.float64]
    direction: NDArray[np.float64]
    armed: tuple[int, ...]
    theta: NDArray[np.float64]


class Scheme(Protocol):
    """A scheme under test. patience_s: how long it may adapt before it counts as never armed."""

    name: str
    patience_s: float

    def adaptation_motion(self, is_payload: bool) -> Motion:
        """Return the motion with which it adapts, `patience_s` long, from rest."""

    def run(self, recording: Recording, begins: tuple[int, ...]) -> Outcome:
        """Play a recording; adapt anew from each cycle of `begins` on."""


class PaperScheme:
    """The paper's scheme as a configuration has it."""

    patience_s = 14.0

    def __init__(self, name: str, settings: Settings) -> None:
        self.name = name
        self._settings = settings

    def adaptation_motion(self, is_payload: bool) -> Motion:  # noqa: ARG002
        """Return the paper's motion as printed."""
        return paper_motion(self.patience_s)

    def run(self, recording: Recording, begins: tuple[int, ...]) -> Outcome:
        """Play a recording through the compiled step."""
        n, p = len(recording.q), len(self._settings.estimator.parameter_names)
        tau_ext_hat, wide, threshold = (np.zeros((n, 2)) for _ in range(3))
        phase, over = np.zeros(n, np.int64), np.zeros(n, np.int64)
        armed, theta = np.full(len(begins), -1), np.zeros((len(begins), p))
        _run_paper(
            paper_kernel.constants_of(self._settings), paper_kernel.new_memory(p), paper_kernel.new_block(p),
            recording.q, recording.dq, recording.tau_J, np.array(begins), phase, over, tau_ext_hat, wide, threshold,
            armed, theta,
        )  # fmt: skip
        return Outcome(phase, over, tau_ext_hat, wide, threshold, np.sign(tau_ext_hat), tuple(armed.tolist()), theta)


@compiled
def _run_paper(
    constants: Any,
    memory: Any,
    block: Any,
    q: Vector,
    dq: Vector,
    tau_J: Vector,
    begins: NDArray[np.int64],
    phase: NDArray[np.int64],
    over: NDArray[np.int64],
    tau_ext_hat: Vector,
    wide: Vector,
    threshold: Vector,
    armed: NDArray[np.int64],
    theta: Vector,
) -> None:
    adaptation, mode = -1, 0
    for k in range(q.shape[0]):
        for index in range(begins.shape[0]):
            if begins[index] == k:
                paper_kernel.begin_adaptation(constants, memory, block)
                adaptation, mode = index, _LEARN
        out = block[0]
        out["q"][:] = q[k]
        out["dq"][:] = dq[k]
        out["tau_J"][:] = tau_J[k]
        observation = paper_kernel.step(constants, memory, block, 1, 1, mode)
        phase[k] = ARMED if mode == _ARMED else ADAPTING
        over[k] = observation >> CONTACT_SHIFT if mode == _ARMED else 0
        tau_ext_hat[k] = out["tau_ext_hat"]
        wide[k] = out["tau_ext_wide_hat"]
        threshold[k] = out["threshold"]
        if mode == _LEARN and observation & ADAPTED:
            mode = _ARMED
            armed[adaptation] = k
            theta[adaptation] = out["theta_hat"]


def true_residual(recording: Recording, cutoff_rad_s: float, lag_s: float = 0.0) -> NDArray[np.float64]:
    """Return tau_ext_hat (n, 2) of a filter with the true parameters of each instant, Nm.

    lag_s: by how much the torque is delayed to meet the velocity.
    """
    settings = load_settings("paper", "S")
    constants = paper_kernel.constants_of(_with_cutoff(settings, cutoff_rad_s))
    count = len(settings.estimator.parameter_names)
    whole = int(lag_s / PERIOD_S)
    share = lag_s / PERIOD_S - whole
    tau_J = recording.tau_J
    tau_J = (1.0 - share) * _delayed(tau_J, whole) + share * _delayed(tau_J, whole + 1)
    tau_J = tau_J - np.array(recording.arm.torque_offset_Nm)
    out = np.zeros((len(tau_J), 2))
    _run_true(
        constants, paper_kernel.new_memory(count), paper_kernel.new_block(count), recording.q, recording.dq, tau_J,
        recording.theta, out,
    )  # fmt: skip
    return out


def _with_cutoff(settings: Settings, cutoff_rad_s: float) -> Settings:
    return replace(settings, filter=replace(settings.filter, a_rad_s=cutoff_rad_s, b_rad_s=cutoff_rad_s))


def _delayed(values: NDArray[np.float64], cycles: int) -> NDArray[np.float64]:
    return values if cycles == 0 else np.concatenate((np.repeat(values[:1], cycles, 0), values[:-cycles]))


@compiled
def _run_true(
    constants: Any, memory: Any, block: Any, q: Vector, dq: Vector, tau_J: Vector, theta: Vector, tau_ext_hat: Vector
) -> None:
    for k in range(q.shape[0]):
        out = block[0]
        out["q"][:] = q[k]
        out["dq"][:] = dq[k]
        out["tau_J"][:] = tau_J[k]
        out["theta_hat"][:] = theta[k]
        paper_kernel.step(constants, memory, block, 1, 1, 0)
        tau_ext_hat[k] = out["tau_ext_hat"]


def scheme_named(configuration: str) -> Scheme:
    """Return the scheme of a configuration: a built-in name or a TOML file. Raises ConfigError."""
    settings = load_settings(configuration, "S")
    if getattr(settings, "scheme", "paper") == "certified":
        from campaign_certified import CertifiedScheme

        return CertifiedScheme(configuration, settings)
    return PaperScheme(configuration, settings)
