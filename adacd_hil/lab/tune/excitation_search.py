"""The search for an excitation: the motion that shows every combination of parameters soonest, within the arm's limits.

The search rates a motion as the certified scheme does: by the information D (∫ W_f' W_f) D of the slow filter over the
shortest fit, D the errors that must not stay hidden (`termination`), and by that of the inertia alone over the shortest
fit of a payload. The search makes the smallest eigenvalues large and the condition number small:

    cost = -ln e - ½ ln e_inertia + ¼ ln (largest / e)

The motion is the Fourier series of `config.ExcitationSettings`. It begins at rest, so the other harmonics
determine the first one. The limits are the trajectory's amplitude, the speed and acceleration of a withdrawal, and,
with a CAD model, a share of the torque limit.

L-BFGS climbs from the present motion first, then from random ones. While it climbs, Coulomb friction is a tanh, so that
the cost has a slope; the results are rated with the sign function, as in the scheme.

Shapes: N samples, K harmonics; q, dq, ddq (N, 2); W (N, 2, p). Units: rad, rad/s, rad/s², Nm.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize
from scipy.signal import lfilter

from adacd_hil.compiled import compiled
from adacd_hil.control.motions import TOLERANCE
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.kernel.certified_memory import constants_of
from adacd_hil.scheme.model.regressor import F_C1, F_C2, regressor
from adacd_hil.scheme.model.torque_filter import first_order_hold
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.run_settings import ExcitationSettings
from adacd_hil.settings.schema import ConfigError

PERIOD_S = 2.4
"""Period of an excitation for a configuration without one: a fit of 1.4 s covers more than half of it."""
HARMONICS = 6
"""Harmonics of that excitation, up to 2.5 Hz. The acceleration limit keeps faster ones too small to be of use."""
TORQUE_SHARE = 0.5
"""Part of the torque limit that the motion may need; the rest is for a payload, friction and the controller."""
ITERATIONS = 150
"""Of one climb: it has ended by itself before in two of three cases."""

_DIGITS = 5
_SMOOTH_RAD_S = 0.05
_PENALTIES = (1e3, 1e5, 1e7)
_SMALLEST = 1e-15


class NoExcitationError(ValueError):
    """The search found no motion that keeps the limits; the message is one line."""


@dataclasses.dataclass(frozen=True)
class Figures:
    """Figures of a motion.

    Smallest eigenvalues, Nm² s: excitation_Nm2s, of the information on all parameters in the shortest fit;
    inertia_Nm2s, of that on the inertia alone in the shortest fit of a payload. condition: largest over smallest
    eigenvalue of the former. The others are largest |q| and so on, of joint 1 and 2.
    """

    excitation_Nm2s: float
    condition: float
    inertia_Nm2s: float
    travel_deg: list[float]
    velocity_deg_s: list[float]
    acceleration_deg_s2: list[float]
    torque_Nm: list[float] | None
    """None: unknown without a CAD model."""

    @property
    def cost(self) -> float:
        """Cost of the motion, the lower the better it identifies: by `excitation_Nm2s`, `inertia_Nm2s` and `condition`.

        The search minimises it; it may be negative.
        """
        return _cost_of(self.excitation_Nm2s, self.condition, self.inertia_Nm2s)


@compiled
def _fill_regressors(q: Vector, dq: Vector, ddq: Vector, level_rad: float, W: Vector) -> None:
    """Write to W (N, 2, p) the regressor of each sample; p sets its number of columns.

    level_rad: q1 at which link 1 is level.
    """
    for n in range(W.shape[0]):
        W[n] = regressor(q[n], dq[n], ddq[n], W.shape[2], level_rad)


class Search:
    """The search for one configuration's excitation.

    Raises ConfigError if its trajectory does not move a joint, or its excitation has fewer than 2 harmonics.
    """

    def __init__(self, settings: Settings) -> None:
        settings = dataclasses.replace(settings, scheme="certified")
        certified, arm = settings.certified, settings.arm
        if min(settings.trajectory.amplitude_deg) <= 0.0:
            raise ConfigError(
                f"`trajectory.amplitude_deg` = {settings.trajectory.amplitude_deg} leaves an excitation no room; "
                "above 0 deg for each joint expected"
            )
        self.present = settings.excitation
        self._level_rad = settings.level_rad
        self._period_s = settings.excitation.period_s or PERIOD_S
        harmonics = len(settings.excitation.sine[0]) if settings.excitation.period_s else HARMONICS
        if harmonics < 2:
            raise ConfigError(f"`excitation` has {harmonics} harmonics; at least 2 for each joint expected")
        self._amplitude = np.radians(settings.trajectory.amplitude_deg)
        self._limits = (
            self._amplitude,
            np.minimum(np.radians(settings.reaction.velocity_limit_deg_s), arm.velocity_limit_rad_s),
            np.radians(settings.reaction.acceleration_limit_deg_s2),
            np.maximum(TORQUE_SHARE * np.array(arm.torque_limit_Nm), _SMALLEST),
        )  # of |q|, |dq|, |ddq| and the CAD model's torque, each (2,)
        self._theta = settings.cad_theta if arm.cad_theta else None
        self._base = len(settings.estimator.parameter_names)
        scale = constants_of(settings)["scale"][0]
        # The lag shows in the torque's derivative, so only a model of the torque makes it identifiable.
        self._scale = scale if arm.cad_theta else scale[: self._base + JOINTS]
        self._step_s = settings.bus.period_s * certified.learn_every
        elapsed_s = np.arange(0.0, max(self._period_s, *certified.fit_s), self._step_s)
        self._fit, self._payload_fit = (round(fit_s / self._step_s) for fit_s in certified.fit_s)
        self._cutoff = certified.cutoffs_rad_s[0]
        hold = first_order_hold(self._cutoff, self._cutoff, self._step_s)
        self._taps = ([hold.weight_new, hold.weight_old], [1.0, -hold.decay])
        self._order = np.arange(1, harmonics + 1)
        self._rad_s = 2.0 * np.pi / self._period_s * self._order
        self._cosine, self._sine = (wave(np.outer(elapsed_s, self._rad_s)) for wave in (np.cos, np.sin))

    def limits(self) -> dict[str, list[float] | None]:
        """Return the limits by the names of the peaks in `Figures`, in their units, by joint; None: no limit."""
        travel, velocity, acceleration = np.degrees(self._limits[:3]).tolist()
        return {
            "travel_deg": travel,
            "velocity_deg_s": velocity,
            "acceleration_deg_s2": acceleration,
            "torque_Nm": None if self._theta is None else self._limits[3].tolist(),
        }

    def figures(self, excitation: ExcitationSettings) -> Figures:
        """Return the figures of a motion at the samples of the search.

        excitation: with period and number of harmonics of this search.
        """
        motion = self.motion_of(np.array(excitation.cosine), np.array(excitation.sine))
        W = self._regressors(motion)
        smallest, largest, inertia = self._shown(W)
        travel, velocity, acceleration = np.degrees(np.abs(motion).max(axis=1)).tolist()
        return Figures(
            smallest,
            largest / max(smallest, _SMALLEST),
            inertia,
            travel,
            velocity,
            acceleration,
            None if self._theta is None else np.abs(W @ self._theta).max(axis=0).tolist(),
        )

    def overshoot(self, excitation: ExcitationSettings) -> float:
        """Return by which share of a limit a motion exceeds it, at the worst joint, sample and limit.

        At most 0 if the motion keeps all limits.
        """
        motion = self.motion_of(np.array(excitation.cosine), np.array(excitation.sine))
        return max(float(used.max()) for used in self._used(motion, self._regressors(motion))) - 1.0

    def run(
        self,
        seed: int,
        goes_on: Callable[[int], bool],
        progress: Callable[[str], None] = lambda _: None,
        iterations: int = ITERATIONS,
    ) -> ExcitationSettings:
        """Return the best motion found, never a worse one than the configuration's, if that keeps the limits.

        goes_on: called with the number of climbs so far, returns whether there is to be another; the first is always
        made. progress: called with a line for each better motion. iterations: most of one climb and penalty. A `seed`
        always gives the same sequence of climbs. Raises NoExcitationError if no motion keeps the limits.
        """
        random = np.random.default_rng(seed)
        shape = (2, JOINTS, len(self._order) - 1)
        best = self.present if self.present.period_s and self.overshoot(self.present) <= TOLERANCE else None
        cost = np.inf if best is None else self.figures(best).cost
        start = np.zeros(shape)
        if self.present.period_s:
            start = np.array((self.present.cosine, self.present.sine))[:, :, 1:]
        climbs = 0
        while not climbs or goes_on(climbs):
            if climbs or not self.present.period_s:
                start = random.normal(scale=0.1, size=shape) / self._order[1:]
            found = self._climb(start.ravel(), iterations)
            climbs += 1
            if self.overshoot(found) > TOLERANCE or self.figures(found).cost >= cost:
                continue
            best, figures = found, self.figures(found)
            cost = figures.cost
            progress(
                f"climb {climbs}: smallest eigenvalue {figures.excitation_Nm2s:.3g} Nm² s, "
                f"condition {figures.condition:.3g}"
            )
        if best is None:
            raise NoExcitationError(f"none of {climbs} motions keeps the limits; search longer or with another seed")
        return best

    def _climb(self, start: Vector, iterations: int) -> ExcitationSettings:
        """Return the motion at the end of a climb, in which exceeded limits cost more and more; it may exceed some.

        start: flat coefficients of the harmonics from the second on. iterations: most per penalty.
        """
        found = start
        for penalty in _PENALTIES:
            found = minimize(self._cost, found, (penalty,), "L-BFGS-B", options={"maxiter": iterations}).x
        cosine, sine = self._complete(np.round(found, _DIGITS))
        rows = [tuple(tuple(round(float(x), _DIGITS) for x in row) for row in part) for part in (cosine, sine)]
        return ExcitationSettings(self._period_s, *rows)  # type: ignore[arg-type]  # JOINTS rows each

    def _complete(self, free: Vector) -> tuple[Vector, Vector]:
        """Return cosine and sine coefficients (2, K) of a motion from rest.

        free: flat cosine and sine coefficients of the harmonics from the second on (2 * 2 * (K - 1),).
        """
        cosine, sine = free.reshape(2, JOINTS, -1)
        order = self._order[1:]
        return (
            np.column_stack((-cosine @ order**2, cosine)),
            np.column_stack((-sine @ order, sine)),
        )

    def motion_of(self, cosine: Vector, sine: Vector) -> Vector:
        """Return q, dq and ddq (3, N, 2) of an excitation at all samples of the search, rad, rad/s, rad/s².

        cosine, sine (2, K): coefficients, in amplitudes of the trajectory, as in `ExcitationSettings`.
        """
        cosine, sine = (self._amplitude * part.T for part in (cosine, sine))
        rate = self._rad_s[:, np.newaxis]
        return np.array(
            (
                -self._amplitude + (self._cosine - 1.0) @ cosine + self._sine @ sine,
                self._cosine @ (rate * sine) - self._sine @ (rate * cosine),
                -self._cosine @ (rate**2 * cosine) - self._sine @ (rate**2 * sine),
            )
        )

    def _regressors(self, motion: Vector) -> Vector:
        """Return the regressors of the dynamic parameters (N, 2, base) along a motion (3, N, 2)."""
        W = np.empty((motion.shape[1], JOINTS, self._base))
        _fill_regressors(motion[0], motion[1], motion[2], self._level_rad, W)
        return W

    def _used(self, motion: Vector, W: Vector) -> list[Vector]:
        """Return the share of each limit that a motion uses at each sample, (N, 2) per limit; over 1: exceeded."""
        values = motion if self._theta is None else (*motion, W @ self._theta)
        return [np.abs(value) / limit for value, limit in zip(values, self._limits, strict=False)]

    def _shown(self, dynamic: Vector) -> tuple[float, float, float]:
        """Return smallest and largest eigenvalue of the fit's information, and the smallest of the inertia's, Nm² s.

        The latter is of the shortest fit of a payload, on the inertia's parameters alone. dynamic (N, 2, base): from
        `_regressors`.
        """
        W = np.zeros((self._fit, JOINTS, len(self._scale)))
        W[:, :, : self._base] = dynamic[: self._fit]
        for joint in range(JOINTS):
            W[:, joint, self._base + joint] = 1.0
        W_f = lfilter(*self._taps, W, axis=0)
        if self._theta is not None:
            tau, tau_f = (value[:, :, : self._base] @ self._theta for value in (W, W_f))
            for joint in range(JOINTS):
                W_f[:, joint, self._base + JOINTS + joint] = self._cutoff * (tau - tau_f)[:, joint]
        fit = self._eigenvalues(W_f, self._scale)
        inertia = self._eigenvalues(W_f[: self._payload_fit, :, :3], self._scale[:3])
        return float(fit[0]), float(fit[-1]), float(inertia[0])

    def _eigenvalues(self, W_f: Vector, scale: Vector) -> Vector:
        """Return the eigenvalues of the information of filtered regressors (N, 2, c), ascending.

        scale (c,): factor on each column, the error of its parameter that must not stay hidden.
        """
        rows = (W_f * scale).reshape(-1, len(scale))
        return np.asarray(np.linalg.eigvalsh(self._step_s * rows.T @ rows), dtype=np.float64)

    def _cost(self, free: Vector, penalty: float) -> float:
        """Return the cost of a motion, the lower the better it identifies, plus a penalty for exceeded limits.

        The cost is `Figures.cost`, made smooth in the coefficients. The penalty is `penalty` times the mean square of
        the excess, as share of the limit, summed over the limits. free: flat coefficients of the harmonics from
        the second on.
        """
        motion = self.motion_of(*self._complete(free))
        W = self._regressors(motion)
        over = sum(float(np.mean(np.maximum(used - 1.0, 0.0) ** 2)) for used in self._used(motion, W))
        for joint, column in enumerate((F_C1, F_C2)):
            W[:, joint, column] = np.tanh(motion[1, :, joint] / _SMOOTH_RAD_S)
        smallest, largest, inertia = (max(value, _SMALLEST) for value in self._shown(W))
        return _cost_of(smallest, largest / smallest, inertia) + penalty * over


def _cost_of(smallest: float, condition: float, inertia: float) -> float:
    return float(-np.log(max(smallest, _SMALLEST)) - 0.5 * np.log(max(inertia, _SMALLEST)) + 0.25 * np.log(condition))
