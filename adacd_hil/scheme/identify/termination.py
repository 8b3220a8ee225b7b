"""The end of an adaptation: eq. (15), and the evidence without which eq. (15) proves little.

Eq. (15): |tau_ext_hat| <= beta on every joint for T without a break. The paper's t0 is the time of the last violation;
counted from the start of the adaptation, a start from theta_hat = 0 could never end. An arm that stands still fulfils
it with any parameters, so three things must have been seen since the adaptation began:

- each joint has travelled far enough;
- each joint has moved fast enough in both directions, which shows both signs of its Coulomb friction;
- no combination of parameters stayed hidden. The information matrix sum T W_f' W_f is scaled by a parameter error of
  each kind (`TerminationSettings.excitation_scale`): D I D with D = diag(scale). Its smallest eigenvalue is the least
  energy, in (filtered Nm)² s, with which an error of that size has shown in the residual, whatever its direction. The
  scale is not P(0): with a gain a hundred times as high, the evidence must not become a hundred times as easy.
  The paper's motion, as printed or synchronous, reaches 6.7e-4 to 7.9e-4 in 5.2 s on the profiles P, S and M; the
  default of 2e-4 is a third of that, and is passed only after joint 1 has gone back and forth once.

Shapes: tau_ext_hat, q, dq (2,); W_f (2, p); information (p, p).

**The certified scheme.** The evidence that completes a fit, its missing parts, and the test that makes it a
certificate.

A fit is complete after its shortest time when

- each joint has travelled and moved in both directions far and fast enough (a payload leaves friction as it was);
- no combination of parameters stayed hidden: smallest eigenvalue and condition number of D (∫ W_f' W_f) D, see
  above; with a payload, earlier knowledge counts too, so only the next point is required;
- each parameter is known: the standard deviation that the belief gives it is small enough;
- the inertia is positive definite at every q.

Then the model is frozen, friction coefficients below zero put to zero, and tested on motion that it was not fitted to.
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.scheme.memory import Constants, Memory, Motion
from adacd_hil.scheme.model.regressor import is_positive_definite

EXCITATION_EVERY = 64
"""Samples between two looks at the smallest eigenvalue: it takes 4 µs, the rest of a step less than 1 µs."""

_SWEEPS = 12
"""Most sweeps of Jacobi's method. Convergence is quadratic; 6 sweeps reach rounding for 9 x 9."""


@compiled
def begin(motion: Motion) -> None:
    """Clear the ranges of the joints' position and velocity, the information matrix, and the count of samples."""
    motion.samples = 0.0
    motion.q_low[:] = np.inf
    motion.q_high[:] = -np.inf
    motion.dq_low[:] = np.inf
    motion.dq_high[:] = -np.inf
    motion.information[:] = 0.0


@compiled
def is_quiet(tau_ext_hat: Vector, beta_Nm: float) -> bool:
    """Return whether |tau_ext_hat| is at most beta_Nm in each joint, eq. (15); False if a value is not a number."""
    is_within = True
    for i in range(tau_ext_hat.shape[0]):
        is_within = is_within and abs(tau_ext_hat[i]) <= beta_Nm
    return is_within


@compiled
def widen(value: Vector, low: Vector, high: Vector) -> None:
    """Widen the range low .. high (2,) in place so that it holds `value` (2,)."""
    for i in range(value.shape[0]):
        low[i] = min(low[i], value[i])
        high[i] = max(high[i], value[i])


@compiled
def has_moved(motion: Motion, travel_rad: float, velocity_rad_s: float) -> bool:
    """Return whether each joint's range is at least `travel_rad`, and its speed at least `velocity_rad_s` both ways."""
    for i in range(motion.q_low.shape[0]):
        if not (motion.q_high[i] - motion.q_low[i] >= travel_rad):
            return False
        if not (motion.dq_high[i] >= velocity_rad_s and motion.dq_low[i] <= -velocity_rad_s):
            return False
    return True


@compiled
def add_information(W_f: Vector, period_s: float, information: Vector) -> None:
    """Add T W_f' W_f to the lower triangle of `information` (p, p) in place."""
    for j in range(W_f.shape[1]):
        for k in range(j + 1):
            for i in range(W_f.shape[0]):
                information[j, k] += period_s * W_f[i, j] * W_f[i, k]


@compiled
def gather(motion: Motion, q: Vector, dq: Vector, W_f: Vector, period_s: float) -> bool:
    """Add a sample to the ranges of motion and the information matrix; return True every EXCITATION_EVERY samples."""
    widen(q, motion.q_low, motion.q_high)
    widen(dq, motion.dq_low, motion.dq_high)
    add_information(W_f, period_s, motion.information)
    motion.samples += 1.0
    return bool(motion.samples % EXCITATION_EVERY == 0.0)


