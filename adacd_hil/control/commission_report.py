"""Why an arm does not get through INIT and COMMISSION: what kept it from being ready, and in how many cycles."""

from collections import Counter

from adacd_hil.config import Settings
from adacd_hil.device.arm import Arm
from adacd_hil.records import JOINTS, ArmState, FaultReason, SchemeState

_STATES = (SchemeState.INIT, SchemeState.COMMISSION)


class CommissionReport:
    """Counts causes while the arm is in these states."""

    def __init__(self, settings: Settings, arm: Arm) -> None:
        self._arm = arm
        self._rest_velocity_rad_s = settings.safety.rest_velocity_rad_s
        self._rest_torque_Nm = settings.safety.rest_torque_Nm
        self._cycles = 0
        self._causes: Counter[str] = Counter()
        self._worst = [0.0] * (2 * JOINTS)

    def note(self, state: SchemeState, arm: ArmState) -> None:
        """Take in a cycle; `state`: that of the scheme after the cycle before."""
        if state not in _STATES:
            return
        self._cycles += 1
        if not arm.is_complete:
            self._causes.update(f"{name}: no usable frame in time" for name in self._arm.missing_names())
        if arm.fault is not FaultReason.NONE:
            self._causes[f"fault {arm.fault.name}"] += 1
        for joint in range(JOINTS):
            for kind, (value, bound) in enumerate(
                ((arm.dq[joint], self._rest_velocity_rad_s), (arm.tau_J[joint], self._rest_torque_Nm))
            ):
                if not abs(value) < bound:
                    place = JOINTS * kind + joint
                    self._worst[place] = max(self._worst[place], abs(float(value)))
                    self._causes[f"{kind}{joint}"] += 1

    def describe(self) -> list[str]:
        """Name the causes, the most frequent first, one line each; empty when nothing was wrong in any cycle."""
        return [
            f"{self._text(cause)} in {count} of {self._cycles} cycles" for cause, count in self._causes.most_common()
        ]

    def _text(self, cause: str) -> str:
        if not cause.isdecimal():
            return cause
        kind, joint = int(cause[0]), int(cause[1])
        worst = self._worst[JOINTS * kind + joint]
        if kind == 0:
            return (
                f"joint {joint + 1} moves: |dq| up to {worst:.3g} rad/s, "
                f"safety.rest_velocity_rad_s = {self._rest_velocity_rad_s:g} rad/s,"
            )
        return (
            f"joint {joint + 1} is loaded: |tau_J| up to {worst:.3g} Nm, "
            f"safety.rest_torque_Nm = {self._rest_torque_Nm:g} Nm,"
        )
