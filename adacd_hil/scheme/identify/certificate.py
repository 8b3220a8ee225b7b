"""The evidence that a fit is complete, what is missing of it, and the test that makes it a certificate.

A fit is complete after its shortest time when

- each joint has travelled and moved in both directions far and fast enough (a payload leaves friction as it was);
- no combination of parameters stayed hidden: smallest eigenvalue and condition number of D (∫ W_f' W_f) D, see
  `termination`; with a payload, what was known before counts too, so only the next point is asked for;
- each parameter is known: the standard deviation that the belief gives it is small enough;
- the inertia is positive definite at every q.

Then the model is frozen, friction coefficients below zero put to zero, and tested on motion that it was not fitted to.
"""

from typing import Any

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.scheme.identify import termination

TEST_NM = 0.03
TEST_SHARE = 6.0
"""Largest residual in a test, and deviations of the residuals of the fit's later half beside it."""


@compiled
def is_complete(k: Any, m: Any) -> bool:
    """Tell whether the evidence for a fit is complete, from the constants `k` and the state `m` of the kernel."""
    is_payload = m["is_payload"] != 0.0
    if m["samples"] < k["fit_cycles"][1 if is_payload else 0]:
        return False
    for j in range(m["belief"].shape[0]):
        if not (m["P_belief"][j, j] <= k["enough_std"][j] ** 2):
            return False
    if is_payload:
        return True
    if not (m["excitation"] >= k["excitation_Nm2s"] and m["condition"] <= k["condition"]):
        return False
    return bool(
        termination.has_moved(m["q_low"], m["q_high"], m["dq_low"], m["dq_high"], k["travel_rad"], k["velocity_rad_s"])
    )


@compiled
def test_limit_Nm(k: Any, square: float) -> float:
    """Return how large |tau_ext_hat| of the slowest filter may become in a test.

    square: mean square of the fit's residuals over that of the settings. An arm that its fit explains well is asked for
    as much in the test: what stays below `beta_Nm` only may be a touch that was half learnt.
    """
    return float(min(k["beta_Nm"], TEST_NM + TEST_SHARE * k["residual_Nm"] * np.sqrt(square)))


def describe_missing(k: Any, m: Any, names: tuple[str, ...], units: dict[str, str]) -> list[str]:
    """Say, a line each, what a fit waits for and which motion would show it; `k`, `m` as for `is_complete`."""
    lines = []
    joints = m["q_low"].shape[0]
    travel, speed = float(np.degrees(k["travel_rad"])), float(np.degrees(k["velocity_rad_s"]))
    if m["is_payload"] == 0.0:
        for i in range(joints):
            travelled = max(float(np.degrees(m["q_high"][i] - m["q_low"][i])), 0.0)
            if not travelled >= travel:
                lines.append(f"joint {i + 1} has travelled {travelled:.1f} deg of {travel:g}: move it further")
            fastest, slowest = float(np.degrees(m["dq_high"][i])), float(np.degrees(m["dq_low"][i]))
            if not (fastest >= speed and slowest <= -speed):
                lines.append(
                    f"joint {i + 1} has moved at {min(slowest, 0.0):.1f} to {max(fastest, 0.0):.1f} deg/s, "
                    f"{speed:g} both ways needed: move it back and forth"
                )
    for j, name in enumerate(names):
        std, enough = float(np.sqrt(m["P_belief"][j, j])), float(k["enough_std"][j])
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
    """Propose the motion that shows a parameter."""
    found = (text for key, text in _MOTIONS.items() if name.startswith(key))
    return next(found, "move joint {} slowly, and with dwells").format(name[-1])
