"""One joint torque sensor as the host sees it: protected process value, status. Source: CiA 404, clause 7."""

from enum import IntFlag

from adacd_hil.wire.codec import Codec


class SensorStatus(IntFlag):
    """Bits of 0x6150, analogue input status."""

    NOT_VALID = 1
    POSITIVE_OVERLOAD = 2
    NEGATIVE_OVERLOAD = 4


class TorqueSensor:
    """The torque sensor of joint 1 or 2."""

    def __init__(self, codec: Codec, joint: int) -> None:
        name = f"Sensor{joint}"
        self.name = name
        self.node_id = codec.node_id(f"{name}Torque")
        self.torque_message = codec.message(f"{name}Torque")
        self.status_message = codec.message(f"{name}Status")
        self.end_to_end = self.torque_message.receiver()
        self.torque_Nm = 0.0
        self.sample_cycle = -1
        """Cycle of the torque in use; -1 before the first."""
        self.status = SensorStatus(0)

    def accept_torque(self, data: bytes, cycle: int) -> bool:
        """Take one torque frame of `cycle`; False when a check fails and it changes nothing."""
        if len(data) != self.torque_message.length or not self.end_to_end.check(data).is_valid:
            return False
        (self.torque_Nm,) = self.torque_message.decode_values(data)
        self.sample_cycle = cycle
        return True

    def accept_status(self, data: bytes) -> None:
        """Take one status frame; a frame of the wrong length changes nothing."""
        if len(data) == self.status_message.length:
            self.status = SensorStatus(int(self.status_message.decode_values(data)[0]) & 0x07)
