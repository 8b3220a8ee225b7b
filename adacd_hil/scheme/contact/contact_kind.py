"""The kind of a contact, push or hit: by the share of the torque that remains 100 ms after the detection.

A hit is over by then: after a blow of 100 ms at most a seventh of its largest torque remains, and after a body is
pushed away no torque remains. A push still grows or lasts. The remaining torque is measured in standard deviations of
the joints, so that the more certain joint weighs more.

A hand that grasps a moving arm stops it and then guides it; the kind follows from the torque that remains when the arm
has stopped. A clamped body is a hit if it springs back, a push if it stays under load: transient and quasi-static
contact of ISO/TS 15066.
"""

import numpy as np

from adacd_hil.records import ContactKind, Vector

END_S = 0.01
"""The remaining torque is the mean over this time at the end of the window."""
LEFT = 0.18
"""A push retains at least this part of its largest torque. Of 600 random contacts of 5 to 60 N the 299 half-sines of 20
to 100 ms left at most 0.142, the 301 pushes that rise in 0.2 to 1 s at least 0.239."""


def classify(tau_ext_wide_hat: Vector, sigma: Vector, period_s: float) -> ContactKind:
    """Return PUSH if the mean torque of the last END_S is at least LEFT times the largest torque, else HIT.

    HIT also without any torque. A torque is the root of the sum of the joints' squares, each in units of its standard
    deviation; the mean is that of each joint's signed torque. tau_ext_wide_hat: external torque (n, 2), Nm, with the
    filter undone, from the contact's beginning to the end of its window; sigma: its standard deviation (2,), Nm.
    """
    torques = tau_ext_wide_hat / sigma
    left = np.hypot(*np.mean(torques[-max(1, round(END_S / period_s)) :], axis=0))
    largest = np.max(np.hypot(*torques.T))
    return ContactKind.PUSH if left >= LEFT * largest > 0.0 else ContactKind.HIT
