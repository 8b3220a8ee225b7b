"""The desired motion in each state of the scheme.

MONITOR follows the trajectory, ADAPT and CERTIFY the excitation if there is one, else the trajectory. REACT carries out
the reaction. STOPPED continues it, or holds the position. PAYLOAD and the end of a run park the arm in the trajectory's
start corner. In other states the desired position is the measured one. If a run ends while the arm reacts or is
stopped, the arm doesn't go to the corner: the run ends there, or the arm is parked once the stop is acknowledged.

**Limits.** The desired motion stays within the arm's position and velocity limits and the reaction's acceleration limit
by construction. Trajectory and excitation are checked before the run. On the way to the corner the arm first comes to
rest on its present path (`Pace`), then goes straight (`QuinticMove`). Without a path, as after a reaction, it brakes
with the acceleration limit. If it is too fast to stop before a position limit, it brakes with the same limit, and an
event reports it.

Shapes: positions, velocities, accelerations (2,). Units: rad, s, Nm.
"""

import math
from collections.abc import Callable

import numpy as np

from adacd_hil.control.motions import Admittance, Excitation, Pace, QuinticMove, corner_to_corner, motion_problems
from adacd_hil.device.arm_watch import EventSource
from adacd_hil.records import JOINTS, LEARNING, REACTING, ArmState, Event, Reaction, SchemeOutput, SchemeState, Vector
from adacd_hil.scheme.contact.reaction import Withdrawal
from adacd_hil.scheme.supervisor.supervisor import POWERED
from adacd_hil.settings.arm_settings import OLD_CYCLES
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.schema import ConfigError

SHORTEST_APPROACH_S = 0.6
"""Shortest duration of the way to the corner."""
PARK_SETTLE_S = 0.3
"""How long a parked arm settles before its drives are disabled: three periods of joint 2's swing with 1 kg, 0.1 s."""
AT_CORNER_RAD = 1e-3
"""Distance below which the arm counts as in the corner: ten times the encoder noise."""
THROWN_S = 0.15
"""Time after a contact in which a blow may push the arm off its path: 5 times a blow against a chest."""
THROWN_rad_s = 0.2
"""Excess over the planned speed, away from the contact, from which the arm counts as thrown."""

LOST_CYCLES = 5
"""After so many cycles of waiting the arm may have moved: the motion restarts from the measured position."""

ENDING = 0.6
"""A blow ends when its torque has fallen to this share of its peak."""

MOTION = "motion"
"""Name of the events that report limits which the desired motion can't keep."""

_FOLLOWING = (*LEARNING, SchemeState.MONITOR)
_ON_PATH = (Reaction.NONE, Reaction.SLOW_DOWN)

Path = Callable[[float, Vector, Vector, Vector], None]
"""Fills q, dq, ddq (2,) of a planned motion at a time since its start, s."""


