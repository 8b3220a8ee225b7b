"""Where the arm should be: the desired motion in each state of the scheme.

ADAPT and MONITOR follow the trajectory, approached from wherever the arm is; REACT withdraws, or brakes; STOPPED holds;
PAYLOAD and the end of a run park the arm in the trajectory's start corner; elsewhere the desired motion is the measured
place.
"""

from collections.abc import Callable

import numpy as np

from adacd_hil.config import Settings
from adacd_hil.control.excitation import Excitation
from adacd_hil.control.quintic import PEAK_SPEED_FACTOR, corner_to_corner, evaluate, to_rest
from adacd_hil.records import JOINTS, ArmState, SchemeOutput, SchemeState, Vector
from adacd_hil.scheme.reaction import Withdrawal

SHORTEST_APPROACH_S = 0.6
"""Shortest way to the corner when it must also be stopped: from 100 °/s this stays below 400 °/s²."""
PARK_SETTLE_S = 0.3
"""How long a parked arm settles before its drives are disabled: three periods of joint 2's swing with 1 kg, 0.1 s."""
AT_CORNER_RAD = 1e-3
"""Nearer than this the trajectory starts at once: a fifth of a degree, ten encoder steps of the noise."""

_FOLLOWING = (SchemeState.ADAPT, SchemeState.CERTIFY, SchemeState.MONITOR)
_LEARNING = (SchemeState.ADAPT, SchemeState.CERTIFY)

Segment = Callable[[float], None]


class Reference:
    """The desired motion. `q_d`, `dq_d`, `ddq_d` (2,) are views of the control block that it fills."""

    def __init__(self, settings: Settings, q_d: Vector, dq_d: Vector, ddq_d: Vector) -> None:
        self._settings = settings
        self._period_s = settings.bus.period_s
        self._amplitude = np.radians(settings.trajectory.amplitude_deg)
        self._half_period_s = np.array(settings.trajectory.half_period_s)
        self._approach_rad_s = float(np.radians(settings.trajectory.approach_deg_s))
        self._corner = -self._amplitude
        self._q_d, self._dq_d, self._ddq_d = q_d, dq_d, ddq_d
        self._excitation = Excitation(settings)
        self._segment: Segment | None = None
        self._start_cycle = 0
        self._follows_at_cycle: int | None = None
        self._is_parking = False
        self._park_end_cycle = 0

    def compile(self) -> None:
        """Plan and run every kind of motion once, so that nothing happens for the first time in the cycle."""
        zeros = np.zeros(2)
        self._follow(0.0)
        if self._excitation.is_on:
            self._excite(0.0)
        for plan in (
            lambda: self._approach(0),
            lambda: self._withdraw(Withdrawal(self._settings, zeros, zeros, np.ones(2)), 0),
        ):
            plan()
            assert self._segment is not None
            self._segment(0.0)
        self._segment = None
        self._q_d[:] = self._dq_d[:] = self._ddq_d[:] = 0.0

    def park(self) -> None:
        """From the next step on, go to the start corner and stay there."""
        self._is_parking = True
        self._segment = None

    def is_parked(self, cycle: int) -> bool:
        """Whether a commanded parking has come to its end."""
        return self._is_parking and self._segment is not None and cycle >= self._park_end_cycle

    def step(self, arm: ArmState, output: SchemeOutput) -> None:
        """Fill the desired motion of this cycle."""
        cycle = arm.cycle
        if output.state is not output.previous_state:
            self._enter(output, cycle)
        if self._is_parking and self._segment is None:
            self._park_end_cycle = self._approach(cycle) + round(PARK_SETTLE_S / self._period_s)
        if self._segment is None:
            self._q_d[:] = arm.q
            self._dq_d[:] = 0.0
            self._ddq_d[:] = 0.0
            return
        if self._follows_at_cycle is not None and cycle >= self._follows_at_cycle and not self._is_parking:
            excites = self._excitation.is_on and output.state in _LEARNING
            self._start(self._excite if excites else self._follow, self._follows_at_cycle)
            self._follows_at_cycle = None
        self._segment((cycle - self._start_cycle) * self._period_s)

    def _enter(self, output: SchemeOutput, cycle: int) -> None:
        """Choose the motion of a state that begins in this cycle."""
        state = output.state
        ends_excitation = self._excitation.is_on and state is SchemeState.MONITOR
        is_moving_on = state in _FOLLOWING and output.previous_state in _FOLLOWING and not ends_excitation
        self._follows_at_cycle = self._follows_at_cycle if is_moving_on else None
        if self._is_parking or is_moving_on:
            return
        if state in _FOLLOWING:
            self._follows_at_cycle = self._approach(cycle)
        elif state is SchemeState.PAYLOAD:
            self._approach(cycle)
        elif state is SchemeState.REACT:
            # Without a contact there is nothing to withdraw from: the arm brakes to rest.
            tau_ext = np.zeros(JOINTS) if output.contact is None else output.tau_ext_hat
            self._withdraw(Withdrawal(self._settings, self._q_d, self._dq_d, tau_ext), cycle)
        elif state is not SchemeState.STOPPED:
            self._segment = None

    def _start(self, segment: Segment, cycle: int) -> None:
        self._segment = segment
        self._start_cycle = cycle

    def _follow(self, elapsed_s: float) -> None:
        corner_to_corner(elapsed_s, self._amplitude, self._half_period_s, self._q_d, self._dq_d, self._ddq_d)

    def _excite(self, elapsed_s: float) -> None:
        self._excitation.evaluate(elapsed_s, self._q_d, self._dq_d, self._ddq_d)

    def _withdraw(self, withdrawal: Withdrawal, cycle: int) -> None:
        def segment(elapsed_s: float) -> None:
            self._q_d[:], self._dq_d[:], self._ddq_d[:] = withdrawal.at(elapsed_s)

        self._start(segment, cycle)

    def _approach(self, cycle: int) -> int:
        """Start the way to the corner and return the cycle in which it ends."""
        q, dq, ddq = self._q_d.copy(), self._dq_d.copy(), self._ddq_d.copy()
        distance = float(np.max(np.abs(self._corner - q)))
        is_moving = bool(np.any(dq) or np.any(ddq))
        if distance < AT_CORNER_RAD and not is_moving:
            duration_s = self._period_s
        else:
            duration_s = max(PEAK_SPEED_FACTOR * distance / self._approach_rad_s, SHORTEST_APPROACH_S)
        cycles = max(1, round(duration_s / self._period_s))
        duration_s = cycles * self._period_s
        coefficients = to_rest(q, dq, ddq, self._corner, duration_s)

        def segment(elapsed_s: float) -> None:
            if elapsed_s < duration_s:
                evaluate(coefficients, elapsed_s, self._q_d, self._dq_d, self._ddq_d)
            else:
                self._q_d[:] = self._corner
                self._dq_d[:] = 0.0
                self._ddq_d[:] = 0.0

        self._start(segment, cycle)
        return cycle + cycles
