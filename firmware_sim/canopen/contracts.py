"""The contracts that the emulator can play: a DBC and the EDS files of the devices behind it."""

import contextlib
from dataclasses import dataclass
from pathlib import Path

from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.bus import CLASSIC_BYTES
from adacd_hil.wire.codec import Codec, CodecError, contract_folder, load_codec
from adacd_hil.wire.contract_frames import move_contract
from firmware_sim.canopen.pdo_record import FD_BYTES


@dataclass(frozen=True)
class EmulatedContract:
    """File names within `contract_folder`."""

    dbc: str
    drive_eds: str
    sensor_eds: str

    @property
    def path(self) -> Path:
        """The DBC."""
        return contract_folder() / self.dbc


CONTRACTS = {
    "arm": EmulatedContract("arm.dbc", "drive.eds", "torque_sensor.eds"),
    "arm_fd": EmulatedContract("arm_fd.dbc", "drive_fd.eds", "torque_sensor_fd.eds"),
    "arm_fd_500us": EmulatedContract("arm_fd_500us.dbc", "drive_fd.eds", "torque_sensor_fd.eds"),
    "arm_stock": EmulatedContract("arm_stock.dbc", "stock_drive.eds", "int32_sensor.eds"),
}
"""By the name of the DBC file."""


def contract_of(codec: Codec) -> EmulatedContract:
    """Find the contract of a DBC by its file name; any other DBC is played by our own devices."""
    return CONTRACTS.get(codec.path.stem, CONTRACTS["arm_fd" if is_fd(codec) else "arm"])


def playable_contract(codec: Codec) -> EmulatedContract:
    """Find the contract with the layout of a DBC, wherever its nodes are. Raises ConfigError when there is none."""
    for contract in CONTRACTS.values():
        if codec.path == contract.path:
            return contract
    offset = codec.node_id("Drive1Heartbeat") - load_codec().node_id("Drive1Heartbeat")
    for contract in CONTRACTS.values():
        with contextlib.suppress(CodecError):  # a node id that this contract can't have
            moved = move_contract(load_codec(contract.path), offset, codec.node_id("HostHeartbeat"))
            if moved.layout_digest == codec.layout_digest:
                return contract
    raise ConfigError(
        f"no emulated device has the frames of {codec.path.name}, layout digest 0x{codec.layout_digest:08X}; "
        f"the emulator plays {', '.join(CONTRACTS)}; `adacd-hil run` runs on the arm itself"
    )


def is_fd(codec: Codec) -> bool:
    """Whether frames are longer than classic CAN has."""
    return any(message.length > CLASSIC_BYTES for message in codec.messages.values())


def longest_pdo(codec: Codec) -> int:
    """Return how many bytes a PDO may have on this contract's bus."""
    return FD_BYTES if is_fd(codec) else CLASSIC_BYTES
