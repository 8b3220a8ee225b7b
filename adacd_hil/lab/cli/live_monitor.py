"""The live view in a terminal: state, residuals against their thresholds, parameters, contacts, events."""

import math
import struct
from collections import deque
from typing import Any

from adacd_hil.cli.output import ExitCode, format_table
from adacd_hil.clock import MonotonicClock
from adacd_hil.lab.cli.monitor_command import show_tables
from adacd_hil.lab.live.client import NO_LOG, LiveClient, LiveMessage, live_client
from adacd_hil.lab.live.scene import threshold_shares
from adacd_hil.log.log_files import LogError
from adacd_hil.log.types.topics import CONTACT, CYCLE, EVENTS, SCHEME
from adacd_hil.log.types.unpacking import unpack_log
from adacd_hil.printable import one_line
from adacd_hil.records import (
    GRAVITY_PARAMETER_NAMES,
    JOINT_NAMES,
    PARAMETER_NAMES,
    ContactKind,
    ContactLevel,
    FaultReason,
    Location,
    SchemeState,
)
from adacd_hil.terminal import on_interrupt

TOPICS = (SCHEME.name, CYCLE.name, CONTACT.name, EVENTS.name)
_BAR_WIDTH = 40
_EVENTS, _CONTACTS = 8, 5


class LiveMonitor:
    """Keeps the latest messages of a live view, and describes them. messages: number of those of `TOPICS`."""

    def __init__(self, client: LiveClient) -> None:
        self.messages = 0
        self._client = client
        self._clock = MonotonicClock()
        self._is_stopped = False
        self._begin_ns: int | None = None
        self._scheme: Any = None
        self._cycle: Any = None
        self._log_ns = 0
        self._contacts: deque[dict[str, Any]] = deque(maxlen=_CONTACTS)
        self._events: deque[dict[str, Any]] = deque(maxlen=_EVENTS)

    def stop(self) -> None:
        """Make `listen` end after its next message or at its time, and later ones at once. Safe in a signal handler."""
        self._is_stopped = True

    def listen(self, duration_s: float) -> bool:
        """Store the messages of a duration; after `stop`, or the end of the view, end earlier, and return False.

        Raises LogError or the errors of `accept_message` for data that is no log of adacd-hil.
        """
        end_ns = self._clock.now_ns() + round(duration_s * 1e9)
        while self._goes_on() and (left_ns := end_ns - self._clock.now_ns()) > 0:
            if (message := self._client.receive(left_ns * 1e-9)) is not None:
                self.accept_message(message)
        return self._goes_on()

    def _goes_on(self) -> bool:
        return self._client.is_open and not self._is_stopped

    def accept_message(self, message: LiveMessage) -> None:
        """Store a message for `describe`: the last few events and contacts, the latest of /scheme and /cycle.

        Other topics are ignored. Raises LookupError, ValueError or struct.error for data that can't be decoded.
        """
        if message.topic not in TOPICS:
            return
        self.messages += 1
        self._log_ns = max(self._log_ns, message.log_ns)
        self._begin_ns = message.log_ns if self._begin_ns is None else self._begin_ns
        t_s = round((message.log_ns - self._begin_ns) * 1e-9, 3)
        if message.topic == EVENTS.name:
            event = unpack_log(message.payload)
            self._events.append({"t_s": t_s, **event._asdict()})
        elif message.topic == CONTACT.name:
            self._contacts.append({"t_s": t_s, **_describe_contact(self._client.decode(message))})
        elif message.topic == SCHEME.name:
            self._scheme = self._client.decode(message)
        else:
            self._cycle = self._client.decode(message)

    def describe(self) -> dict[str, Any]:
        """Return the latest values as a dictionary for JSON; times are s of the log's clock since the first message.

        Of contacts and events it has the last few. The keys of /scheme, and "timing", are missing until a message of
        /scheme, or of /cycle, has come.
        """
        begin_ns = self._log_ns if self._begin_ns is None else self._begin_ns
        described: dict[str, Any] = {"messages": self.messages, "t_s": round((self._log_ns - begin_ns) * 1e-9, 3)}
        if self._scheme is not None:
            described |= _describe_scheme(self._scheme)
        if self._cycle is not None:
            names = ("lateness_ns", "slack_ns", "overruns", "data_age", "frames_missing")
            described["timing"] = {name: int(self._cycle[name]) for name in names}
        return described | {"contacts": list(self._contacts), "events": list(self._events)}


