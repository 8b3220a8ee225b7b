"""What the user asked for in a run: from the script of the configuration, where nobody typed anything.

The script goes by the time since the drives were enabled and by the state; whoever plays it, `control.operator` live,
is handed in.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.records import Request, SchemeState
from adacd_hil.scheme.pipeline.batch import SchemeBatch
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.run_settings import OperatorSettings


class Script(Protocol):
    """The user that the configuration plays."""

    def request(self, elapsed_s: float | None, state: SchemeState) -> Request:
        """Return what it asks in a cycle. `elapsed_s`: since the drives were enabled, None before."""


_OWN_CHECKS = (Request.FAULT_TORQUE, Request.FAULT_FOLLOWING, Request.FAULT_TAMPERED)
"""What the host asked for in place of the user; no script has them."""

ScriptOf = Callable[[OperatorSettings], Script]


class Asking:
    """Plays the script along a replay: cycle by cycle, or where it could ask for something."""

    def __init__(self, settings: Settings, script_of: ScriptOf) -> None:
        operator = settings.operator
        self._script = script_of(operator)
        self._times_s = sorted(entry.at_s for entry in operator.script)
        self._acknowledges = operator.acknowledge_after_s > 0.0
        self._period_s = settings.bus.period_s
        self._enabled: int | None = None
        self._was_stopped = False

    def begin(self) -> None:
        """Begin another attempt."""
        self._enabled = None
        self._was_stopped = False

    def ask(self, cycle: int, state: SchemeState) -> Request:
        """Return what is asked in a cycle; state: that of the cycle before."""
        elapsed_s = None if self._enabled is None else (cycle - self._enabled) * self._period_s
        return self._script.request(elapsed_s, state)

    def note(self, cycle: int, state: SchemeState) -> None:
        """Take note of the state that a cycle has led to."""
        if state is SchemeState.ADAPT and self._enabled is None:
            self._enabled = cycle

    def requests(self, ticks: Ticks, batch: SchemeBatch) -> NDArray[np.uint8]:
        """Return what the script asks in a stretch (n,), given what came of it."""
        asked = np.zeros(len(ticks.cycle), np.uint8)
        if self._enabled is None:
            enabled = np.flatnonzero(batch.state == SchemeState.ADAPT)
            if enabled.size == 0:
                return asked
            self._enabled = int(ticks.cycle[enabled[0]])
            first = int(enabled[0]) + 1
        else:
            first = 0
        for row in self._rows(ticks, batch, first):
            asked[row] = self.ask(int(ticks.cycle[row]), SchemeState(batch.previous_state[row]))
        return asked

    def _rows(self, ticks: Ticks, batch: SchemeBatch, first: int) -> list[int]:
        """List the rows from the first one on in which something could be asked, or the wait for it begins anew."""
        assert self._enabled is not None
        is_due = np.zeros(len(ticks.cycle), np.bool_)
        if self._acknowledges:
            is_stopped = batch.previous_state == SchemeState.STOPPED
            is_due |= is_stopped | np.concatenate(([self._was_stopped], is_stopped[:-1]))
            self._was_stopped = bool(is_stopped[-1])
        elapsed_s = (ticks.cycle - self._enabled) * self._period_s
        is_alive = batch.previous_state != SchemeState.FAULT
        for at_s in self._times_s:  # as many cycles as others may be due before it, one each
            is_due[np.flatnonzero((elapsed_s >= at_s) & is_alive)[: len(self._times_s) + 1]] = True
        return [row for row in np.flatnonzero(is_due).tolist() if row >= first]


class RequestCheck:
    """Compares the logged requests with the script's. One request to finish that isn't in it may be an interrupt.

    The script's own may follow it, while the arm parks; where it doesn't, it was the same one at another time.
    """

    def __init__(self) -> None:
        self.interrupts: list[tuple[int, int]] = []  # cycle and time
        self.unexplained: list[tuple[int, int, int, int]] = []  # cycle, time, logged, of the script

    def compare(self, ticks: Ticks, logged: NDArray[np.uint8], asked: NDArray[np.uint8]) -> None:
        """Compare a stretch."""
        for row in np.flatnonzero(logged != asked).tolist():
            cycle, t_ns = int(ticks.cycle[row]), int(ticks.t_ns[row])
            if logged[row] in _OWN_CHECKS:
                continue
            if logged[row] == Request.FINISH and not self.interrupts:
                self.interrupts.append((cycle, t_ns))
            else:
                self.unexplained.append((cycle, t_ns, int(logged[row]), int(asked[row])))
        if self.interrupts and ((asked == Request.FINISH) & (logged != Request.FINISH)).any():
            self.unexplained.append((*self.interrupts.pop(), int(Request.FINISH), int(Request.NONE)))
