"""Push or hit: by what is left of a contact when 100 ms have passed since it was detected.

A hit is over by then: a blow of 100 ms has at most a seventh of its largest torque left, a body that has been pushed
away nothing. A push still grows or lasts. What is left is measured in standard deviations of the joints, so that the
joint that knows more says more.

A hand that grasps a moving arm stops it and then guides it; it is called by what is left when the arm has stopped. A
body that is clamped is a hit where it springs back, a push where it stays under load: transient and quasi-static
contact of ISO/TS 15066.
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import ContactKind, Vector

WINDOW_S = 0.1
"""From detection to the decision."""
END_S = 0.01
"""What is left is the mean of this at the end of the window."""
LEFT = 0.18
"""At least this part of the largest torque is left of a push. Of 600 random contacts of 5 to 60 N the 299 half-sines of
20 to 100 ms left at most 0.142, the 301 pushes that rise in 0.2 to 1 s at least 0.239."""


def classify(tau_ext_wide_hat: Vector, sigma: Vector, period_s: float) -> ContactKind:
    """Return the kind of a contact from its external torque (n, 2) with the filter undone, the window's end the last.

    sigma: its standard deviation (2,), Nm.
    """
    share = share_left(tau_ext_wide_hat, sigma, max(1, round(END_S / period_s)))
    return ContactKind.PUSH if share >= LEFT else ContactKind.HIT


@compiled
def share_left(tau: Vector, sigma: Vector, end_samples: int) -> float:
    """Return what is left at the end over the largest, 0 to 1."""
    count = tau.shape[0]
    largest = 0.0
    for k in range(count):
        largest = max(largest, (tau[k, 0] / sigma[0]) ** 2 + (tau[k, 1] / sigma[1]) ** 2)
    left = 0.0
    for i in range(2):
        left += (np.mean(tau[max(count - end_samples, 0) :, i]) / sigma[i]) ** 2
    return float(np.sqrt(left / largest)) if largest > 0.0 else 0.0
