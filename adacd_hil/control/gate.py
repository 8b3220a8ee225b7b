"""The last stage before the wire: what leaves here is finite, within the arm's limits, and zero unless allowed."""

import math
from enum import IntFlag

from adacd_hil.records import JOINTS, Vector
from adacd_hil.settings.arm_settings import ArmSettings


class GateFlag(IntFlag):
    """What the gate changed in one cycle."""

    NONE = 0
    TORQUE = 1  # clipped to torque_limit_Nm
    RATE = 2  # clipped to torque_rate_limit_Nm_s
    NOT_A_NUMBER = 4  # a desired torque was not finite; all torques are zero
    CLOSED = 8  # torque is not allowed in this state; all torques are zero
    HELD = 16  # the feedback is older than a cycle: the torque may fall and not grow


KEPT_CYCLES = 5
"""How long old feedback may keep a torque up: as long as the model may be blind. What is commanded by older feedback
belongs to no motion that anybody knows."""
FADING = 0.8
"""The part of it that is left in each further cycle: 1 % after 20."""


class Gate:
    """Limits the torques of both joints. Knows what it let through last, for the rate."""

    def __init__(self, settings: ArmSettings, period_s: float) -> None:
        self._limit_Nm = settings.torque_limit_Nm
        self._step_Nm = tuple(rate * period_s for rate in settings.torque_rate_limit_Nm_s)
        self._last_Nm = [0.0] * JOINTS

    def limit(self, tau_d: Vector, is_open: bool, tau_c: Vector, age: int = 0) -> GateFlag:
        """Fill `tau_c` (2,) with what may be commanded for `tau_d` (2,), Nm, and say what was changed.

        Torque goes to zero at once when the gate closes, and rises from zero at the limited rate when it opens. `age`:
        of the feedback in cycles; beyond 1 the torque doesn't grow, beyond `KEPT_CYCLES` it fades.
        """
        desired = tau_d.tolist()
        if not all(map(math.isfinite, desired)):
            return self._close(tau_c, GateFlag.NOT_A_NUMBER)
        if not is_open:
            return self._close(tau_c, GateFlag.CLOSED)
        flags = GateFlag.NONE
        for joint in range(JOINTS):
            last, step, bound = self._last_Nm[joint], self._step_Nm[joint], self._limit_Nm[joint]
            wanted = desired[joint]
            if age > 1:
                most = last if age <= KEPT_CYCLES else FADING * last
                kept = min(max(wanted, min(most, 0.0)), max(most, 0.0))
                flags |= GateFlag.HELD if kept != wanted else GateFlag.NONE
                wanted = kept
            if not -bound <= wanted <= bound:
                flags |= GateFlag.TORQUE
                wanted = math.copysign(bound, wanted)
            if not last - step <= wanted <= last + step:
                flags |= GateFlag.RATE
                wanted = last + math.copysign(step, wanted - last)
            tau_c[joint] = self._last_Nm[joint] = wanted
        return flags

    def _close(self, tau_c: Vector, flag: GateFlag) -> GateFlag:
        self._last_Nm = [0.0] * JOINTS
        tau_c[:] = 0.0
        return flag
