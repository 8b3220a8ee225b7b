"""Commands on a bus: settings, contract, the open bus, signals."""

import dataclasses
import shlex
import signal
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from adacd_hil.cli.output import CommandError, ExitCode
from adacd_hil.clock import LOCKSTEP, Clock, MonotonicClock, VirtualClock
from adacd_hil.device.contract import load_contract
from adacd_hil.device.device_files import place_devices
from adacd_hil.device.profile import PlacedDevice
from adacd_hil.device.strangers import host_frames
from adacd_hil.printable import in_line
from adacd_hil.settings.arm_settings import MOST_BLIND_CYCLES
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.terminal import handling
from adacd_hil.wire.bus import Bus, BusError, BusMissingError
from adacd_hil.wire.can_interface import can_interfaces, is_virtual
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.dbc_decoder import DbcDecoder, load_decoder
from adacd_hil.wire.open_bus import open_bus


def make_clock(name: str) -> Clock:
    """Return the clock of a run: a new one of modelled time for `lockstep`, else the system's monotonic clock."""
    return VirtualClock() if name == LOCKSTEP else MonotonicClock()


def check_clock(name: str, interface: str, channel: str) -> None:
    """Raise CommandError for the lockstep clock on a channel that may be hardware, which can't wait for the host.

    name: of the clock, as in `--clock`. A SocketCAN channel that doesn't exist passes, and so does an interface that
    can't be used: opening them raises the error.
    """
    if name == LOCKSTEP and may_be_hardware(interface, channel):
        raise CommandError(
            f"--clock lockstep is for emulated arms; {interface} {channel} may be hardware: it needs --clock realtime",
            ExitCode.USAGE,
        )


def check_rehearsal(scenario: str, interface: str, channel: str) -> None:
    """Raise CommandError if the channel may be hardware: there a person must acknowledge, not a scenario's user.

    scenario: its name, for the error.
    """
    if may_be_hardware(interface, channel):
        raise CommandError(
            f"--scenario {in_line(scenario)} plays the user of an emulated arm; {interface} {channel} may be hardware: "
            "leave it out",
            ExitCode.USAGE,
        )


def may_be_hardware(interface: str, channel: str) -> bool:
    """Return whether an arm may be on a channel: the channel exists, and isn't virtual.

    Virtual: vcan, vxcan, and python-can's own virtual bus. Of other interfaces than SocketCAN every channel counts as
    existing if python-can knows the interface and it doesn't echo own frames.
    """
    from adacd_hil.wire.python_can import is_usable

    is_there = channel in can_interfaces() if interface == "socketcan" else is_usable(interface)
    return is_there and not is_virtual(interface, channel)


def check_autonomy(settings: Settings, interface: str, channel: str) -> None:
    """Raise CommandError if settings let a real arm move without data, or acknowledge stops or faults without a user.

    A channel that isn't there passes: opening it raises the error. Without data: for more than MOST_BLIND_CYCLES.
    Acknowledgement without a user passes with `operator.acknowledge_on_hardware`.
    """
    if not may_be_hardware(interface, channel):
        return
    for name, value in (
        ("bus.max_age_cycles", settings.bus.max_age_cycles),
        ("data.blind_cycles", settings.data.blind_cycles),
    ):
        if value > MOST_BLIND_CYCLES:
            raise CommandError(
                f"`{name}` = {value} lets an arm move without data; on {interface} {channel} at most "
                f"{MOST_BLIND_CYCLES}, more on vcan only",
                ExitCode.USAGE,
            )
    operator = settings.operator
    if operator.acknowledges and not operator.acknowledge_on_hardware:
        name = "acknowledge_after_s" if operator.acknowledge_after_s > 0.0 else "acknowledge_faults"
        raise CommandError(
            f"`operator.{name}` = {getattr(operator, name):g} acknowledges by itself what stopped the arm; on "
            f"{interface} {channel} that needs `operator.acknowledge_on_hardware` = true",
            ExitCode.USAGE,
        )


def check_shared(name: str, settings: Settings) -> None:
    """Raise CommandError for lockstep on a bus with other hosts: in lockstep one host sets the time.

    name: of the clock, `lockstep` or `realtime`.
    """
    if name == LOCKSTEP and settings.bus.is_shared:
        raise CommandError(
            f"`bus.arms` = {settings.bus.arms} hosts need --clock realtime; in lockstep one host sets the time",
            ExitCode.USAGE,
        )


