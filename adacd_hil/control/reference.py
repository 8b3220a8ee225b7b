"""Where the arm should be: the desired motion in each state of the scheme.

MONITOR follows the trajectory, ADAPT and CERTIFY the excitation where there is one, else the trajectory too, each
approached from wherever the arm is; REACT does what the reaction says; STOPPED keeps to it, or holds; PAYLOAD and the
end of a run park the arm in the trajectory's start corner; elsewhere the desired motion is the measured place. A run
that ends while the arm reacts or is stopped does not move it: it ends there, or is parked when the stop has been
acknowledged.

Shapes: positions, velocities, accelerations (2,). Units: rad, s, Nm.
"""

from collections.abc import Callable

import numpy as np

from adacd_hil.control.motions import PEAK_SPEED_FACTOR, Admittance, Excitation, corner_to_corner, evaluate, to_rest
from adacd_hil.records import JOINTS, ArmState, Reaction, SchemeOutput, SchemeState, Vector
from adacd_hil.scheme.contact.reaction import Withdrawal
from adacd_hil.scheme.supervisor.supervisor import LEARNING, REACTING
from adacd_hil.settings.configuration import Settings

SHORTEST_APPROACH_S = 0.6
"""Shortest way to the corner when it must also be stopped: from 100 °/s this stays below 400 °/s²."""
PARK_SETTLE_S = 0.3
"""How long a parked arm settles before its drives are disabled: three periods of joint 2's swing with 1 kg, 0.1 s."""
AT_CORNER_RAD = 1e-3
"""Nearer than this the trajectory starts at once: a fifth of a degree, ten encoder steps of the noise."""
SLOWING_S = 0.1
"""From full speed along the path to none: 100 °/s then brakes with 1000 °/s²."""
THROWN_S = 0.15
"""How long after a contact a blow may move the arm off its way: 5 times a blow against a chest."""
THROWN_rad_s = 0.2
"""Faster than planned by this, away from what pushes, an arm has been thrown."""

OLD_CYCLES = 1
"""Age of the feedback up to which the desired motion goes on."""
LOST_CYCLES = 5
"""After so many cycles of waiting the arm is no longer where it was: the motion begins anew from where it is found."""

ENDING = 0.6
"""A blow ends when its torque has fallen to this part of its largest."""

