"""Interfaces of python-can fail in ways of their own, and in one line each."""

import can
import pytest
from can.interfaces import BACKENDS

from adacd_hil.clock import MonotonicClock
from adacd_hil.wire.bus import BusError, BusMissingError
from adacd_hil.wire.open_bus import open_bus


@pytest.mark.parametrize(
    ("interface", "remedy"),
    [
        ("neovi", r"pip install 'python-can\[neovi\]'"),
        ("slcan", r"pip install 'python-can\[serial\]'"),
        ("socketcand", "'host' and 'port'.*~/.canrc"),
        ("kvaser", "its maker's library is not installed"),
        *((name, "-i socketcan -c can0") for name in ("kvaser", "neovi", "pcan", "slcan")),
    ],
)
def test_the_remedy_is_the_interface_s_own(interface, remedy):
    with pytest.raises(BusMissingError, match=remedy):
        open_bus(interface, "0", MonotonicClock())


class MakersError(Exception):
    """What a maker's library raises."""


class FailingBus(can.BusABC):
    """An interface that fails with its maker's exception wherever it is asked to."""

    fails = ""

    def __init__(self, channel, **_):
        super().__init__(channel)
        self._fail("open")

    def _fail(self, at):
        if self.fails == at:
            raise MakersError(f"status -7\nat {at}")

    def send(self, msg, timeout=None):
        self._fail("send")

    def _recv_internal(self, timeout):
        self._fail("receive")
        return None, False

    def flush_tx_buffer(self):
        self._fail("flush")

    def shutdown(self):
        super().shutdown()
        self._fail("shutdown")


@pytest.fixture
def failing(monkeypatch):
    """Register the interface as a plugin does."""
    monkeypatch.setitem(BACKENDS, "failing", (__name__, "FailingBus"))
    for module in (can, can.util):
        monkeypatch.setattr(module, "VALID_INTERFACES", can.VALID_INTERFACES | {"failing"})

    def fail(at):
        monkeypatch.setattr(FailingBus, "fails", at)

    return fail


def test_a_makers_exception_while_opening_is_a_missing_bus(failing):
    failing("open")
    with pytest.raises(BusMissingError, match=r"^interface failing, channel x: status -7 at open;"):
        open_bus("failing", "x", MonotonicClock())


@pytest.mark.parametrize(
    ("at", "use"), [("send", lambda bus: bus.send(1, b"x")), ("receive", lambda bus: bus.receive(0.0))]
)
def test_a_makers_exception_in_use_is_a_bus_error(failing, at, use):
    bus = open_bus("failing", "x", MonotonicClock())
    failing(at)
    with pytest.raises(BusError, match=f"on x: status -7 at {at}$"):
        use(bus)
    bus.close()


@pytest.mark.parametrize("at", ["flush", "shutdown"])
def test_a_makers_exception_at_the_end_ends_nothing_else(failing, at):
    bus = open_bus("failing", "x", MonotonicClock())
    failing(at)
    bus.recover()
    bus.send(1, b"x")
    bus.close()