@compiled
def eigenvalue_range(information: Vector, scale: Vector, scratch: Vector) -> tuple[float, float]:
    """Return the smallest and the largest eigenvalue of D I D, D = diag(scale), from the lower triangle of I (p, p).

    By Jacobi's cyclic rotations on `scratch` (p, p): the same bits on every machine, which LAPACK does not promise.
    """
    count = scale.shape[0]
    trace = 0.0
    for j in range(count):
        for k in range(j + 1):
            scratch[j, k] = scale[j] * information[j, k] * scale[k]
            scratch[k, j] = scratch[j, k]
        trace += scratch[j, j]
    for _ in range(_SWEEPS):
        off_diagonal = 0.0
        for j in range(count):
            for k in range(j):
                off_diagonal = max(off_diagonal, abs(scratch[j, k]))
        if off_diagonal <= 1e-15 * trace:
            break
        for j in range(count):
            for k in range(j):
                _rotate(scratch, j, k)
    smallest: float = scratch[0, 0]
    largest: float = scratch[0, 0]
    for j in range(1, count):
        smallest = min(smallest, scratch[j, j])
        largest = max(largest, scratch[j, j])
    return max(smallest, 0.0), max(largest, 0.0)


@compiled
def _rotate(matrix: Vector, j: int, k: int) -> None:
    """Rotate the symmetric `matrix` in place in the plane of axes j and k so that its element (j, k) becomes zero."""
    if matrix[j, k] == 0.0:
        return
    half_difference = 0.5 * (matrix[k, k] - matrix[j, j])
    ratio = half_difference / matrix[j, k]
    tangent = 1.0 / (abs(ratio) + np.sqrt(1.0 + ratio * ratio))
    if ratio < 0.0:
        tangent = -tangent
    cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    for i in range(matrix.shape[0]):
        at_j, at_k = matrix[i, j], matrix[i, k]
        matrix[i, j] = cosine * at_j - sine * at_k
        matrix[i, k] = sine * at_j + cosine * at_k
    for i in range(matrix.shape[0]):
        at_j, at_k = matrix[j, i], matrix[k, i]
        matrix[j, i] = cosine * at_j - sine * at_k
        matrix[k, i] = sine * at_j + cosine * at_k


@compiled
def begin_fit(m: Memory) -> None:
    """Clear the evidence of the fit before in the certified scheme, with excitation 0 and condition inf."""
    begin(m.motion)
    m.fit.excitation = 0.0
    m.fit.condition = np.inf


@compiled
def follow(k: Constants, m: Memory, q: Vector, dq: Vector, W_f: Vector) -> bool:
    """Add a sample, W_f (n, p), to the evidence of a fit; return whether it is complete, see `is_complete`."""
    if gather(m.motion, q, dq, W_f, k.period_s):
        smallest, largest = eigenvalue_range(m.motion.information, k.scale, m.motion.scratch)
        m.fit.excitation = smallest
        m.fit.condition = largest / smallest if smallest > 0.0 else np.inf
    return is_complete(k, m)


@compiled
def begin_test(k: Constants, m: Memory, square: float) -> None:
    """Begin the test of a frozen model: clear its count and the joints' speeds, and set the largest residual allowed.

    square: mean square of the fit's residuals over that of the settings.
    """
    m.fit.tested = 0.0
    m.fit.test_limit_Nm = test_limit_Nm(k, square)
    m.motion.dq_low[:] = np.inf
    m.motion.dq_high[:] = -np.inf


@compiled
def test(k: Constants, m: Memory, dq: Vector, tau_ext_hat: Vector) -> int:
    """Add a sample to the test; return -1 if the model is refuted, 1 if it has passed, 0 if the test goes on.

    Refuted: a joint's |tau_ext_hat| is over `test_limit_Nm`. Passed: `test_cycles` samples, and each joint has once
    reached `velocity_rad_s`.
    """
    own = m.motion
    m.fit.tested += 1.0
    widen(dq, own.dq_low, own.dq_high)
    has_moved = True
    for i in range(dq.shape[0]):
        if not (abs(tau_ext_hat[i]) <= m.fit.test_limit_Nm):
            return -1
        fastest = max(own.dq_high[i], -own.dq_low[i])
        has_moved = has_moved and fastest >= k.velocity_rad_s
    is_long = m.fit.tested >= k.test_cycles[int(m.models.is_payload)]
    return 1 if is_long and has_moved else 0