def model_time(bus: Bus, clock: Clock, codec: Codec, settings: Settings) -> Bus:
    """Return the bus wrapped for lockstep: only modelled time passes on it. Return it as it is in real time.

    Raises CodecError if the contract has no message Sync, or lacks one of the devices' cyclic frames.
    """
    if not isinstance(clock, VirtualClock):
        return bus
    # Imported here: it belongs to lockstep and isn't needed in real time.
    from adacd_hil.wire.lockstep_bus import make_lockstep_bus

    return make_lockstep_bus(bus, clock, codec, settings)


def received_ids(codec: Codec, settings: Settings, devices: Iterable[PlacedDevice]) -> list[int]:
    """Return the CAN identifiers that the host reads, ascending: the contract's, and those that only the host may send.

    A frame of the second kind shows another host.
    """
    return sorted(
        {message.can_id for message in codec.messages.values()} | host_frames(settings, codec, devices).keys()
    )


@dataclass(frozen=True)
class Connection:
    """The options of a command that reaches an arm: interface, channel, bit rate, configuration, profile, DBC.

    bitrate, profile, dbc: None if not given. config: name or file.
    """

    interface: str
    channel: str
    bitrate: int | None
    config: str
    profile: str | None
    dbc: Path | None

    @property
    def arguments(self) -> str:
        """The options by which another command reaches the same arm, quoted for a shell."""
        given = [
            ("-i", self.interface),
            ("-c", self.channel),
            ("-b", self.bitrate),
            ("--config", self.config),
            ("--profile", self.profile),
            ("--dbc", self.dbc),
        ]
        return " ".join(f"{option} {shlex.quote(str(value))}" for option, value in given if value is not None)

    def settings(self) -> Settings:
        """Return the settings of the configuration; --dbc, if given, becomes its contract.

        Raises ConfigError if it is invalid.
        """
        return self.with_contract(load_settings(self.config, self.profile))

    def with_contract(self, settings: Settings) -> Settings:
        """Return the settings with --dbc as their contract; without --dbc, return them unchanged."""
        if self.dbc is None:
            return settings
        return dataclasses.replace(settings, devices=dataclasses.replace(settings.devices, contract=str(self.dbc)))

    def load(self) -> tuple[Settings, Codec, list[PlacedDevice]]:
        """Return the settings, the codec of their contract, and the devices.

        Raises ConfigError for invalid settings or devices, CodecError for an invalid contract.
        """
        settings = self.settings()
        devices = place_devices(settings)
        return settings, load_contract(settings, devices), devices

    def load_decoder(self) -> Codec | DbcDecoder:
        """Return the frame decoder for a command that only listens: of any DBC that --dbc names, else of the contract.

        Raises ConfigError for invalid settings or devices, CodecError for an invalid DBC.
        """
        if self.dbc is not None:
            decoder = load_decoder(self.dbc)
            if not decoder.is_contract:
                return decoder
        return self.load()[1]

    def open(self, clock: Clock, codec: Codec, settings: Settings, devices: Iterable[PlacedDevice]) -> Bus:
        """Open the bus for a run and return it; in real time SocketCAN receives only identifiers of `received_ids`.

        Other interfaces receive all. A VirtualClock means lockstep: the bus then models the time. Raises
        BusMissingError if it can't be opened, in lockstep CodecError if the contract has no message Sync, or lacks one
        of the devices' cyclic frames.
        """
        can_ids = None if isinstance(clock, VirtualClock) else received_ids(codec, settings, devices)
        bus = open_bus(self.interface, self.channel, clock, can_ids, self.bitrate, codec.is_fd, settings.bus.is_shared)
        return model_time(bus, clock, codec, settings)

    @contextmanager
    def bus(self, clock: Clock, is_fd: bool) -> Iterator[Bus]:
        """Open the bus, yield it, and close it after the block. It receives all identifiers; is_fd: CAN FD frames, too.

        Raises BusMissingError if it can't be opened. A BusError in the block becomes a CommandError with the exit
        status BUS_MISSING: no drive has been enabled.
        """
        bus = open_bus(self.interface, self.channel, clock, None, self.bitrate, is_fd)
        try:
            yield bus
        except BusMissingError:
            raise
        except BusError as error:
            raise CommandError(str(error), ExitCode.BUS_MISSING) from None
        finally:
            bus.close()


def raise_interrupt() -> NoReturn:
    """Raise KeyboardInterrupt, so that a signal ends a command through its `finally` blocks; see `on_interrupt`."""
    raise KeyboardInterrupt


def never_stopped() -> AbstractContextManager[None]:
    """Ignore SIGTTIN and SIGTTOU in the block, by which a terminal stops a background process that reads or writes it.

    A stopped process would send no commands to a moving arm. Reading such a terminal raises OSError instead. Restore
    the handlers after the block.
    """
    return handling(signal.SIG_IGN, signal.SIGTTIN, signal.SIGTTOU)
