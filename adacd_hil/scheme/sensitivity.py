"""The thresholds of the certified scheme: what each filter's residual may be without a contact.

    h = k sqrt(noise² + w P w') + sum_j |w_j| rho_j |theta_j| + F_c near

- noise: the sensors', as this filter passes it on. White torque noise gives sigma_tau² a T / 2, more by `roughness`
  if a sensor at rest was found to be noisier than the settings say. Noise of the velocity
  comes through the momentum, M(q) dq, whose change the filter sees: a M sigma_dq to the high-pass side of the filter.
- w P w': what the belief leaves open about this very motion, w the filtered regressor's row.
- rho: what stays unexplained of each parameter's part however long one learns (a lag that is not quite one, a friction
  that is not quite tanh), taken as a bound: the parts may add up.
- near: where a joint stands or turns round its friction may be anything up to F_c; 1 at rest, falling off over
  `reversal_rad_s` and filtered as the torque is.

Shapes: C filters, n joints, p parameters; y, h, near (C, n); W_f (C, n, p); M (n, n). Units: Nm.
"""

from typing import Any

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector


@compiled
def follow_reversal(dq: Vector, reversal_rad_s: float, decay: Vector, near: Vector) -> None:
    """Filter with DC gain 1, into near (C, n) from 0 to 1, how near each joint is to standing still."""
    for c in range(near.shape[0]):
        for i in range(dq.shape[0]):
            share = 0.0
            if reversal_rad_s > 0.0:
                share = 1.0 / (1.0 + (dq[i] / reversal_rad_s) ** 2)
            near[c, i] = share + decay[c] * (near[c, i] - share)


@compiled
def fill_thresholds(k: Any, m: Any, h: Vector) -> None:
    """Fill h (C, n) from the constants `k` and the state `m` of the kernel."""
    for c in range(h.shape[0]):
        for i in range(h.shape[1]):
            w = m["W_f"][c, i]
            variance = k["torque_variance"][c] * m["roughness"][i]
            for j in range(m["M"].shape[1]):
                variance += k["velocity_variance"][c] * m["M"][i, j] ** 2
            error = k["reversal_share"] * max(m["theta"][int(k["first_coulomb"]) + i], 0.0) * m["near"][c, i]
            for j in range(w.shape[0]):
                row = 0.0
                for n in range(w.shape[0]):
                    row += m["P"][j, n] * w[n]
                variance += w[j] * row
                error += k["model_error"][j] * abs(w[j] * m["theta"][j])
            h[c, i] = k["sigmas"][c] * np.sqrt(max(variance, 0.0)) + error


@compiled
def joints_over(y: Vector, h: Vector) -> int:
    """Return the joints that are over their threshold in any filter, as bits; what is not a number counts as over."""
    joints = 0
    for c in range(y.shape[0]):
        for i in range(y.shape[1]):
            if not (abs(y[c, i]) <= h[c, i]):
                joints |= 1 << i
    return joints
