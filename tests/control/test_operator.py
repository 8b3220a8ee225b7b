"""The user of a running arm."""

import io
import os
import time

import pytest
from hang import HANG_S

from adacd_hil.cli.console_operator import CONSOLE_WORDS, ConsoleOperator
from adacd_hil.control.operator import FaultAnswer, ScriptedOperator
from adacd_hil.records import Request, SchemeState
from adacd_hil.settings.run_settings import OperatorSettings, RequestSettings


def script(*entries: tuple[float, str], acknowledge_after_s: float = 0.0) -> ScriptedOperator:
    requests = tuple(RequestSettings(at_s=at_s, request=request) for at_s, request in entries)
    return ScriptedOperator(OperatorSettings(script=requests, acknowledge_after_s=acknowledge_after_s))


def test_a_script_asks_once_at_its_time_in_the_order_of_time_from_when_the_drives_are_enabled() -> None:
    operator = script((2.0, "payload_changed"), (0.0, "payload"))
    asked = [operator.request(t, SchemeState.MONITOR) for t in (None, 0.0, 1.999, 2.0, 2.001)]
    assert asked == [Request.NONE, Request.PAYLOAD, Request.NONE, Request.PAYLOAD_CHANGED, Request.NONE]


def test_what_falls_due_while_the_arm_is_faulted_is_asked_afterwards() -> None:
    operator = script((2.0, "finish"))
    asked = [
        operator.request(2.1, SchemeState.FAULT),
        operator.request(0.5, SchemeState.ADAPT),
        operator.request(2.0, SchemeState.ADAPT),
    ]
    assert asked == [Request.NONE, Request.NONE, Request.FINISH]


def test_each_stop_is_acknowledged_after_its_time() -> None:
    operator = script(acknowledge_after_s=0.5)
    for begins_s in (1.0, 3.0):
        asked = [operator.request(begins_s + t, SchemeState.STOPPED) for t in (0.0, 0.4, 0.5)]
        assert asked == [Request.NONE, Request.NONE, Request.ACKNOWLEDGE]
        operator.request(begins_s + 0.6, SchemeState.MONITOR)


def test_without_a_time_no_stop_is_acknowledged() -> None:
    operator = script()
    assert {operator.request(float(t), SchemeState.STOPPED) for t in range(100)} == {Request.NONE}


def wait_for_end(operator: ConsoleOperator) -> None:
    """Wait until the terminal's stream has ended and all its words are queued."""
    operator._thread.join(HANG_S)
    assert not operator._thread.is_alive()


@pytest.mark.parametrize(
    ("word", "request_"),
    [
        ("ack", Request.ACKNOWLEDGE),
        (" Payload ", Request.PAYLOAD),
        ("changed", Request.PAYLOAD_CHANGED),
        ("finish", Request.FINISH),
        ("jump", Request.NONE),
    ],
)
def test_the_console_takes_a_word_a_line(word: str, request_: Request) -> None:
    operator = ConsoleOperator(script(), io.StringIO(f"{word}\n"))
    wait_for_end(operator)
    assert operator.request(1.0, SchemeState.STOPPED) is request_


def told(typed_words: str, *states: SchemeState) -> list[str]:
    lines: list[str] = []
    operator = ConsoleOperator(script(), io.StringIO(typed_words), lines.append)
    wait_for_end(operator)
    for state in states:
        operator.request(1.0, state)
    return lines


def test_an_unknown_word_is_answered_with_the_nearest_one_and_all_that_there_are() -> None:
    (line,) = told("akc\n")
    assert ("'akc'" in line, "did you mean `ack`" in line) == (True, True)
    assert all(word in line for word in CONSOLE_WORDS)
    (line,) = told("x" * 10_000 + "\n  \n")  # it is cut, and an empty line is not answered
    assert len(line) < 150


def test_a_stop_and_a_payload_change_say_once_which_word_they_wait_for() -> None:
    lines = told("", SchemeState.MONITOR, *[SchemeState.STOPPED] * 3, SchemeState.MONITOR, SchemeState.STOPPED)
    assert [("`ack`" in line) for line in lines] == [True, True]
    (line,) = told("", SchemeState.PAYLOAD)
    assert "`changed`" in line


def test_a_stop_that_is_already_acknowledged_waits_for_nothing() -> None:
    assert told("ack\n", SchemeState.STOPPED) == []


