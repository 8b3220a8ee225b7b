"""The end of an adaptation: eq. (15), and the evidence without which eq. (15) proves little.

Eq. (15): |tau_ext_hat| <= beta on every joint for T without a break. The paper's t0 is the time of the last violation;
counted from the start of the adaptation, a start from theta_hat = 0 could never end. An arm that stands still fulfils
it with any parameters, so the motion since the adaptation began counts, too (`excitation`).

Shapes: tau_ext_hat, q, dq (2,); W_f (2, p).

**The certified scheme.** The evidence that completes a fit, its missing parts, and the test that makes it a
certificate.

A fit is complete after its shortest time when

- each joint has travelled and moved in both directions far and fast enough (a payload leaves friction as it was);
- no combination of parameters stayed hidden: smallest eigenvalue and condition number of
  D (∫ W_f' W_f) D; with a payload, earlier knowledge counts too, so only the next points are required;
- each parameter is known: the standard deviation that the belief gives it is small enough;
- the inertia is positive definite at every q.

Then the model is frozen, friction coefficients below zero put to zero, and tested on motion that it was not fitted to.
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, PARAMETER_UNITS, Vector
from adacd_hil.scheme.identify.excitation import begin, begin_speeds, eigenvalue_range, gather, has_moved, widen
from adacd_hil.scheme.memory import Constants, Memory
from adacd_hil.scheme.model.regressor import is_positive_definite


@compiled
def is_quiet(tau_ext_hat: Vector, beta_Nm: float) -> bool:
    """Return whether |tau_ext_hat| is at most beta_Nm in each joint, as in eq. (15); False with a NaN among them."""
    return bool(np.all(np.abs(tau_ext_hat) <= beta_Nm))


@compiled
def begin_fit(m: Memory) -> None:
    """Clear the evidence that the fit is complete, as a new one begins: motion, excitation, condition."""
    begin(m.motion)
    m.fit.excitation = 0.0
    m.fit.condition = np.inf


@compiled
def follow(k: Constants, m: Memory, q: Vector, dq: Vector, W_f: Vector) -> bool:
    """Add a sample, W_f (n, p), to the evidence of a fit; return whether it is complete, see `is_complete`.

    Only each EXCITATION_EVERY-th sample brings excitation and condition up to date.
    """
    if gather(m.motion, q, dq, W_f, k.period_s):
        smallest, largest = eigenvalue_range(m.motion.information, k.scale, m.motion.scratch)
        m.fit.excitation = smallest
        m.fit.condition = largest / smallest if smallest > 0.0 else np.inf
    return is_complete(k, m)


@compiled
def begin_test(k: Constants, m: Memory, square: float) -> None:
    """Begin the test of a frozen model: set its count to 0, clear the joints' speeds, and set `test_limit_Nm`.

    square: mean square of the fit's residuals over that of the settings.
    """
    m.fit.tested = 0.0
    m.fit.test_limit_Nm = test_limit_Nm(k, square)
    begin_speeds(m.motion)


@compiled
def test(k: Constants, m: Memory, dq: Vector, tau_ext_hat: Vector) -> int:
    """Add a sample to the test; return -1 if the model is refuted, 1 if it has passed, 0 if the test goes on.

    Refuted: a joint's |tau_ext_hat| is over `test_limit_Nm`, or NaN. Passed: `test_cycles` samples, and each joint has
    once reached the speed `velocity_rad_s`; one direction is enough.
    """
    own = m.motion
    m.fit.tested += 1.0
    widen(dq, own.dq_low, own.dq_high)
    if not is_quiet(tau_ext_hat, m.fit.test_limit_Nm):
        return -1
    is_fast = np.all(np.maximum(own.dq_high, -own.dq_low) >= k.velocity_rad_s)
    is_long = m.fit.tested >= k.test_cycles[int(m.models.is_payload)]
    return 1 if is_long and is_fast else 0


TEST_NM = 0.03
TEST_SHARE = 6.0
"""Largest residual in a test, and deviations of the residuals of the fit's later half beside it."""


@compiled
def is_complete(k: Constants, m: Memory) -> bool:
    """Return whether a fit can be frozen.

    There must be enough samples, a mass matrix that is positive definite, and a small enough deviation of each
    parameter; without a payload also enough excitation, a condition that is small enough, and enough motion of each
    joint.
    """
    own = m.motion
    if own.samples < k.fit_cycles[int(m.models.is_payload)] or not is_positive_definite(m.models.belief):
        return False
    if not np.all(np.diag(m.models.P_belief) <= k.enough_std**2):
        return False
    if m.models.is_payload:
        return True
    is_excited = m.fit.excitation >= k.excitation_Nm2s and m.fit.condition <= k.condition
    return is_excited and has_moved(own, k.travel_rad, k.velocity_rad_s)


@compiled
def test_limit_Nm(k: Constants, square: float) -> float:
    """Return the largest |tau_ext_hat| of the slowest filter, Nm, that a test allows; at most `beta_Nm`.

    square: mean square of the fit's residuals over that of the settings. If the fit explains the arm well, the test
    requires the same: a torque just below `beta_Nm` may be a touch that was half learnt.
    """
    return float(min(k.beta_Nm, TEST_NM + TEST_SHARE * k.residual_Nm * np.sqrt(square)))


def describe_missing(k: Constants, m: Memory, names: tuple[str, ...]) -> list[str]:
    """Return a line for each unmet condition of `is_complete`, with the motion that fulfils it.

    The line on too few samples names no motion. [] if the fit is complete. names: of the parameters, in the belief's
    order.
    """
    own = m.motion
    lines = []
    travel, speed = np.degrees(k.travel_rad), np.degrees(k.velocity_rad_s)
    enough_samples = k.fit_cycles[int(m.models.is_payload)]
    if own.samples < enough_samples:
        lines.append(f"{own.samples:.0f} samples in a row are undisturbed, {enough_samples:.0f} needed")
    if not m.models.is_payload:
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
        for i in range(JOINTS):
            travelled = max(np.degrees(own.q_high[i] - own.q_low[i]), 0.0)
            if not travelled >= travel:
                lines.append(f"joint {i + 1} has travelled {travelled:.1f} deg of {travel:g}: move it further")
            fastest, slowest = np.degrees(own.dq_high[i]), np.degrees(own.dq_low[i])
            if not (fastest >= speed and slowest <= -speed):
                lines.append(
                    f"joint {i + 1} has moved at {min(slowest, 0.0):.1f} to {max(fastest, 0.0):.1f} deg/s, "
                    f"{speed:g} both ways needed: move it back and forth"
                )
    if not is_positive_definite(m.models.belief):
        lines.append("the estimated mass matrix is not positive definite: accelerate both joints harder")
    for j, name in enumerate(names):
        std, enough = np.sqrt(m.models.P_belief[j, j]), k.enough_std[j]
        if not std <= enough:
            unit = PARAMETER_UNITS.get(name, "")
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
    """Return the text of a motion by which the parameter `name` is learnt, such as "accelerate joint 2 harder".

    The joint is the name's last character. An unknown parameter is learnt by slow motion with dwells.
    """
    found = (text for key, text in _MOTIONS.items() if name.startswith(key))
    return next(found, "move joint {} slowly, and with dwells").format(name[-1])
