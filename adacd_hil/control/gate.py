"""The last stage before the wire: commanded torques are finite, within the arm's limits, and zero unless allowed."""

import math
from enum import IntFlag

from adacd_hil.records import JOINTS, Vector
from adacd_hil.settings.arm_settings import MOST_BLIND_CYCLES, OLD_CYCLES, ArmSettings


class GateFlag(IntFlag):
    """Changes that the gate made to the torque in one cycle."""

    NONE = 0
    TORQUE = 1  # clipped to torque_limit_Nm
    RATE = 2  # clipped to torque_rate_limit_Nm_s
    NOT_A_NUMBER = 4  # a desired torque was not finite; all torques are zero
    CLOSED = 8  # torque is not allowed in this state; all torques are zero
    HELD = 16  # the feedback is older than OLD_CYCLES: the torque may fall and not grow


FADING = 0.8
"""Factor on the torque in each further cycle: 1 % is left after 20."""


class Gate:
    """Limits the torques of both joints. Keeps the last commanded torque, for the rate limit."""

    def __init__(self, settings: ArmSettings, period_s: float) -> None:
        self._limit_Nm = settings.torque_limit_Nm
        self._step_Nm = tuple(rate * period_s for rate in settings.torque_rate_limit_Nm_s)
        self._last_Nm = [0.0] * JOINTS

    def limit(self, tau_d: Vector, is_open: bool, tau_c: Vector, age: int = 0) -> GateFlag:
        """Fill `tau_c` (2,) with the commanded torque for `tau_d` (2,), Nm; return the changes that were made.

        `arm.torque_limit_Nm` limits the torque, `arm.torque_rate_limit_Nm_s` its rate. is_open: False makes it zero at
        once; after that it rises at the limited rate. A `tau_d` that isn't finite makes it zero, too. `age`: of the
        feedback in cycles; beyond OLD_CYCLES the torque can't grow, beyond MOST_BLIND_CYCLES it fades. Call it once per
        cycle.
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
            if age > OLD_CYCLES:
                most = last if age <= MOST_BLIND_CYCLES else FADING * last
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
        """Set `tau_c` and the last torque to zero; return `flag`."""
        self._last_Nm = [0.0] * JOINTS
        tau_c[:] = 0.0
        return flag
