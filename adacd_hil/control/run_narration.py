"""Lines in which a run tells a person what the arm does, beside the names of states that the log has."""

from collections.abc import Callable

from adacd_hil.records import ContactLevel, ContactReport, Reaction, SchemeOutput, SchemeState

_STATES = {
    SchemeState.COMMISSION: "checks the arm at rest",
    SchemeState.ENABLE: "enables the drives",
    SchemeState.ADAPT: "learns the arm's model on the move: keep off",
    SchemeState.CERTIFY: "tests the model on motion it has not seen",
    SchemeState.MONITOR: "watches for touches",
    SchemeState.STOPPED: "stands still, until somebody acknowledges",
    SchemeState.PAYLOAD: "parks, so that the payload can be changed",
    SchemeState.FAULT: "fault: the drives are disabled",
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
"""A touch that began longer before than this is not the one that was found."""


class RunNarration:
    """Tells states and touches by the time since the drives were enabled, as the report does.

    touched_ns: since when something touches the arm, on the clock of the cycles, where somebody knows; else None.
    """

    def __init__(self, progress: Callable[[str], None], touched_ns: Callable[[], int | None]) -> None:
        self._progress, self._touched_ns = progress, touched_ns
        self._enabled_ns: int | None = None

    def event(self, t_ns: int, text: str) -> None:
        """Tell what has happened in a cycle."""
        since = "" if self._enabled_ns is None else f"{(t_ns - self._enabled_ns) * 1e-9:.2f} s"
        self._progress(f"{since:>9}  {text}")

    def transition(self, t_ns: int, output: SchemeOutput, logged: str) -> None:
        """Tell a change of the state. logged: the log's line of it, with the names of both and what is against it."""
        names, _, details = logged.partition(": ")
        if output.state is SchemeState.ADAPT and self._enabled_ns is None:
            self._enabled_ns = t_ns
        words = self._words(t_ns, output)
        self.event(t_ns, f"{words}  [{names}]{': ' if details else ''}{details}")

    def _words(self, t_ns: int, output: SchemeOutput) -> str:
        contact = output.contact
        if output.state is SchemeState.REACT:
            return self._touch(t_ns, output) if contact is not None else "stops"
        if output.state is SchemeState.ADAPT and output.previous_state is SchemeState.PAYLOAD:
            return "learns the payload on the move: keep off"
        if output.state is SchemeState.MONITOR and output.previous_state is SchemeState.CERTIFY:
            return "model certified: watches for touches"
        return _STATES.get(output.state, output.state.name.lower())

    def _touch(self, t_ns: int, output: SchemeOutput) -> str:
        contact = output.contact
        assert contact is not None
        what = "light touch" if contact.level is ContactLevel.CONTACT else "touch"
        touched_ns = self._touched_ns()
        late_ms = None if touched_ns is None else (t_ns - touched_ns) * 1e-6
        found = f", found after {late_ms:.0f} ms" if late_ms is not None and 0.0 <= late_ms <= _LATEST_MS else ""
        return f"{what}{found}: {_REACTIONS[contact.reaction]}"

    def contact(self, t_ns: int, contact: ContactReport) -> None:
        """Tell on which link a contact was, once that is final: the first alarm may be of the other joint."""
        if contact.is_final:
            first, second = contact.tau_ext_peak
            peak = f"{first:+.1f} / {second:+.1f} Nm at the joints"
            self.event(t_ns, f"that was on link {contact.link}, up to {peak}")