@pytest.mark.parametrize(
    ("typed_words", "state", "dropped"),
    [
        ("changed\nack\n", SchemeState.MONITOR, ["`changed`", "`ack`"]),
        ("payload\nrelearn\n", SchemeState.PAYLOAD, ["`payload`", "`relearn`"]),
        ("payload\nfinish\naccept\n", SchemeState.ADAPT, []),
        ("ack\nchanged\n", SchemeState.STOPPED, []),  # in doubt, `changed` works in STOPPED
    ],
)
def test_a_word_that_the_state_drops_is_answered(typed_words: str, state: SchemeState, dropped: list[str]) -> None:
    lines = [line for line in told(typed_words, *[state] * 3) if "waiting" not in line]
    assert [line.split()[0] for line in lines] == dropped
    assert all(state.name in line for line in lines)


def test_a_script_acknowledges_so_many_faults_each_after_its_time() -> None:
    operator = ScriptedOperator(OperatorSettings(acknowledge_faults=2, acknowledge_fault_after_s=0.5))
    for _ in range(2):
        answers = [operator.answer_fault(t) for t in (0.0, 0.49, 0.5)]
        assert answers == [FaultAnswer.WAIT, FaultAnswer.WAIT, FaultAnswer.RECOVER]
    assert operator.answer_fault(1.0) is FaultAnswer.END
    assert script().answer_fault(1000.0) is FaultAnswer.END  # by default nobody does


def answers(before: bytes, after: bytes, *states: SchemeState) -> list[FaultAnswer]:
    """Return the answers to a fault and to a failed boot behind it: typed before it, and once it has been told."""
    read_end, write_end = os.pipe()
    with os.fdopen(read_end) as stream, os.fdopen(write_end, "wb", buffering=0) as keys:
        operator = ConsoleOperator(script(), stream)
        keys.write(before)
        wait_for_words(operator, before)
        assert [operator.request(1.0, state) for state in states] == [Request.NONE] * len(states)
        first = operator.answer_fault(1000.0)  # however long it takes
        keys.write(after)
        keys.close()
        wait_for_end(operator)
        return [first, operator.answer_fault(0.5), operator.answer_fault(0.0)]


def wait_for_words(operator: ConsoleOperator, words: bytes) -> None:
    deadline_s = time.monotonic() + HANG_S
    while len(operator._asked) < words.count(b"\n"):
        assert time.monotonic() < deadline_s


@pytest.mark.parametrize("states", [(), (SchemeState.FAULT,)], ids=["bus fails", "fault"])
@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (b"", b"ack\n", [FaultAnswer.WAIT, FaultAnswer.RECOVER, FaultAnswer.END]),
        (b"", b"payload\nack\n", [FaultAnswer.WAIT, FaultAnswer.RECOVER, FaultAnswer.END]),
        (b"finish\n", b"", [FaultAnswer.END, FaultAnswer.END, FaultAnswer.END]),
        (b"", b"payload\n", [FaultAnswer.WAIT, FaultAnswer.END, FaultAnswer.END]),  # the stream has ended: nobody
        (b"ack\nack\n", b"", [FaultAnswer.WAIT, FaultAnswer.END, FaultAnswer.END]),  # meant something else
        (b"", b"ack\nack\n", [FaultAnswer.WAIT, FaultAnswer.RECOVER, FaultAnswer.END]),  # one for each fault
    ],
)
def test_a_fault_is_answered_by_what_is_typed_after_it(
    before: bytes, after: bytes, expected: list[FaultAnswer], states: tuple[SchemeState, ...]
) -> None:
    assert answers(before, after, *states) == expected


def typed(data: bytes) -> ConsoleOperator:
    operator = ConsoleOperator(script(), io.TextIOWrapper(io.BytesIO(data), encoding="utf-8"))
    wait_for_end(operator)
    return operator


def test_a_key_that_is_no_letter_does_not_end_the_console() -> None:
    assert typed(b"\xff\xfe\nfinish\n").answer_fault(0.0) is FaultAnswer.END
    assert typed(b"\xff\xfe\nack\n").request(1.0, SchemeState.STOPPED) is Request.ACKNOWLEDGE


def test_a_terminal_that_hangs_up_ends_the_console_in_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    failures: list[object] = []
    monkeypatch.setattr("threading.excepthook", failures.append)
    ours, theirs = os.openpty()
    with os.fdopen(ours, encoding="utf-8") as stream:
        operator = ConsoleOperator(script(), stream)
        os.close(theirs)  # reading its other end raises EIO, as a terminal does to who is in the background
        wait_for_end(operator)
    assert operator.answer_fault(0.0) is FaultAnswer.END
    assert failures == []
