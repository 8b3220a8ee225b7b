"""The user of a run at the terminal: words, a line each."""

import contextlib
import io
import sys
import threading
from collections import deque
from collections.abc import Callable
from typing import TextIO

from adacd_hil.control.operator import FaultAnswer, ScriptedOperator
from adacd_hil.records import REACTING, Request, SchemeState
from adacd_hil.remedies import nearest_name
from adacd_hil.scheme.supervisor.supervisor import KEPT_IN

CONSOLE_WORDS = {
    "ack": Request.ACKNOWLEDGE,
    "payload": Request.PAYLOAD,
    "changed": Request.PAYLOAD_CHANGED,
    "accept": Request.ACCEPT,
    "relearn": Request.RELEARN,
    "finish": Request.FINISH,
}
_AWAITED = {
    SchemeState.STOPPED: "waiting: type `ack` to go on",
    SchemeState.PAYLOAD: "waiting: type `changed` once the payload has been changed",
}
_MOST_LETTERS = 40
"""Letters of an unknown word that are repeated."""


class ConsoleOperator:
    """The user of a run at a terminal: the requests of typed words, else those of a script.

    A thread of its own reads the words, a line each. tell: prints a line for the user: which word a state waits for,
    that a word is unknown, or that a state drops its request.
    """

    def __init__(
        self, script: ScriptedOperator, stream: TextIO = sys.stdin, tell: Callable[[str], None] = lambda _: None
    ) -> None:
        self._script = script
        self._stream = stream
        self._tell = tell
        self._state = SchemeState.INIT
        self._asked: deque[Request] = deque()
        self._thread = threading.Thread(target=self._listen, name="console", daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        """Queue the request of each known word until the terminal's stream ends; print that a word is unknown."""
        if isinstance(self._stream, io.TextIOWrapper):
            self._stream.reconfigure(errors="replace")  # an invalid character must not end the thread
        with contextlib.suppress(OSError):  # the terminal has hung up, or this process is in its background
            for line in self._stream:
                word = line.strip().lower()
                if word in CONSOLE_WORDS:
                    self._asked.append(CONSOLE_WORDS[word])
                elif word:
                    self._tell(_unknown(word))

    def request(self, elapsed_s: float | None, state: SchemeState) -> Request:
        """Return the next request that the user typed, else the script's, or NONE.

        Print which word a new state waits for, or that the state drops the request. In FAULT, typed requests stay for
        `answer_fault`. state: that of the cycle before. elapsed_s: since the drives were enabled, None before.
        """
        if state is not self._state:
            self._enter(state)
        if self._asked and state is not SchemeState.FAULT:
            request = self._asked.popleft()
            self._tell_if_dropped(request)
            return request
        return self._script.request(elapsed_s, state)

    def answer_fault(self, elapsed_s: float) -> FaultAnswer:
        """Return RECOVER if the user has typed `ack` since the fault, END for `finish`, the first of both; else WAIT.

        A `finish` that was typed before the fault counts, too. Drop other requests. After the terminal's end, if
        neither was typed, return the script's answer. elapsed_s: since the fault.
        """
        if self._state is not SchemeState.FAULT:  # the bus or the boot failed, without a cycle in FAULT
            self._enter(SchemeState.FAULT)
        while self._asked:
            request = self._asked.popleft()
            if request is Request.ACKNOWLEDGE:
                self._state = SchemeState.INIT
                return FaultAnswer.RECOVER
            if request is Request.FINISH:
                return FaultAnswer.END
            self._tell_if_dropped(request)
        return FaultAnswer.WAIT if self._thread.is_alive() else self._script.answer_fault(elapsed_s)

    def _enter(self, state: SchemeState) -> None:
        """Store a new state, and print which word it waits for.

        Only STOPPED and PAYLOAD wait for one, and it isn't printed if a request is queued already. In FAULT drop all
        requests typed before except FINISH: they can't acknowledge it.
        """
        self._state = state
        if state is SchemeState.FAULT:
            for request in [self._asked.popleft() for _ in range(len(self._asked))]:
                if request is Request.FINISH:
                    self._asked.append(request)
        elif state in _AWAITED and not self._asked:
            self._tell(_AWAITED[state])

    def _tell_if_dropped(self, request: Request) -> None:
        """Print that the present state drops a request; not if only the scheme knows: `changed` in a reaction."""
        is_open = request is Request.PAYLOAD_CHANGED and self._state in REACTING
        if request not in KEPT_IN or self._state in KEPT_IN[request] or is_open:
            return
        word = next(word for word, meant in CONSOLE_WORDS.items() if meant is request)
        works_in = ", ".join(state.name for state in sorted(KEPT_IN[request]))
        self._tell(f"`{word}` is dropped in {self._state.name}; it works in {works_in}")


def _unknown(word: str) -> str:
    """Return an error line for a word that is not in `CONSOLE_WORDS`, with the nearest and all known words."""
    nearest = nearest_name(word, CONSOLE_WORDS)
    meant = f"; did you mean `{nearest}`?" if nearest else ""
    return f"unknown word {word[:_MOST_LETTERS]!r}{meant} (known: {', '.join(CONSOLE_WORDS)})"