def _describe_scheme(scheme: Any) -> dict[str, Any]:
    shares = threshold_shares(scheme)
    joints = [
        {
            "joint": name,
            "q_rad": float(scheme["q"][index]),
            "tau_J_Nm": float(scheme["tau_j"][index]),
            "tau_ext_hat_Nm": float(scheme["tau_ext_hat"][index]),
            "threshold_Nm": _finite(scheme["threshold"][index]),
            "share": _finite(shares[index]),
        }
        for index, name in enumerate(JOINT_NAMES)
    ]
    theta_hat = scheme["theta_hat"].tolist()
    names = (PARAMETER_NAMES + GRAVITY_PARAMETER_NAMES)[: len(theta_hat)]
    return {
        "cycle": int(scheme["cycle"]),
        "state": SchemeState(int(scheme["state"])).name,
        "fault": FaultReason(int(scheme["fault"])).name,
        "joints": joints,
        "parameters": dict(zip(names, theta_hat, strict=True)),
    }


def _describe_contact(contact: Any) -> dict[str, Any]:
    return {
        "link": int(contact["link"]),
        "level": ContactLevel(int(contact["level"])).name,
        "kind": ContactKind(int(contact["kind"])).name,
        "location": Location(int(contact["location"])).name,
        "force_N": float(contact["force_n"]),
        "lever_m": float(contact["lever_m"]),
        "is_final": bool(contact["is_final"]),
    }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def watch_live(url: str, seconds: float | None, as_json: bool) -> ExitCode:
    """Watch the live view of a run at a URL, and print its values at the end; return exit status OK.

    seconds: None: until the user interrupts or the view ends, and the values are printed repeatedly. as_json: print
    JSON. Raises LogError if no view answers, or it doesn't serve a log of adacd-hil.
    """
    with live_client(url, TOPICS) as client:
        monitor = LiveMonitor(client)
        try:
            with on_interrupt(monitor.stop):
                show_tables(monitor.listen, lambda: {"url": url} | monitor.describe(), as_text, seconds, as_json)
        except (ValueError, LookupError, OverflowError, struct.error):
            raise LogError(NO_LOG) from None
    return ExitCode.OK


def as_text(described: dict[str, Any], is_cut: bool = False) -> str:
    """Return the values of `LiveMonitor.describe` as text for people; one line if no /scheme has come.

    is_cut: print one line for each event, cut to the terminal.
    """
    if "state" not in described:
        return f"{described['messages']} messages, none of {SCHEME.name}"
    fault = "" if described["fault"] == FaultReason.NONE.name else f" by {described['fault']}"
    head = f"{described['state']}{fault}, cycle {described['cycle']}, {described['t_s']:.1f} s watched"
    if timing := described.get("timing"):
        head += (
            f"; late {timing['lateness_ns'] * 1e-3:.0f} µs, slack {timing['slack_ns'] * 1e-3:.0f} µs, "
            f"{timing['overruns']} periods skipped, {timing['frames_missing']} frames missing"
        )
    parts = [head, "\n".join(map(_joint_line, described["joints"]))]
    parts.append("  ".join(f"{name} {value:.4g}" for name, value in described["parameters"].items()))
    if described["contacts"]:
        table_head = ("s", "contact", "link", "kind", "force N", "lever m", "location")
        parts.append(format_table(table_head, list(map(_contact_row, described["contacts"])), right=(0, 2, 4, 5)))
    if described["events"]:
        rows = [
            (f"{event['t_s']:.3f}", event["level"], one_line(event["name"]), one_line(event["message"]))
            for event in described["events"]
        ]
        parts.append(format_table(("s", "level", "event", ""), rows, (0,), is_cut))
    return "\n\n".join(parts)


def _joint_line(joint: dict[str, Any]) -> str:
    share = joint["share"]
    filled = 0 if share is None else min(_BAR_WIDTH, round(share * _BAR_WIDTH))
    bar = "#" * filled + "." * (_BAR_WIDTH - filled)
    limit = "detection off" if share is None else f"{100.0 * share:3.0f} % of the threshold"
    return (
        f"{joint['joint']} [{bar}] {limit:<22}  external {joint['tau_ext_hat_Nm']:+.3f} Nm, "
        f"torque {joint['tau_J_Nm']:+.3f} Nm, position {math.degrees(joint['q_rad']):+.1f}°"
    )


def _contact_row(contact: dict[str, Any]) -> tuple[str, ...]:
    return (
        f"{contact['t_s']:.3f}",
        contact["level"] if contact["is_final"] else f"{contact['level']} …",
        str(contact["link"]),
        contact["kind"],
        Location[contact["location"]].force_text(contact["force_N"]),
        f"{contact['lever_m']:.2f}",
        contact["location"],
    )