TEST_NM = 0.03
TEST_SHARE = 6.0
"""Largest residual in a test, and deviations of the residuals of the fit's later half beside it."""


@compiled
def is_complete(k: Constants, m: Memory) -> bool:
    """Return whether a fit can be frozen: enough samples, inertia, each parameter known, enough excitation and motion.

    Inertia: the mass matrix is positive definite. With a payload the first three are enough.
    """
    own = m.motion
    is_payload = m.models.is_payload != 0.0
    if own.samples < k.fit_cycles[1 if is_payload else 0] or not is_positive_definite(m.models.belief):
        return False
    for j in range(m.models.belief.shape[0]):
        if not (m.models.P_belief[j, j] <= k.enough_std[j] ** 2):
            return False
    if is_payload:
        return True
    if not (m.fit.excitation >= k.excitation_Nm2s and m.fit.condition <= k.condition):
        return False
    return has_moved(own, k.travel_rad, k.velocity_rad_s)


@compiled
def test_limit_Nm(k: Constants, square: float) -> float:
    """Return the largest |tau_ext_hat| of the slowest filter that a test allows.

    square: mean square of the fit's residuals over that of the settings. If the fit explains the arm well, the test
    requires the same: a torque just below `beta_Nm` may be a touch that was half learnt.
    """
    return float(min(k.beta_Nm, TEST_NM + TEST_SHARE * k.residual_Nm * np.sqrt(square)))


def describe_missing(k: Constants, m: Memory, names: tuple[str, ...], units: dict[str, str]) -> list[str]:
    """Return a line for each unmet condition of `is_complete`, with the motion that fulfils it.

    names: of the parameters, in the belief's order. units: by parameter's name.
    """
    own = m.motion
    lines = []
    joints = own.q_low.shape[0]
    travel, speed = float(np.degrees(k.travel_rad)), float(np.degrees(k.velocity_rad_s))
    enough_samples = k.fit_cycles[int(m.models.is_payload)]
    if own.samples < enough_samples:
        lines.append(f"{own.samples:.0f} samples in a row are undisturbed, {enough_samples:.0f} needed")
    if m.models.is_payload == 0.0:
        if not m.fit.excitation >= k.excitation_Nm2s:
            lines.append(
                f"the motion excites the parameters by {m.fit.excitation:.2g} Nm² s, certified.excitation_Nm2s = "
                f"{k.excitation_Nm2s:.2g} needed: move the arm further and faster"
            )
        if not m.fit.condition <= k.condition:
            lines.append(
                f"the parameters can't be told apart: condition {m.fit.condition:.2g}, certified.condition = "
                f"{k.condition:.2g} allowed: a motion that shows each of them, or a model with fewer "
                "(estimator.gravity of an arm that hardly feels it)"
            )
        for i in range(joints):
            travelled = max(float(np.degrees(own.q_high[i] - own.q_low[i])), 0.0)
            if not travelled >= travel:
                lines.append(f"joint {i + 1} has travelled {travelled:.1f} deg of {travel:g}: move it further")
            fastest, slowest = float(np.degrees(own.dq_high[i])), float(np.degrees(own.dq_low[i]))
            if not (fastest >= speed and slowest <= -speed):
                lines.append(
                    f"joint {i + 1} has moved at {min(slowest, 0.0):.1f} to {max(fastest, 0.0):.1f} deg/s, "
                    f"{speed:g} both ways needed: move it back and forth"
                )
    if not is_positive_definite(m.models.belief):
        lines.append("the estimated mass matrix is not positive definite: accelerate both joints harder")
    for j, name in enumerate(names):
        std, enough = float(np.sqrt(m.models.P_belief[j, j])), float(k.enough_std[j])
        if not std <= enough:
            unit = units.get(name, "")
            lines.append(f"{name} is known to {std:.3g} {unit}, {enough:.3g} needed: {_motion_for(name)}")
    return lines


_MOTIONS = {
    "a1": "accelerate joint 1 harder",
    "a2": "accelerate joint 1 with the elbow bent and with it straight",
    "a3": "accelerate joint 2 harder",
    "a4": "move the arm through poses that gravity loads differently",
    "a5": "move the arm through poses that gravity loads differently",
    "F_v": "move joint {} at different speeds",
    "F_c": "move joint {} slowly in both directions",
    "offset": "move joint {} in both directions, or tare the sensors",
    "lag": "accelerate joint {} harder",
}


def _motion_for(name: str) -> str:
    """Return the text of a motion by which the parameter `name` is learnt."""
    found = (text for key, text in _MOTIONS.items() if name.startswith(key))
    return next(found, "move joint {} slowly, and with dwells").format(name[-1])