class Reference(EventSource):
    """The desired motion: fills `q_d`, `dq_d`, `ddq_d` (2,), views of the control block, in each cycle.

    `events`: joints that can't stop within their position limits.
    """

    def __init__(self, settings: Settings, q_d: Vector, dq_d: Vector, ddq_d: Vector) -> None:
        """Prepare the motions, to be written to q_d, dq_d, ddq_d (2,).

        Raises ConfigError if trajectory or excitation leave the arm's limits.
        """
        super().__init__()
        if problems := motion_problems(settings):
            raise ConfigError("; ".join(problems))
        self._settings = settings
        self._period_s = settings.bus.period_s
        self._amplitude = np.radians(settings.trajectory.amplitude_deg)
        self._half_period_s = np.array(settings.trajectory.half_period_s)
        approach = np.full(JOINTS, np.radians(settings.trajectory.approach_deg_s))
        self._approach_rad_s = np.minimum(approach, settings.arm.velocity_limit_rad_s)
        self._approach_rad_s2 = np.radians(settings.reaction.acceleration_limit_deg_s2)
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
        self._path: Path | None = None
        self._pace = Pace(settings)
        self._start_cycle = 0
        self._is_stopping = False
        """Whether the arm is coming to rest before it goes to the corner."""
        self._arrival_cycle: int | None = None
        """Cycle in which the present way to the corner ends; None without one."""
        self._push = np.zeros(JOINTS)
        self._contact_q = np.zeros(JOINTS)
        self._strongest = 0.0
        self._contact_cycle = 0
        self._is_exciting = self._is_parking = False
        self._waited_cycles = 0
        self._beyond: set[int] = set()
        """Joints that brake beyond their position limit in this state; reported once."""

    def compile_motion(self) -> None:
        """Evaluate the trajectory once, so that it doesn't compile later, and a withdrawal.

        No other motion is compiled; the first withdrawal of a process takes 150 µs, later ones 25.
        """
        zeros, scratch = np.zeros(JOINTS), np.zeros((3, JOINTS))
        self._follow(0.0, *scratch)
        Withdrawal(self._settings, zeros, zeros, np.ones(JOINTS)).evaluate(0.0, *scratch)

    @property
    def is_floating(self) -> bool:
        """Return whether the arm yields to a push, by FLOAT: its desired motion is then the measured position."""
        return self._state in REACTING and self._reaction is Reaction.FLOAT

    def park(self) -> None:
        """Begin the way to the start corner, where the arm stays.

        While it reacts or is stopped, don't interfere; the way begins when it goes on afterwards.
        """
        self._is_parking = True
        if self._state not in REACTING:
            self._approach()

    def is_parked(self, cycle: int) -> bool:
        """Return whether the arm has settled in the corner after `park`, or is STOPPED, anywhere, after it."""
        if not self._is_parking or self._state is SchemeState.REACT:
            return False
        if self._state is SchemeState.STOPPED:
            return True
        settle_cycles = round(PARK_SETTLE_S / self._period_s)
        return self._arrival_cycle is not None and cycle >= self._arrival_cycle + settle_cycles

    def step(self, arm: ArmState, output: SchemeOutput) -> None:
        """Fill `q_d`, `dq_d`, `ddq_d` for this cycle; leave them as they are while positions are older than OLD_CYCLES.

        A new state begins its motion in any case. Call it once per cycle.
        """
        if output.state is not output.previous_state:
            self._enter(output, arm)
        elif self._waits(arm):
            return
        if self._state in REACTING and output.reaction is not self._reaction:
            self._react(output, arm)
        if self._state in REACTING and self._is_yielding(arm, output):
            return
        if self._is_stopping:
            self._stop(arm.cycle)
        if self._path is None:
            self._stay(arm)
            return
        self._advance(arm.cycle)

    def _waits(self, arm: ArmState) -> bool:
        """Return whether the desired motion pauses in this cycle, because the feedback is older than OLD_CYCLES.

        Delay its path by the pause. After more than LOST_CYCLES of pause restart it from the measured motion.
        """
        if max(arm.age_q) > OLD_CYCLES:
            self._waited_cycles += arm.periods
            self._start_cycle += arm.periods
            if self._arrival_cycle is not None:
                self._arrival_cycle += arm.periods
            return True
        if self._waited_cycles > LOST_CYCLES:
            self._begin_anew(arm)
        self._waited_cycles = 0
        return False

    def _begin_anew(self, arm: ArmState) -> None:
        """Set the desired motion to the measured one; with a path, brake from there, then go to the corner.

        While the arm reacts or is stopped, only brake.
        """
        self._q_d[:], self._dq_d[:], self._ddq_d[:] = arm.q, arm.dq, 0.0
        if self._path is None:
            return
        self._brake(arm.cycle)
        if self._state not in REACTING:
            self._approach()

    def _is_yielding(self, arm: ArmState, output: SchemeOutput) -> bool:
        """Fill the desired motion of FLOAT or ADMITTANCE and return True; return False for reactions along a path.

        If a blow has just thrown the arm, and `reaction.start` is `measured`, restart the reaction from the measured
        motion; not in FLOAT, NONE and SLOW_DOWN.
        """
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
        """Set the desired motion to rest at the measured position."""
        self._q_d[:] = arm.q
        self._dq_d[:] = 0.0
        self._ddq_d[:] = 0.0

    def _advance(self, cycle: int) -> None:
        """Fill the desired motion of the path, at the present pace, after a change to the next path if one is due.

        Advance the pace by a period.
        """
        self._follow_on(cycle)
        path, pace, motion = self._path, self._pace, (self._q_d, self._dq_d, self._ddq_d)
        assert path is not None
        planned_s = (cycle - self._start_cycle) * self._period_s
        path(planned_s - pace.lag_s - (1.0 - pace.share) * self._period_s, *motion)
        pace.step(self._wanted_share, self._dq_d, self._ddq_d)
        if pace.is_planned:
            return
        path(planned_s - pace.lag_s, *motion)
        self._ddq_d[:] = pace.share**2 * self._ddq_d + pace.change * self._dq_d
        self._dq_d[:] *= pace.share

    @property
    def _wanted_share(self) -> float:
        """Return the wanted share of the planned speed: 0 while stopping, `slow_share` for SLOW_DOWN, else 1."""
        if self._is_stopping:
            return 0.0
        return self._slow_share if self._reaction is Reaction.SLOW_DOWN and self._state in REACTING else 1.0

    def _follow_on(self, cycle: int) -> None:
        """Begin excitation or trajectory when the way to the corner is over, but not while parking or in PAYLOAD."""
        late = self._pace.lag_s / self._period_s
        has_come = self._arrival_cycle is not None and cycle - late >= self._arrival_cycle
        if not has_come or self._is_parking or self._state is SchemeState.PAYLOAD:
            return
        assert self._arrival_cycle is not None
        self._path = self._excitation.evaluate if self._is_exciting else self._follow
        self._start_cycle, self._arrival_cycle = self._arrival_cycle, None

    def _enter(self, output: SchemeOutput, arm: ArmState) -> None:
        """Begin the motion of a new state.

        REACT: the reaction. STOPPED: brake, if the reaction kept the path. ADAPT, CERTIFY, MONITOR: go on with the
        path, or go to the corner if the arm was on none or changes from excitation to trajectory. PAYLOAD: go to the
        corner. Other states: no path. While parking, go on in all states with power but REACT and STOPPED, unless from
        one of these.
        """
        state, previous = output.state, self._state
        self._state = state
        self._beyond.clear()
        if state is SchemeState.REACT:
            self._has_model = previous is SchemeState.MONITOR
            self._react(output, arm)
            return
        if state is SchemeState.STOPPED:
            if self._reaction in _ON_PATH:
                self._brake(arm.cycle)
            return
        was_on_path = previous in _FOLLOWING or (previous is SchemeState.REACT and self._reaction in _ON_PATH)
        has_excited = self._is_exciting and state not in LEARNING
        goes_on = state in _FOLLOWING and was_on_path and not has_excited
        if self._is_parking:
            goes_on = state in POWERED and previous not in REACTING
        if goes_on:
            return
        if state in _FOLLOWING or state is SchemeState.PAYLOAD:
            self._is_exciting = self._excitation.is_on and state in LEARNING
            self._approach()
        else:
            self._path, self._arrival_cycle, self._is_stopping = None, None, False

    def _react(self, output: SchemeOutput, arm: ArmState) -> None:
        """Begin the reaction to a contact: STOP brakes, WITHDRAW takes a new path, FLOAT and ADMITTANCE have none.

        NONE and SLOW_DOWN keep the path. Store the cycle; for the others also the external torque, for `_is_thrown`,
        and the desired position, for `_follow_thrown`. These others, but not FLOAT, report the joints that can't stop
        within their position limit.
        """
        self._reaction = output.reaction
        self._contact_cycle = arm.cycle
        if self._reaction in _ON_PATH:
            return
        self._push[:] = output.tau_ext_hat
        self._contact_q[:] = self._q_d
        self._strongest = 0.0
        if self._reaction is Reaction.STOP:
            self._brake(arm.cycle)
        elif self._reaction is Reaction.WITHDRAW:
            self._withdraw(Withdrawal(self._settings, self._q_d, self._dq_d, self._push), arm.cycle)
        else:
            self._path, self._arrival_cycle, self._is_stopping = None, None, False
        if self._reaction is Reaction.ADMITTANCE:
            self._warn_beyond(self._stop_from(self._q_d, self._dq_d))

    def _is_thrown(self, arm: ArmState, tau_ext_hat: Vector) -> bool:
        """Return whether an ending blow has made a joint faster than planned by THROWN_rad_s, away from the contact.

        Ending: the external torque has fallen below a share of ENDING of its peak; until then the controller resists.
        False while the arm learns, because an adaptation that restarts forgets a push that continues.
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
        """Restart the reaction from the measured motion; do nothing in FLOAT, NONE and SLOW_DOWN.

        Otherwise the controller would pull the arm back to the contact.
        """
        if self._reaction is Reaction.ADMITTANCE:
            self._q_d[:], self._dq_d[:] = arm.q, arm.dq
            self._warn_beyond(self._stop_from(arm.q, arm.dq))
        elif self._reaction is Reaction.WITHDRAW:
            withdrawal = Withdrawal(self._settings, arm.q, arm.dq, self._push, self._contact_q)
            self._withdraw(withdrawal, arm.cycle)
        elif self._reaction is Reaction.STOP:
            self._withdraw(self._stop_from(arm.q, arm.dq), arm.cycle)

    def _withdraw(self, withdrawal: Withdrawal, cycle: int) -> None:
        """Make a withdrawal, or a stop, the path from this cycle on; report joints that exceed their limit."""
        self._warn_beyond(withdrawal)
        self._start(withdrawal.evaluate, cycle)
        self._arrival_cycle, self._is_stopping = None, False

    def _warn_beyond(self, withdrawal: Withdrawal) -> None:
        """Add an event for each joint that can't stop within its position limit, once per state."""
        for joint in withdrawal.beyond_limits:
            if joint not in self._beyond:
                self.events.append(Event("warning", MOTION, withdrawal.describe_beyond(joint)))
        self._beyond.update(withdrawal.beyond_limits)

    def _stop_from(self, q: Vector, dq: Vector) -> Withdrawal:
        """Return the soonest stop from q, dq (2,): a withdrawal without a push."""
        return Withdrawal(self._settings, q, dq, np.zeros(JOINTS))

    def _brake(self, cycle: int) -> None:
        """Make the soonest stop from the present desired motion the path; report joints that exceed their limit."""
        self._withdraw(self._stop_from(self._q_d, self._dq_d), cycle)

    def _approach(self) -> None:
        """Begin to stop the arm on its path; `_stop` then starts the way to the corner."""
        self._arrival_cycle, self._is_stopping = None, True

    def _stop(self, cycle: int) -> None:
        """Start the way to the corner if the desired motion is at rest; brake if it moves without a path.

        Do nothing while it moves on a path: `_pace` brakes it.
        """
        if self._pace.share == 0.0 or not (np.any(self._dq_d) or np.any(self._ddq_d)):
            self._go(cycle)
        elif self._path is None:
            self._brake(cycle)
            self._is_stopping = True

    def _go(self, cycle: int) -> None:
        """Start the way from rest at the desired position to the corner; store the cycle of arrival.

        It takes SHORTEST_APPROACH_S or longer; a period or longer if the arm is in the corner already.
        """
        shortest_s = SHORTEST_APPROACH_S
        if float(np.max(np.abs(self._corner - self._q_d))) < AT_CORNER_RAD:
            shortest_s = self._period_s
        way = QuinticMove(self._q_d, self._corner, self._approach_rad_s, self._approach_rad_s2, shortest_s)
        self._start(way.evaluate, cycle)
        self._arrival_cycle = cycle + max(1, math.ceil(way.duration_s / self._period_s))
        self._is_stopping = False

    def _start(self, path: Path, cycle: int) -> None:
        """Begin a path in this cycle, at full pace."""
        self._path, self._start_cycle = path, cycle
        self._pace.begin_path()

    def _follow(self, elapsed_s: float, q: Vector, dq: Vector, ddq: Vector) -> None:
        """Fill q, dq, ddq (2,) of the trajectory, as a `Path`."""
        corner_to_corner(elapsed_s, self._amplitude, self._half_period_s, q, dq, ddq)
