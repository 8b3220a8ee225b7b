"""Monitor: a live table of the traffic on a bus. Listens only."""

import math
import shutil
import sys
from collections.abc import Callable
from typing import Any

from adacd_hil.cli.connection import Connection
from adacd_hil.cli.output import ExitCode, format_table
from adacd_hil.clock import Clock, MonotonicClock
from adacd_hil.lab.commission.survey import BusView
from adacd_hil.lab.commission.traffic import receive_until
from adacd_hil.lab.stated_bounds import PLAIN_S
from adacd_hil.plain_values import json_text
from adacd_hil.printable import plain
from adacd_hil.terminal import fold, moves_cursor, on_interrupt, terminal_columns, write_screen
from adacd_hil.wire.bus import Bus, BusError, Frame
from adacd_hil.wire.can_interface import carried_frames, read_link
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_attributes import read_bitrates
from adacd_hil.wire.dbc_decoder import DbcDecoder

REDRAW_S = 0.2
"""Interval of redrawing a terminal: the eye can follow 5 Hz."""
_LINK_S = 1.0
_HOME, _CLEAR_LINE, _CLEAR_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"


class Screen:
    """Output of tables: redrawn in place on a terminal, one after the other elsewhere. write: prints a text."""

    def __init__(self, is_terminal: bool, write: Callable[[str], None]) -> None:
        self.is_redrawn = is_terminal
        """Whether a table replaces the previous one."""
        self.redraw_s = REDRAW_S if is_terminal else PLAIN_S
        """Time between two tables."""
        self._write = write

    def draw_table(self, text: str) -> None:
        """Print a table; on a terminal in place of the previous one, and cut to its size, with a line on the rest."""
        text = plain(text)
        if not self.is_redrawn:
            self._write(text + "\n\n")
            return
        columns, rows = shutil.get_terminal_size()
        lines = fold(text, columns).split("\n")
        if len(lines) >= rows:
            lines = [*lines[: rows - 2], f"… {len(lines) - rows + 2} lines more: a higher terminal shows them"]
        self._write(_HOME + "".join(f"{_CLEAR_LINE}{line[:columns]}\n" for line in lines) + _CLEAR_BELOW)

    def end(self, text: str) -> None:
        """Print the last table, uncut; on a terminal in place of the previous one."""
        self._write((_HOME + _CLEAR_BELOW if self.is_redrawn else "") + plain(text) + "\n")


class Monitor:
    """Counts and checks the traffic on a bus from now on, and describes it.

    node_id: describe this node only; None: all.
    """

    def __init__(
        self, connection: Connection, codec: Codec | DbcDecoder, bus: Bus, clock: Clock, node_id: int | None
    ) -> None:
        self._bus, self._clock, self._node_id = bus, clock, node_id
        self._link_name = connection.channel if connection.interface == "socketcan" else None
        self._carried = self._count_carried()
        self._view = BusView(codec, *read_bitrates(codec), clock.now_ns())
        self._dropped = bus.frames_lost
        self._state = ""
        self._state_ns = -round(_LINK_S * 1e9)
        self.is_stopped = False

    def stop(self) -> None:
        """Make the present and later `listen`s end after a few frames. Safe in a signal handler."""
        self.is_stopped = True

    def listen(self, duration_s: float) -> bool:
        """Read frames from the bus into the view for a duration; after `stop` end earlier, and return False.

        Raises BusError if the bus fails.
        """
        end_ns = self._clock.now_ns() + round(duration_s * 1e9)
        while (frame := receive_until(self._bus, self._clock, end_ns)) is not None:
            self._accept(frame)
            while (waiting := self._bus.receive(0.0)) is not None:  # a batch; the clock is read every 256 frames
                self._accept(waiting)
                if self._view.frames % 256 == 0:
                    break
            if self.is_stopped:
                break
        return not self.is_stopped

    def _accept(self, frame: Frame) -> None:
        if self._bus.frames_lost != self._dropped:
            self._dropped = self._bus.frames_lost
            self._view.restart_counters()
        self._view.accept(frame)

    def describe(self) -> dict[str, Any]:
        """Return the traffic so far as a dictionary for JSON; its load is of the time since the previous call.

        It has the keys of `BusView.describe`; bus_state, of the controller, read once per `_LINK_S`, the interface's
        kind, such as "vcan", if that is unknown, "" for other than SocketCAN, "gone" without the interface; and
        not_processed: frames that the interface carried and this process has not read, None if unknown.
        """
        now_ns = self._clock.now_ns()
        if self._link_name is not None and now_ns - self._state_ns >= _LINK_S * 1e9:
            link = read_link(self._link_name)
            self._state, self._state_ns = (link.state or link.kind) if link else "gone", now_ns
        described = self._view.describe(now_ns, self._node_id)
        return described | {"bus_state": self._state, "not_processed": self._count_missed()}

    def _count_carried(self) -> int | None:
        return None if self._link_name is None else carried_frames(self._link_name)

    def _count_missed(self) -> int | None:
        """Return the number of frames that the interface carried and this process has not read: lost, or still queued.

        None if the interface doesn't count frames.
        """
        now = self._count_carried()
        return None if now is None or self._carried is None else max(0, now - self._carried - self._view.frames)


