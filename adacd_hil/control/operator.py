"""The user of a running arm: a script, the console, or both. A request is what the scheme is asked in one cycle."""

import contextlib
import io
import sys
import threading
from collections import deque
from enum import Enum
from typing import Protocol, TextIO

from adacd_hil.records import Request, SchemeState
from adacd_hil.settings.run_settings import OperatorSettings

CONSOLE_WORDS = {
    "ack": Request.ACKNOWLEDGE,
    "payload": Request.PAYLOAD,
    "changed": Request.PAYLOAD_CHANGED,
    "accept": Request.ACCEPT,
    "relearn": Request.RELEARN,
    "finish": Request.FINISH,
}


class FaultAnswer(Enum):
    """What the user says to a fault."""

    WAIT = "nothing yet"
    RECOVER = "the cause is gone, begin again"
    END = "end the run, or nobody is there to ask"


class Operator(Protocol):
    """Somebody who may ask something of the arm in each cycle."""

    def request(self, elapsed_s: float | None, state: SchemeState) -> Request:
        """Return this cycle's request. `elapsed_s`: since the drives were enabled, None before."""

    def answer_fault(self, elapsed_s: float) -> FaultAnswer:
        """Say how a faulted run goes on; asked again until the answer is not WAIT. `elapsed_s`: since the fault."""


class ScriptedOperator:
    """Plays the user by the clock: requests at given times, acknowledgement a given time after each stop.

    A faulted arm is asked nothing: what falls due then is asked once it has been enabled again.
    """

    def __init__(self, settings: OperatorSettings) -> None:
        self._script = deque(sorted(settings.script, key=lambda entry: entry.at_s))
        self._acknowledge_after_s = settings.acknowledge_after_s
        self._stopped_since_s: float | None = None
        self._faults_left = settings.acknowledge_faults
        self._acknowledge_fault_after_s = settings.acknowledge_fault_after_s

    def answer_fault(self, elapsed_s: float) -> FaultAnswer:
        """Acknowledge as many faults as the settings say, each after its time."""
        if self._faults_left == 0:
            return FaultAnswer.END
        if elapsed_s < self._acknowledge_fault_after_s:
            return FaultAnswer.WAIT
        self._faults_left -= 1
        return FaultAnswer.RECOVER

    def request(self, elapsed_s: float | None, state: SchemeState) -> Request:
        """Return what the script asks at this time."""
        if elapsed_s is None or state is SchemeState.FAULT:
            return Request.NONE
        if self._script and elapsed_s >= self._script[0].at_s:
            return Request[self._script.popleft().request.upper()]
        return self._acknowledge(elapsed_s, state)

    def _acknowledge(self, elapsed_s: float, state: SchemeState) -> Request:
        if state is not SchemeState.STOPPED:
            self._stopped_since_s = None
            return Request.NONE
        if self._stopped_since_s is None:
            self._stopped_since_s = elapsed_s
        if self._acknowledge_after_s == 0.0 or elapsed_s - self._stopped_since_s < self._acknowledge_after_s:
            return Request.NONE
        self._stopped_since_s = elapsed_s
        return Request.ACKNOWLEDGE


class ConsoleOperator:
    """Takes words from a terminal, a line each, on a thread of its own, and passes on what a script asks."""

    def __init__(self, script: ScriptedOperator, stream: TextIO = sys.stdin) -> None:
        self._script = script
        self._stream = stream
        self._asked: deque[Request] = deque()
        self._thread = threading.Thread(target=self._listen, name="console", daemon=True)
        self._thread.start()

    def join(self, timeout_s: float) -> None:
        """Wait until the stream has ended, at most `timeout_s`."""
        self._thread.join(timeout_s)

    def _listen(self) -> None:
        if isinstance(self._stream, io.TextIOWrapper):
            self._stream.reconfigure(errors="replace")  # a key that is no letter is no word, and not the end
        with contextlib.suppress(OSError):  # the terminal has hung up, or has others in its foreground
            for line in self._stream:
                request = CONSOLE_WORDS.get(line.strip().lower())
                if request is not None:
                    self._asked.append(request)

    def request(self, elapsed_s: float | None, state: SchemeState) -> Request:
        """Return what the user asked first, else what the script asks; of a faulted arm, leave it to `answer_fault`."""
        if self._asked and state is not SchemeState.FAULT:
            return self._asked.popleft()
        return self._script.request(elapsed_s, state)

    def answer_fault(self, elapsed_s: float) -> FaultAnswer:
        """Wait for `ack` or `finish` while somebody may still type; what was asked for otherwise is forgotten."""
        while self._asked:
            request = self._asked.popleft()
            if request is Request.ACKNOWLEDGE:
                return FaultAnswer.RECOVER
            if request is Request.FINISH:
                return FaultAnswer.END
        return FaultAnswer.WAIT if self._thread.is_alive() else self._script.answer_fault(elapsed_s)
