"""A tare on a bus: opens it, runs a tare session, stores its result."""

import signal
from contextlib import closing
from pathlib import Path

from adacd_hil.cli.connection import Connection, check_clock, check_shared, make_clock, never_stopped
from adacd_hil.cli.output import CommandError, ExitCode, text_of
from adacd_hil.clock import VirtualClock
from adacd_hil.control.tare_file import Tare, read_tare, write_tare
from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.device.contract import load_contract
from adacd_hil.device.device_files import place_devices
from adacd_hil.device.strangers import refuse_company
from adacd_hil.lab.commission.tare import TareRefusedError
from adacd_hil.lab.commission.tare_session import TareSession
from adacd_hil.progress_lines import Progress
from adacd_hil.settings.setting_keys import apply_settings
from adacd_hil.terminal import on_interrupt


def as_text(tare: Tare, path: Path, backup: Path | None) -> str:
    """Return a tare as text for people, with a warning of a torque that never changed. path: its file.

    backup: copy of the file that was there before, None without one.
    """
    lines = [
        f"joint{joint}: offset {offset:+.4f} ± {error:.4f} Nm (was {old:+.4f}), spread of poses {spread:.4f} Nm, "
        f"sensor {sensor.serial}"
        for joint, (offset, error, old, spread, sensor) in enumerate(
            zip(
                tare.offset_Nm,
                tare.standard_error_Nm,
                tare.old_offset_Nm,
                tare.spread_Nm,
                tare.sensors,
                strict=True,
            ),
            start=1,
        )
    ]
    spans_Nm = zip(*(pose.peak_to_peak_Nm for pose in tare.poses), strict=True)
    lines += [
        f"warning: the torque of joint{joint} never changed: the sensor is dead, or coarser than its noise"
        for joint, spans in enumerate(spans_Nm, start=1)
        if not any(spans)
    ]
    if tare.gravity_model != "none":
        lines.append("gravity ({}): a4 = {:.4f} Nm, a5 = {:.4f} Nm".format(tare.gravity_model, *tare.gravity_Nm))
    kept = "" if backup is None else f"; the one before is {backup}"
    lines.append(f"{path}{kept}")
    return text_of(lines)


def tare_on_bus(
    connection: Connection,
    out: Path,
    clock: str,
    poses: int | None,
    seconds: float | None,
    auto_zero: bool,
) -> tuple[Tare, Path | None]:
    """Tare the sensors of an arm on a bus, and write file `out`; return the tare, and the copy of an older file.

    The copy is None without one. poses, seconds: number of poses, and time per pose; None: those of the configuration.
    clock: "lockstep" or "realtime". auto_zero: the sensors set their own zero first. Raises CommandError if the tare is
    refused, the arm not found, another host runs it, or the clock doesn't fit the bus; ConfigError, CodecError if
    configuration, contract or an older file can't be used; BusError if the bus fails; KeyboardInterrupt if the user
    interrupts or suspends it; OSError if the file can't be written.
    """
    interface, channel = connection.interface, connection.channel
    check_clock(clock, interface, channel)
    given = {"tare.poses": poses, "tare.window_s": seconds}
    changes = {key: repr(value) for key, value in given.items() if value is not None}
    settings = apply_settings(connection.settings(), changes)
    check_shared(clock, settings)
    # A file that isn't a tare is not overwritten.
    old_offset_Nm = read_tare(out).offset_Nm if out.exists() else settings.arm.torque_offset_Nm
    devices = place_devices(settings)
    codec = load_contract(settings, devices)
    timer = make_clock(clock)
    bus = connection.open(timer, codec, settings, devices)
    try:
        with Progress() as progress, closing(bus):
            if not isinstance(timer, VirtualClock):
                refuse_company(bus, timer, settings, codec, devices)
            session = TareSession(settings, codec, devices, bus, timer, interface, old_offset_Nm, auto_zero, progress)
            with never_stopped(), on_interrupt(session.interrupt, signal.SIGTSTP):
                tare = session.run()
    except TareRefusedError as reason:
        raise CommandError(f"tare refused: {reason}", ExitCode.FAILURE) from None
    except DeviceError as reason:
        raise CommandError(reason.line, ExitCode.BUS_MISSING) from None
    return tare, write_tare(tare, out)