_FOLLOWING = (SchemeState.ADAPT, SchemeState.CERTIFY, SchemeState.MONITOR)
_ON_PATH = (Reaction.NONE, Reaction.SLOW_DOWN)

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
        self._follows_thrown = settings.reaction.start == "measured"
        self._has_model = False
        self._thrown_cycles = round(THROWN_S / self._period_s)
        self._slow_share = settings.reaction.slow_share
        self._admittance = Admittance(settings)
        self._q_d, self._dq_d, self._ddq_d = q_d, dq_d, ddq_d
        self._state = SchemeState.INIT
        self._reaction = Reaction.NONE
        self._excitation = Excitation(settings)
        self._segment: Segment | None = None
        self._start_cycle = 0
        self._follows_at_cycle: int | None = None
        self._rate = 1.0
        self._lag_s = 0.0
        self._push = np.zeros(JOINTS)
        self._contact_q = np.zeros(JOINTS)
        self._strongest = 0.0
        self._contact_cycle = 0
        self._is_parking = False
        self._park_end_cycle = 0
        self._waited_cycles = 0

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

    @property
    def is_floating(self) -> bool:
        """Whether there is no desired motion: the arm gives way."""
        return self._state in REACTING and self._reaction is Reaction.FLOAT

    def park(self) -> None:
        """From the next step on, go to the start corner and stay there; stay where it is while the arm is stopped."""
        self._is_parking = True
        if self._state not in REACTING:
            self._segment = None

    def is_parked(self, cycle: int) -> bool:
        """Whether a commanded parking has come to its end."""
        if not self._is_parking or self._state is SchemeState.REACT:
            return False
        return self._state is SchemeState.STOPPED or (self._segment is not None and cycle >= self._park_end_cycle)

    def step(self, arm: ArmState, output: SchemeOutput) -> None:
        """Fill the desired motion of this cycle."""
        cycle = arm.cycle
        if output.state is not output.previous_state:
            self._enter(output, arm)
        elif self._waits(arm):
            return
        if self._state in REACTING and output.reaction is not self._reaction:
            self._react(output, arm)
        if self._is_parking and self._segment is None and self._state not in REACTING:
            self._park_end_cycle = self._approach(cycle) + round(PARK_SETTLE_S / self._period_s)
        if self._state in REACTING and self._is_yielding(arm, output):
            return
        if self._segment is None:
            self._stay(arm)
            return
        self._advance(cycle)

    def _waits(self, arm: ArmState) -> bool:
        """Let the desired motion wait while the feedback is old; go on, or begin anew, once it is fresh."""
        if max(arm.age_q) > OLD_CYCLES:
            self._waited_cycles += arm.periods
            self._start_cycle += arm.periods
            self._park_end_cycle += arm.periods
            if self._follows_at_cycle is not None:
                self._follows_at_cycle += arm.periods
            return True
        if self._waited_cycles > LOST_CYCLES:
            self._begin_anew(arm)
        self._waited_cycles = 0
        return False

    def _begin_anew(self, arm: ArmState) -> None:
        """Plan from the measured motion what the state asks for."""
        self._q_d[:], self._dq_d[:], self._ddq_d[:] = arm.q, arm.dq, 0.0
        if self._is_parking and self._state not in REACTING:
            self._segment = None
        elif self._state in _FOLLOWING:
            self._follows_at_cycle = self._approach(arm.cycle)
        elif self._state is SchemeState.PAYLOAD:
            self._approach(arm.cycle)
        elif self._segment is not None:
            self._brake(arm.cycle)

    def _is_yielding(self, arm: ArmState, output: SchemeOutput) -> bool:
        """Fill the desired motion of a reaction that has no plan, or plan a blow's anew; tell whether it is filled."""
        if self._reaction is Reaction.FLOAT:
            self._stay(arm)
            return True
        is_blow = self._follows_thrown and arm.cycle - self._contact_cycle <= self._thrown_cycles
        if is_blow and self._is_thrown(arm, output.tau_ext_hat):
            self._follow_thrown(arm)
        if self._reaction is Reaction.ADMITTANCE:
            self._admittance.step(output.tau_ext_hat, self._q_d, self._dq_d, self._ddq_d)
            return True
        return False

    def _stay(self, arm: ArmState) -> None:
        self._q_d[:] = arm.q
        self._dq_d[:] = 0.0
        self._ddq_d[:] = 0.0

    def _advance(self, cycle: int) -> None:
        """Fill the desired motion of the segment, along which the arm may move slowly."""
        wanted = self._slow_share if self._reaction is Reaction.SLOW_DOWN and self._state in REACTING else 1.0
        change = min(max(wanted - self._rate, -self._period_s / SLOWING_S), self._period_s / SLOWING_S)
        self._rate += change
        self._lag_s += (1.0 - self._rate) * self._period_s
        has_come = self._follows_at_cycle is not None and cycle - self._lag_s / self._period_s >= self._follows_at_cycle
        if has_come and not self._is_parking:
            assert self._follows_at_cycle is not None
            is_learning = self._excitation.is_on and self._state in LEARNING
            self._segment = self._excite if is_learning else self._follow
            self._start_cycle = self._follows_at_cycle
            self._follows_at_cycle = None
        assert self._segment is not None
        self._segment((cycle - self._start_cycle) * self._period_s - self._lag_s)
        if self._rate != 1.0 or change != 0.0:
            self._ddq_d[:] = self._rate**2 * self._ddq_d + change / self._period_s * self._dq_d
            self._dq_d[:] *= self._rate

    def _enter(self, output: SchemeOutput, arm: ArmState) -> None:
        """Choose the motion of a state that begins in this cycle."""
        state, previous, cycle = output.state, self._state, arm.cycle
        self._state = state
        if state is SchemeState.REACT:
            self._has_model = previous is SchemeState.MONITOR
        was_on_path = previous in _FOLLOWING or (previous is SchemeState.REACT and self._reaction in _ON_PATH)
        has_excited = self._excitation.is_on and previous in LEARNING and state is SchemeState.MONITOR
        is_moving_on = state in _FOLLOWING and was_on_path and not has_excited
        if state is SchemeState.REACT:
            self._react(output, arm)
            return
        if is_moving_on:
            return
        if state is SchemeState.STOPPED:
            if self._reaction in _ON_PATH:
                self._brake(cycle)
            return
        self._follows_at_cycle = None
        if self._is_parking:
            self._segment = None if previous in REACTING else self._segment
        elif state in _FOLLOWING:
            self._follows_at_cycle = self._approach(cycle)
        elif state is SchemeState.PAYLOAD:
            self._approach(cycle)
        else:
            self._segment = None

    def _react(self, output: SchemeOutput, arm: ArmState) -> None:
        """Begin what the reaction says."""
        self._reaction = output.reaction
        self._contact_cycle = arm.cycle
        if self._reaction in _ON_PATH:
            return
        self._follows_at_cycle = None
        self._push[:] = output.tau_ext_hat
        self._contact_q[:] = self._q_d
        self._strongest = 0.0
        if self._reaction is Reaction.STOP:
            self._brake(arm.cycle)
        elif self._reaction is Reaction.WITHDRAW:
            self._withdraw(Withdrawal(self._settings, self._q_d, self._dq_d, self._push), arm.cycle)

    def _brake(self, cycle: int) -> None:
        self._withdraw(Withdrawal(self._settings, self._q_d, self._dq_d, np.zeros(JOINTS)), cycle)

    def _is_thrown(self, arm: ArmState, tau_ext_hat: Vector) -> bool:
        """Tell whether a blow that ends has made the arm faster than planned, away from what it has hit.

        While it is still pushed the controller resists; also while it learns, because an adaptation that begins anew
        forgets the push that goes on.
        """
        if not self._has_model:
            return False
        along = float(tau_ext_hat @ self._push)
        self._strongest = max(self._strongest, along)
        if along > ENDING * self._strongest:
            return False
        largest = float(np.max(np.abs(self._push)))
        ahead = np.sign(self._push) * (arm.dq - self._dq_d) * (np.abs(self._push) >= 0.2 * largest)
        return float(np.max(ahead)) >= THROWN_rad_s

    def _follow_thrown(self, arm: ArmState) -> None:
        """Go on from the measured motion; else the controller would pull the arm back to what it has hit."""
        if self._reaction is Reaction.ADMITTANCE:
            self._q_d[:], self._dq_d[:] = arm.q, arm.dq
        elif self._reaction is Reaction.WITHDRAW:
            withdrawal = Withdrawal(self._settings, arm.q, arm.dq, self._push, self._contact_q)
            self._withdraw(withdrawal, arm.cycle)
        elif self._reaction is Reaction.STOP:
            self._withdraw(Withdrawal(self._settings, arm.q, arm.dq, np.zeros(JOINTS)), arm.cycle)

    def _start(self, segment: Segment, cycle: int) -> None:
        self._segment = segment
        self._start_cycle = cycle
        self._rate, self._lag_s = 1.0, 0.0

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
