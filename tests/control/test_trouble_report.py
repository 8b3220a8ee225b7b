"""Error frames as events."""

from adacd_hil.control.exchange import TroubleReport
from adacd_hil.wire.bus import Frame


def passive(t_s: float) -> Frame:
    return Frame(0x204, bytes((0, 0x20, 0, 0, 0, 0, 130, 0)), int(t_s * 1e9), is_error=True)


def no_acknowledge(t_s: float) -> Frame:
    return Frame(0x020, bytes(8), int(t_s * 1e9), is_error=True)


def texts(report: TroubleReport) -> list[str]:
    return [event.message for event in report.take_events()]


def test_an_error_frame_is_an_event_in_words() -> None:
    report = TroubleReport()
    report.accept(passive(0.0))
    assert texts(report) == ["error passive (sending); error counters: sending 130, receiving 0"]


def test_a_kind_is_said_once_a_second_and_the_rest_counted() -> None:
    report = TroubleReport()
    for t_s in (0.0, 0.4, 0.999, 1.0):
        report.accept(no_acknowledge(t_s))
    assert texts(report) == ["no acknowledgement", "no acknowledgement (and 2 before)"]


def test_kinds_do_not_hide_each_other() -> None:
    report = TroubleReport()
    report.accept(no_acknowledge(0.0))
    report.accept(passive(0.1))
    assert len(texts(report)) == 2


def test_events_are_taken_once() -> None:
    report = TroubleReport()
    report.accept(no_acknowledge(0.0))
    report.take_events()
    assert report.take_events() == []
