"""The contracts that the emulator can play: a DBC and the EDS files of the devices behind it."""

from dataclasses import dataclass
from pathlib import Path

from adacd_hil.wire.codec import Codec, contract_folder
from firmware_sim.pdo_mapping import CLASSIC_BYTES, FD_BYTES


@dataclass(frozen=True)
class Contract:
    """File names within `contract_folder`."""

    dbc: str
    drive_eds: str
    sensor_eds: str

    @property
    def path(self) -> Path:
        """The DBC."""
        return contract_folder() / self.dbc


CONTRACTS = {
    "arm": Contract("arm.dbc", "drive.eds", "torque_sensor.eds"),
    "arm_fd": Contract("arm_fd.dbc", "drive_fd.eds", "torque_sensor_fd.eds"),
    "arm_fd_500us": Contract("arm_fd_500us.dbc", "drive_fd.eds", "torque_sensor_fd.eds"),
    "arm_stock": Contract("arm_stock.dbc", "stock_drive.eds", "int32_sensor.eds"),
}
"""By the name of the DBC file."""


def contract_of(codec: Codec) -> Contract:
    """Find the contract of a DBC by its file name; any other DBC is played by our own devices."""
    return CONTRACTS.get(codec.path.stem, CONTRACTS["arm_fd" if is_fd(codec) else "arm"])


def is_fd(codec: Codec) -> bool:
    """Whether frames are longer than classic CAN has."""
    return any(message.length > CLASSIC_BYTES for message in codec.messages.values())


def longest_pdo(codec: Codec) -> int:
    """Return how many bytes a PDO may have on this contract's bus."""
    return FD_BYTES if is_fd(codec) else CLASSIC_BYTES


def answers_to_sync(codec: Codec) -> frozenset[int]:
    """Name the identifiers that the devices of a contract send on every SYNC. Raises CodecError."""
    names = ("Drive1Feedback", "Drive2Feedback", "Sensor1Torque", "Sensor2Torque")
    return frozenset(codec.message(name).can_id for name in names)
