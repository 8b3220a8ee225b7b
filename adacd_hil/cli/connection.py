"""What the commands that work on a bus share: settings, contract, an open bus, and an orderly end."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from adacd_hil.cli.exit_codes import CommandError, ExitCode
from adacd_hil.clock import Clock
from adacd_hil.config import Settings, load_settings
from adacd_hil.wire.bus import Bus, BusError, BusMissingError, open_bus
from adacd_hil.wire.codec import Codec, load_codec


@dataclass(frozen=True)
class Connection:
    """Where the arm is and what it should be, as given on the command line."""

    interface: str
    channel: str
    bitrate: int | None
    config: str
    profile: str | None
    dbc: Path | None

    def load(self) -> tuple[Settings, Codec]:
        """Read configuration and contract. Raises ConfigError, CodecError."""
        return load_settings(self.config, self.profile), load_codec(self.dbc)

    @contextmanager
    def bus(self, clock: Clock) -> Iterator[Bus]:
        """Open the bus, receiving everything, while the block lasts. Raises BusMissingError.

        A bus that fails in the block ends the command as missing: nothing has been enabled on it.
        """
        bus = open_bus(self.interface, self.channel, clock, None, self.bitrate)
        try:
            yield bus
        except BusMissingError:
            raise
        except BusError as error:
            raise CommandError(str(error), ExitCode.BUS_MISSING) from None
        finally:
            bus.close()


def raise_interrupt() -> NoReturn:
    """End a command from within a signal handler, through its `finally` blocks. Raises KeyboardInterrupt."""
    raise KeyboardInterrupt


@contextmanager
def on_interrupt(interrupt: Callable[[], None]) -> Iterator[None]:
    """Let SIGINT and SIGTERM call a function instead of ending the process."""
    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in previous:
        signal.signal(number, lambda *_: interrupt())
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
