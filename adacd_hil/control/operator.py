"""The user of a running arm, by script, and the progress lines of a run for the user.

A request goes to the scheme in one cycle. The progress lines also show the states' names as in the log.
"""

from collections import deque
from collections.abc import Callable
from enum import Enum
from typing import Protocol

from adacd_hil.records import MOTION_START, ContactLevel, ContactReport, Reaction, Request, SchemeOutput, SchemeState
from adacd_hil.settings.run_settings import OperatorSettings


class FaultAnswer(Enum):
    """The user's answer to a fault."""

    WAIT = "nothing yet"
    RECOVER = "the cause is gone, begin again"
    END = "end the run, or no user is there"


class Operator(Protocol):
    """A source of requests to the arm, one per cycle at most."""

    def request(self, elapsed_s: float | None, state: SchemeState) -> Request:
        """Return this cycle's request. `elapsed_s`: since the drives were enabled, None before."""

    def answer_fault(self, elapsed_s: float) -> FaultAnswer:
        """Return how a faulted run continues; called again while the answer is WAIT. `elapsed_s`: since the fault."""


class ScriptedOperator:
    """Plays the user by the clock: requests at given times, acknowledgement a given time after each stop.

    Requests that are due during a fault are made once the arm is enabled again.
    """

    def __init__(self, settings: OperatorSettings) -> None:
        self._script = deque(sorted(settings.script, key=lambda entry: entry.at_s))
        self._acknowledge_after_s = settings.acknowledge_after_s
        self._stopped_since_s: float | None = None
        self._faults_left = settings.acknowledge_faults
        self._acknowledge_fault_after_s = settings.acknowledge_fault_after_s

    def answer_fault(self, elapsed_s: float) -> FaultAnswer:
        """Return WAIT, then RECOVER at the time of the settings, for as many faults as they allow; END for others."""
        if self._faults_left == 0:
            return FaultAnswer.END
        if elapsed_s < self._acknowledge_fault_after_s:
            return FaultAnswer.WAIT
        self._faults_left -= 1
        return FaultAnswer.RECOVER

    def request(self, elapsed_s: float | None, state: SchemeState) -> Request:
        """Return the script's next request if it is due, or ACKNOWLEDGE a given time after a stop, else NONE.

        NONE before the drives are enabled, and in FAULT. A given time of 0 s: never acknowledge.
        """
        if elapsed_s is None or state is SchemeState.FAULT:
            return Request.NONE
        if self._script and elapsed_s >= self._script[0].at_s:
            return Request[self._script.popleft().request.upper()]
        return self._acknowledge(elapsed_s, state)

    def _acknowledge(self, elapsed_s: float, state: SchemeState) -> Request:
        """Return ACKNOWLEDGE each time that the arm has been STOPPED for `acknowledge_after_s`, else NONE.

        0 s: never.
        """
        if state is not SchemeState.STOPPED:
            self._stopped_since_s = None
            return Request.NONE
        if self._stopped_since_s is None:
            self._stopped_since_s = elapsed_s
        if self._acknowledge_after_s == 0.0 or elapsed_s - self._stopped_since_s < self._acknowledge_after_s:
            return Request.NONE
        self._stopped_since_s = elapsed_s
        return Request.ACKNOWLEDGE


_STATES = {
    SchemeState.COMMISSION: "checks the arm at rest",
    SchemeState.ENABLE: "enables the drives",
    SchemeState.ADAPT: "learns the arm's model on the move: keep off",
    SchemeState.CERTIFY: "tests the model on motion it has not seen",
    SchemeState.MONITOR: "watches for touches",
    SchemeState.STOPPED: "stopped, until you acknowledge",
    SchemeState.PAYLOAD: "parks, so that the payload can be changed",
    SchemeState.FAULT: "fault: disables the drives",
}
_REACTIONS = {
    Reaction.NONE: "goes on",
    Reaction.STOP: "stops",
    Reaction.WITHDRAW: "withdraws",
    Reaction.FLOAT: "gives way",
    Reaction.ADMITTANCE: "gives way",
    Reaction.SLOW_DOWN: "slows down",
}
_LATEST_MS = 1000.0
"""A touch that began longer ago than this is not taken for the one that was detected."""


class RunNarration:
    """Prints states and contacts with the time since the drives were enabled, as the report does.

    touched_ns: returns the time since which the arm is touched, on the clock of the cycles, or None if unknown.
    """

    def __init__(self, progress: Callable[[str], None], touched_ns: Callable[[], int | None]) -> None:
        self._progress, self._touched_ns = progress, touched_ns
        self._enabled_ns: int | None = None

    def event(self, t_ns: int, text: str) -> None:
        """Print a text after the time from the enabling of the drives to t_ns, that of the event's cycle.

        Until they are enabled, blanks stand for the time.
        """
        since = "" if self._enabled_ns is None else f"{(t_ns - self._enabled_ns) * 1e-9:.2f} s"
        self._progress(f"{since:>9}  {text}")

    def transition(self, t_ns: int, output: SchemeOutput, logged: str) -> None:
        """Print a change of state in words for the user, with the states' names and the details of its line in the log.

        logged: that line. The first change to MOTION_START begins the time that `event` prints.
        """
        names, _, details = logged.partition(": ")
        if output.state is MOTION_START and self._enabled_ns is None:
            self._enabled_ns = t_ns
        words = self._words(t_ns, output)
        self.event(t_ns, f"{words}  [{names}]{': ' if details else ''}{details}")

    def _words(self, t_ns: int, output: SchemeOutput) -> str:
        """Return the words that tell the user the present state of `output`, just entered.

        In REACT those of the touch, or "stops" without a contact; else those of `_STATES`, or of the change, as from
        CERTIFY to MONITOR.
        """
        contact = output.contact
        if output.state is SchemeState.REACT:
            return self._touch(t_ns, output) if contact is not None else "stops"
        if output.state is SchemeState.ADAPT and output.previous_state is SchemeState.PAYLOAD:
            return "learns the payload on the move: keep off"
        if output.state is SchemeState.MONITOR and output.previous_state is SchemeState.CERTIFY:
            return "model certified: watches for touches"
        return _STATES.get(output.state, output.state.name.lower())

    def _touch(self, t_ns: int, output: SchemeOutput) -> str:
        """Return the text of a detected touch: its level, the delay of the detection if known, the reaction.

        A delay below 0, or of more than _LATEST_MS, is left out: the detected touch is then another one.
        """
        contact = output.contact
        assert contact is not None
        what = "light touch" if contact.level is ContactLevel.CONTACT else "touch"
        touched_ns = self._touched_ns()
        late_ms = None if touched_ns is None else (t_ns - touched_ns) * 1e-6
        found = f", found after {late_ms:.0f} ms" if late_ms is not None and 0.0 <= late_ms <= _LATEST_MS else ""
        return f"{what}{found}: {_REACTIONS[contact.reaction]}"

    def contact(self, t_ns: int, contact: ContactReport) -> None:
        """Print a contact's link and each joint's peak external torque, Nm, if its report is final.

        Earlier reports may have the other link.
        """
        if contact.is_final:
            first, second = contact.tau_ext_peak
            peak = f"{first:+.1f} / {second:+.1f} Nm at the joints"
            self.event(t_ns, f"that was on link {contact.link}, up to {peak}")
