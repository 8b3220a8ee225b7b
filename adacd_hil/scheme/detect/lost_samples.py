"""Lost samples: the thresholds widen by the uncertainty that they leave.

Lost samples are interpolated on a straight line, or cut out of time.

Of n periods, n - 1 of them on the line between their neighbours, dt in all, a filter of cut-off a sees up to

    G += (k_tau sigma a dt)² (1 - 1 / n) / 2 + (a dt (CURVATURE dt² / 12 + F_c [sgn dq has changed]))²

more: the noise of two samples in the place of n, and the line's error in torque and friction. After a gap that is cut
out, the velocity's noise stays in S, G += (2 a nu)² (M R M')_ii. The filters forget it: G e^(-2 a t).

Shapes: C filters, n joints; lost_Nm2 (C, n): G.
"""

import math

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.scheme.detect import sensitivity
from adacd_hil.scheme.memory import Constants, Memory

CURVATURE_NM_S2 = 500.0
"""Second derivative of the torque: 2.5 Nm at 2.2 Hz, or 0.5 Nm at 5 Hz."""
MOST_FILLED = 8
"""Largest number of missing samples that are interpolated."""


@compiled
def follow_lost(k: Constants, m: Memory, dq: Vector, steps: int, period_s: float, is_seen: bool) -> None:
    """Update `lost_Nm2` (C, n), the variance by missing samples, by a sample that came `steps` periods after the last.

    It decays; filled gaps (steps above 1) add noise and the line's error, with friction for a joint that has turned; a
    cut adds the velocity's noise. dq (n,): of this sample; `m.gaps.last` must still hold the sample before. period_s:
    time since it. is_seen: the missing samples were interpolated; False: that time was cut out.
    """
    lost, before = m.lost.lost_Nm2, m.gaps.last[1]
    for c in range(lost.shape[0]):
        turn = k.cutoff[c] * period_s
        decay = math.exp(-2.0 * turn)
        noise = (k.noise_sigmas * k.torque_noise_Nm * turn) ** 2 * 0.5 * (1.0 - 1.0 / steps)
        for i in range(lost.shape[1]):
            lost[c, i] *= decay
            if is_seen and steps > 1:
                has_turned = np.sign(dq[i]) != np.sign(before[i])
                left_out = CURVATURE_NM_S2 * period_s**2 / 12.0 + (m.sensitivity.hold[i] if has_turned else 0.0)
                lost[c, i] += noise * m.sensitivity.roughness[i] + (turn * left_out) ** 2
            elif not is_seen:
                lost[c, i] += (2.0 * k.cutoff[c] * k.noise.velocity_noise_rad_s) ** 2 * sensitivity.momentum_noise(m, i)
