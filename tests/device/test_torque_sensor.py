"""One joint torque sensor as the host sees it."""

import dataclasses

import pytest
from loaded import encoded, loaded_contract

from adacd_hil.device.device_files import place_devices
from adacd_hil.device.torque_sensor import SensorStatus, TorqueSensor
from adacd_hil.records import JOINTS
from adacd_hil.settings.configuration_files import load_settings

PAPER, STOCK_SETTINGS = load_settings("paper"), load_settings("stock")
CODEC, STOCK = loaded_contract(PAPER), loaded_contract(STOCK_SETTINGS)
OVERLOADED = SensorStatus.POSITIVE_OVERLOAD | SensorStatus.NOT_VALID


class Protected:
    """A sensor with an end-to-end header, and its frames."""

    def __init__(self) -> None:
        self.sensor = TorqueSensor(PAPER, CODEC, place_devices(PAPER)[JOINTS])
        self._sender = CODEC.message("Sensor1Torque").sender()

    def frame(self, torque: float, status: int = 0) -> bytes:
        frame = encoded(CODEC.message("Sensor1Torque"), torque)
        frame[1] = status << 4
        return self._sender.protect(frame)


def unprotected(range_Nm: float = 0.0) -> TorqueSensor:
    placed = place_devices(STOCK_SETTINGS)[JOINTS]
    plausibility = dataclasses.replace(placed.settings.plausibility, torque_range_Nm=range_Nm)
    own = placed.profile._replace(settings=dataclasses.replace(placed.settings, plausibility=plausibility))
    return TorqueSensor(STOCK_SETTINGS, STOCK, dataclasses.replace(placed, profile=own))


def int32(torque: float) -> bytes:
    return bytes(encoded(STOCK.message("Sensor1Torque"), torque))


def test_a_valid_frame_is_taken_with_its_cycle_and_its_status() -> None:
    rig = Protected()
    assert rig.sensor.accept_cyclic(rig.frame(1.5), 7)
    assert (rig.sensor.values[0], rig.sensor.sample_cycle, rig.sensor.status) == (1.5, 7, 0)
    for cycle in range(8, 28):
        rig.sensor.accept_cyclic(rig.frame(20.0, status=3), cycle)
        assert (rig.sensor.sample_cycle, rig.sensor.status, rig.sensor.values[0]) == (cycle, OVERLOADED, 20.0)


def test_a_sensor_that_repeats_its_frame_ages() -> None:
    rig = Protected()
    frame = rig.frame(1.5)
    taken = [rig.sensor.accept_cyclic(frame, cycle) for cycle in range(5)]
    assert taken == [True, False, False, False, False]
    assert (rig.sensor.sample_cycle, rig.sensor.status) == (0, 0)


def test_a_jump_of_unprotected_torque_changes_nothing() -> None:
    sensor = unprotected()
    sensor.accept_cyclic(int32(1.0), 0)
    assert not sensor.accept_cyclic(int32(1.0 + 2**21 * 1e-5), 1)  # a flipped bit
    assert (sensor.values[0], sensor.sample_cycle, sensor.implausible_frames) == (1.0, 0, 1)


@pytest.mark.parametrize(
    ("torque", "cycles", "taken"),
    [(25.0, (1, 2), [False, True]), (25.0, (2,), [True]), (0.5, (0,), [True])],
    ids=["a true step, with its second frame", "after a gap", "a late frame and the next in one cycle"],
)
def test_the_bound_of_unprotected_torque_widens_with_the_cycles(
    torque: float, cycles: tuple[int, ...], taken: list[bool]
) -> None:
    sensor = unprotected()
    sensor.accept_cyclic(int32(0.0), 0)
    assert [sensor.accept_cyclic(int32(torque), cycle) for cycle in cycles] == taken


def test_the_end_of_its_range_is_the_overload_of_a_sensor_without_status() -> None:
    sensor = unprotected(range_Nm=20.0)
    states = []
    for cycle, torque in enumerate((19.9, 20.0, 19.9, 10.0, 0.0, -10.0, -20.0)):
        sensor.accept_cyclic(int32(torque), cycle)
        states.append(sensor.status)
    negative = SensorStatus.NEGATIVE_OVERLOAD | SensorStatus.NOT_VALID
    assert states == [0, OVERLOADED, 0, 0, 0, 0, negative]


def test_a_frame_of_the_wrong_length_changes_nothing() -> None:
    sensor = unprotected()
    assert not sensor.accept_cyclic(bytes(3), 0)
    sensor.accept_status(bytes(2), 0)  # this sensor has no status frame
    assert (sensor.sample_cycle, sensor.implausible_frames, sensor.status) == (-1, 1, 0)


@pytest.mark.parametrize("taken_back", [False, True])
def test_what_the_status_frame_says_outlives_torque_frames_that_say_otherwise_unless_taken_back(
    taken_back: bool,
) -> None:
    rig = Protected()
    rig.sensor.accept_status(bytes((0x01, 0)), 0)
    states = []
    for cycle in range(5):
        rig.sensor.accept_cyclic(rig.frame(1.5), cycle)
        states.append(rig.sensor.status)
        if taken_back and cycle == 0:
            rig.sensor.accept_status(bytes((0x00, 0)), 0)
    assert states == [0] + [0 if taken_back else SensorStatus.NOT_VALID] * 4


def test_what_the_torque_frame_says_outlives_a_status_frame_that_says_otherwise() -> None:
    rig = Protected()
    rig.sensor.accept_cyclic(rig.frame(20.0, status=3), 0)
    rig.sensor.accept_status(bytes((0x00, 0)), 1)
    assert rig.sensor.status == OVERLOADED