def show_tables(
    listen: Callable[[float], bool],
    describe: Callable[[], dict[str, Any]],
    as_text: Callable[..., str],
    seconds: float | None,
    as_json: bool,
) -> None:
    """Listen for so many seconds, then print a table, or JSON; None: print tables until the listening ends.

    Of as_json, only the last table is JSON. listen: for a duration, s; False: it has ended. describe: returns what was
    heard, as_text: that as a table. The last table is printed even if the bus fails; then BusError is raised.
    """
    screen = Screen(seconds is None and moves_cursor(sys.stdout), write_screen)
    clock = MonotonicClock()
    end_ns = math.inf if seconds is None else clock.now_ns() + seconds * 1e9

    def end() -> None:
        described = describe()
        screen.end(json_text(described) if as_json else fold(as_text(described), terminal_columns()))

    try:
        while listen(min((end_ns - clock.now_ns()) * 1e-9, screen.redraw_s)) and clock.now_ns() < end_ns:
            if seconds is None:
                screen.draw_table(as_text(describe(), is_cut=screen.is_redrawn))
    except BusError:
        end()
        raise
    end()


def watch(connection: Connection, node_id: int | None, seconds: float | None, as_json: bool) -> ExitCode:
    """Listen on a bus, and print a table of its traffic at the end; return exit status OK, also if interrupted.

    seconds: None: until interrupted, and the table is printed repeatedly. as_json: print JSON. node_id: show this node
    only. Raises ConfigError, CodecError if configuration or contract can't be used, BusMissingError if the bus can't be
    opened, CommandError if it fails.
    """
    clock = MonotonicClock()
    codec = connection.load_decoder()  # errors of the configuration come before errors of the bus
    with connection.bus(clock, codec.is_fd) as bus:
        monitor = Monitor(connection, codec, bus, clock, node_id)
        with on_interrupt(monitor.stop):
            if seconds is not None:
                print(f"listening on {bus.channel}", file=sys.stderr, flush=True)
            show_tables(monitor.listen, monitor.describe, as_text, seconds, as_json)
    return ExitCode.OK


def as_text(described: dict[str, Any], is_cut: bool = False) -> str:
    """Return the traffic, as of `Monitor.describe`, as tables for people.

    is_cut: print one line for each message, cut to the terminal.
    """
    parts = [_head(described)]
    if described["nodes"]:
        rows = [
            (str(node["node_id"]), node["name"], node["state"], f"{1000.0 * node['age_s']:.0f}")
            for node in described["nodes"]
        ]
        parts.append(format_table(("node", "name", "state", "heartbeat ms ago"), rows, right=(0, 3)))
    messages = described["messages"]
    if messages:
        head = ("id", "message", "Hz", "age ms", "lost", "bad", "values")
        parts.append(format_table(head, [_row(message) for message in messages], (2, 3, 4, 5), is_cut))
    else:
        parts.append("nothing heard")
    return "\n\n".join(parts)


def _head(described: dict[str, Any]) -> str:
    missed, strange = described["not_processed"], described["strange_frames"]
    parts = [
        f"load {described['load_percent']:.1f} %",
        f"{described['frames']} frames",
        f"{described['error_frames']} error frames",
    ]
    if strange:
        parts.append(f"{strange} that a bus of the contract can't carry")
    if missed is not None:
        parts.append(f"{missed} not processed")
    if described["bus_state"]:
        parts.append(f"bus {described['bus_state']}")
    return ", ".join(parts)


def _row(message: dict[str, Any]) -> tuple[str, ...]:
    values = message["values"]
    text = ", ".join(f"{name} {value:g} {message['units'][name]}".rstrip() for name, value in values.items())
    return (
        f"0x{message['id']:03X}",
        message["message"],
        f"{message['rate_Hz']:.1f}",
        f"{1000.0 * message['age_s']:.1f}",
        str(message["lost"]) if message["is_protected"] else "-",
        str(message["errors"]) if message["is_known"] else "-",
        text or f"[{message['data']}]",
    )
