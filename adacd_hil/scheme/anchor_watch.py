"""What the certified scheme says of its anchors: a certificate's, one that is withheld, and the user's word."""

from typing import NamedTuple

import numpy as np

from adacd_hil.records import JOINTS, Event, SchemeState, Vector
from adacd_hil.scheme import anchor
from adacd_hil.scheme.kernel import Structured

THIS_RUN_ONLY = "friction and inertia: by this run only"
"""A hand that drags, or moves like a mass, from before the first motion is learnt as these: no run alone tells them."""


class _Refusal(NamedTuple):
    """Torques (n,) that an anchor excludes, their standard deviations, and the words for it. times: in a row."""

    is_reading: bool
    torque_Nm: Vector
    std_Nm: Vector
    lines: list[str]
    times: int


class AnchorWatch:
    """Says what the kernel has found, and hands it what the user accepts."""

    def __init__(self, constants: Structured, memory: Structured) -> None:
        self._constants, self._memory = constants[0], memory[0]
        self._refusal: _Refusal | None = None

    @property
    def is_refusing(self) -> bool:
        """Whether something has been refused since the last certificate, acceptance or change of state."""
        return self._refusal is not None

    def enter(self, previous: SchemeState, state: SchemeState) -> Event | None:
        """Take in a new state; return what a certificate says."""
        if state is SchemeState.ENABLE:
            self._refusal = None
        if state is not SchemeState.MONITOR or previous is not SchemeState.CERTIFY:
            return None
        self._refusal = None
        level = "info" if anchor.is_anchored(self._constants, self._memory) else "warning"
        return Event(level, "certificate", f"{anchor.describe(self._constants, self._memory)}; {THIS_RUN_ONLY}")

    def refuse(self, is_reading: bool) -> Event | None:
        """Take in, before its traces are gone, that the reading at rest or a fit is refused; return what is said."""
        before = self._refusal
        offsets = slice(int(self._constants["base"]), int(self._constants["base"]) + JOINTS)
        self._refusal = _Refusal(
            is_reading,
            self._memory["judged_Nm"].copy(),
            np.sqrt(np.diag(self._memory["P_belief"])[offsets]),
            anchor.describe_refused(self._memory, is_reading),
            1 if before is None else before.times + 1,
        )
        if before is not None:
            return None
        what = "the drives stay off" if is_reading else "no certificate, learning begins anew"
        return Event("warning", "anchor", "; ".join((*self._refusal.lines, what, self._remedy)))

    @property
    def _remedy(self) -> str:
        is_reading = self._refusal is not None and self._refusal.is_reading
        return "`accept` does without the tare" if is_reading else "`accept` takes it for the sensor's zero"

    def accept(self) -> Event:
        """Believe what was refused last, because the user says so; return what there is to say of that."""
        refusal, self._refusal = self._refusal, None
        if refusal is None:
            return Event("warning", "anchor", "nothing to accept: no anchor is contradicted")
        torque = ", ".join(f"{value:.3f}" for value in refusal.torque_Nm)
        if refusal.is_reading:
            anchor.accept_reading(self._memory)
            return Event("warning", "anchor", f"the user accepts {torque} Nm at rest: the tare is not used")
        anchor.accept(self._memory, refusal.torque_Nm, refusal.std_Nm)
        return Event("warning", "anchor", f"the user accepts {torque} Nm as the zero of the sensors")

    def describe(self) -> list[str]:
        """Say what is refused, a line each; empty while nothing is."""
        if self._refusal is None:
            return []
        withheld = [] if self._refusal.is_reading else [f"certificates withheld: {self._refusal.times}"]
        return [*self._refusal.lines, *withheld, self._remedy]
