"""What the certified scheme says of its anchors: a certificate's, one that is withheld, and the user's word."""

import numpy as np

from adacd_hil.records import JOINTS, Event, SchemeState, Vector
from adacd_hil.scheme import anchor
from adacd_hil.scheme.kernel import Structured
from adacd_hil.scheme.observation import Observation

_WITHHELD = int(Observation.WITHHELD)
THIS_RUN_ONLY = "friction and inertia: by this run only"
"""A hand that drags, or moves like a mass, from before the first motion is learnt as these: no run alone tells them."""
_REMEDY = "`accept` takes it for the sensor's zero"


class AnchorWatch:
    """Makes events of what the kernel has found, and hands it what the user accepts."""

    def __init__(self, constants: Structured, memory: Structured) -> None:
        self._constants, self._memory = constants[0], memory[0]
        self._offsets = slice(int(self._constants["base"]), int(self._constants["base"]) + JOINTS)
        self._is_reading = False
        self._refused: tuple[Vector, Vector] | None = None
        self._lines: list[str] = []
        self._count = 0
        self._events: list[Event] = []

    def take_events(self) -> list[Event]:
        """Return what there is to say since the last call."""
        events, self._events = self._events, []
        return events

    def step(self, previous: SchemeState, state: SchemeState, observation: int) -> None:
        """Take in what a cycle has come to, before the state's traces are left."""
        if state is SchemeState.MONITOR and previous is SchemeState.CERTIFY:
            self._forget()
            text = f"{anchor.describe(self._constants, self._memory)}; {THIS_RUN_ONLY}"
            self._events.append(Event("info", "certificate", text))
        elif state is SchemeState.ENABLE and previous is SchemeState.COMMISSION:
            self._forget()
        elif observation & _WITHHELD:
            self._withhold(is_reading=previous is SchemeState.COMMISSION)

    def _withhold(self, is_reading: bool) -> None:
        is_known = self._refused is not None and self._is_reading is is_reading
        self._count += 1
        self._is_reading = is_reading
        std_Nm = np.sqrt(np.diag(self._memory["P_belief"])[self._offsets])
        self._refused = (self._memory["judged_Nm"].copy(), std_Nm)
        self._lines = anchor.describe_refused(self._memory, is_reading)
        if not is_known:
            what = "the drives stay off" if is_reading else "no certificate, learning begins anew"
            self._events.append(Event("warning", "anchor", f"{'; '.join(self._lines)}; {what}; {_REMEDY}"))

    def accept(self) -> None:
        """Take the torque that was refused last for the sensors' zero, because the user says so."""
        if self._refused is None:
            self._events.append(Event("warning", "anchor", "nothing to accept: no anchor is contradicted"))
            return
        torque = ", ".join(f"{value:.3f}" for value in self._refused[0])
        if self._is_reading:
            anchor.accept_reading(self._memory)
            text = f"the user accepts the reading at rest, {torque} Nm; the tare is not used"
        else:
            anchor.accept(self._memory, *self._refused)
            text = f"the user accepts {torque} Nm as the zero of the sensors"
        self._forget()
        self._events.append(Event("warning", "anchor", text))

    def describe(self) -> list[str]:
        """Say what is refused, a line each; empty while nothing is."""
        if self._refused is None:
            return []
        return [*self._lines, f"withheld {self._count} times" if not self._is_reading else _REMEDY]

    def _forget(self) -> None:
        self._refused, self._lines, self._count = None, [], 0
