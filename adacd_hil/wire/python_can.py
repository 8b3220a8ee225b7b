"""Any python-can interface that does not echo own frames.

python-can's interfaces raise many kinds of errors: NameError without the maker's library, ImportError, TypeError for
missing settings, the maker's exceptions. Here each becomes one line with a remedy.
"""

import contextlib
import logging
import re
import sys
from importlib.metadata import metadata
from typing import Any

import can

from adacd_hil.clock import Clock, MonotonicClock
from adacd_hil.extras import pip_command
from adacd_hil.remedies import hint
from adacd_hil.wire.bus import Bus, BusError, BusMissingError, Frame
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES, MAX_STANDARD_ID

_ECHOING_INTERFACES = ("udp_multicast",)
_WITHOUT_HARDWARE = ("virtual", "udp_multicast", "socketcand")
_EXTRAS = {"slcan": "serial", "robotell": "serial"}
"""python-can's extra for an interface, if it differs from its name."""
_MISSING = re.compile(r"missing \d+ required (?:positional|keyword-only) arguments?: (.+)")
for _logger in ("can", "seeedbus"):  # our errors replace their output on the terminal
    logging.getLogger(_logger).addHandler(logging.NullHandler())


def interface_names() -> list[str]:
    """Return the names of the interfaces that python-can knows, plugins included."""
    return sorted(can.VALID_INTERFACES)


def is_usable(interface: str) -> bool:
    """Return whether python-can knows an interface and it doesn't echo own frames, so that a cycle can run on it."""
    return interface in can.VALID_INTERFACES and interface not in _ECHOING_INTERFACES


class PythonCanBus(Bus):
    """A python-can interface other than SocketCAN. The data bit rate of CAN FD comes from python-can's settings."""

    def __init__(
        self, interface: str, channel: str, clock: Clock, bitrate: int | None = None, is_fd: bool = False
    ) -> None:
        """Open it, at `bitrate` bit/s if the interface sets one. is_fd: for CAN FD frames, too.

        Raises BusMissingError for an interface that is unknown, echoes own frames or doesn't open.
        """
        if interface in _ECHOING_INTERFACES:
            raise BusMissingError(f"interface {interface} echoes own frames and can't carry a cycle; use socketcan")
        if interface not in can.VALID_INTERFACES:
            raise BusMissingError(f"unknown interface {interface!r}; {hint(interface, interface_names())}")
        self.channel = channel
        self._interface = interface
        self._clock = clock
        self._waiting = MonotonicClock()
        self._options: dict[str, Any] = {} if bitrate is None else {"bitrate": bitrate}
        if is_fd:
            self._options["fd"] = True
        self._is_fd = is_fd
        self._bus = self._open()

    def _open(self) -> can.BusABC:
        """Return the opened interface. Raises BusMissingError, with a remedy, if it doesn't open."""
        try:
            return can.Bus(self.channel, interface=self._interface, receive_own_messages=False, **self._options)
        except Exception as error:
            where = f"interface {self._interface}, channel {self.channel}"
            raise BusMissingError(f"{where}: {_in_words(error)}{_remedy(self._interface, error)}") from None

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame, beyond `CLASSIC_BYTES` as CAN FD with rate switch.

        Raises BusError if the interface fails, and for such a length on a bus that was opened without `is_fd`.
        """
        is_long = len(data) > CLASSIC_BYTES
        if is_long and not self._is_fd:
            raise BusError(f"sending on {self.channel}: {len(data)} data bytes need CAN FD")
        try:
            self._bus.send(
                can.Message(
                    arbitration_id=can_id,
                    data=data,
                    is_extended_id=can_id > MAX_STANDARD_ID,
                    is_fd=is_long,
                    bitrate_switch=is_long,
                )
            )
        except Exception as error:
            raise BusError(f"sending on {self.channel}: {_in_words(error)}") from None

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, with the clock's present time, or None after `timeout_s`.

        Remote frames, and 29-bit identifiers that fit into 11 bits, are dropped. Raises BusError if the interface
        fails.
        """
        deadline_ns = self._waiting.now_ns() + int(timeout_s * 1e9)
        while True:
            try:
                message = self._bus.recv(timeout_s)
            except Exception as error:
                raise BusError(f"receiving on {self.channel}: {_in_words(error)}") from None
            if message is None:
                return None
            can_id = message.arbitration_id
            is_ambiguous = message.is_extended_id and can_id <= MAX_STANDARD_ID and not message.is_error_frame
            if not message.is_remote_frame and not is_ambiguous:
                return Frame(can_id, bytes(message.data), self._clock.now_ns(), message.is_error_frame)
            timeout_s = max(deadline_ns - self._waiting.now_ns(), 0) * 1e-9

    def recover(self) -> None:
        """Empty the transmit buffer if the interface can, and open it again. Raises BusError if it doesn't open."""
        # Few interfaces can empty a buffer, and a broken one fails: `_open` raises if the interface doesn't work.
        with contextlib.suppress(Exception):
            self._bus.flush_tx_buffer()
        self.close()
        self._bus = self._open()

    def close(self) -> None:
        """Shut the interface down; errors are ignored."""
        with contextlib.suppress(Exception):
            self._bus.shutdown()


def _in_words(error: Exception) -> str:
    """Return the text of an error of an interface in one line, clearer for missing settings or a missing library."""
    text = " ".join(str(error).split())
    if missing := _MISSING.search(text):
        return f"it also needs {missing[1]}, which python-can takes from ~/.canrc"
    if isinstance(error, NameError | AttributeError):  # a function of a library that isn't installed
        return f"its maker's library is not installed ({text})"
    return text or type(error).__name__


def _remedy(interface: str, error: Exception) -> str:
    """Return remedies for an interface that can't be opened, each behind a semicolon; "" without one.

    They are python-can's extra, if the interface has one and a library is missing; and on Linux, for an adapter,
    socketcan.
    """
    remedies = []
    extra = _EXTRAS.get(interface, interface.replace("_", "-"))
    is_here = isinstance(error, ImportError | can.CanInterfaceNotImplementedError) and "Windows" not in str(error)
    if is_here and extra in (metadata("python-can").get_all("Provides-Extra") or ()):
        remedies.append(f"{pip_command()} install 'python-can[{extra}]'")
    if sys.platform == "linux" and interface not in _WITHOUT_HARDWARE:
        remedies.append("on Linux most adapters are -i socketcan -c can0, with the kernel's driver")
    return "".join(f"; {remedy}" for remedy in remedies)
