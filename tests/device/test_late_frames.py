"""Late frames are used with the age that they have; samples are joined by the SYNC that they were taken on."""

import numpy as np
import pytest
from loaded import loaded_contract
from long_cases import long_but

from adacd_hil.clock import VirtualClock
from adacd_hil.device.arm import Arm
from adacd_hil.device.device_files import place_devices
from adacd_hil.records import FaultReason
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.e2e import E2eSender
from adacd_hil.wire.embedded_bus import EmbeddedBus

PERIOD_NS = 1_000_000
USUAL_NS = {"Drive1Feedback": 200_000, "Drive2Feedback": 300_000, "Sensor1Torque": 400_000, "Sensor2Torque": 480_000}
SPEED = 1.0  # rad/s
SETTLED = 110


class Devices:
    """Four devices that answer each SYNC at their usual time, and an arm that reads them cycle by cycle.

    The value that a device sends says on which SYNC it was sampled: torque and position are the cycle's number, in mNm
    and mrad.
    """

    def __init__(self, config: str = "paper") -> None:
        self.settings: Settings = load_settings(config)
        self.codec: Codec = loaded_contract(self.settings)
        clock = VirtualClock()
        self.arm = Arm(self.settings, self.codec, place_devices(self.settings), EmbeddedBus(clock))
        self.senders: dict[str, E2eSender] = {name: self.codec.message(name).sender() for name in USUAL_NS}
        self.waiting: list[tuple[int, Frame]] = []
        self.cycle = -1
        self.delay_ns: dict[str, int] = {}
        self.lost: set[str] = set()
        self.last: dict[str, bytes] = {}

    def frame(self, name: str, cycle: int, offset: float = 0.0) -> bytes:
        message = self.codec.message(name)
        values = []
        for signal in message.values:
            value = {"position": 1e-3 * cycle + offset, "velocity": SPEED, "torque": 1e-3 * cycle + offset}
            known = value.get(signal.name, 0.0)
            values.append(round((known - signal.offset) / signal.scale))
        return self.senders[name].protect(message.encode_raw(*values))

    def step(self):
        """Play a cycle as the exchange does: what is late first, SYNC, then what comes within 0.7 periods."""
        t_ns = (self.cycle + 1) * PERIOD_NS
        if self.cycle >= 0 and not self.arm.has_all_frames:
            self._take(t_ns, is_late=False)
        self.cycle += 1
        self.arm.synchronise(self.cycle, t_ns, 1)
        for name, usual_ns in USUAL_NS.items():
            data = self.last[name] = self.frame(name, self.cycle)
            if name not in self.lost:
                came_ns = t_ns + usual_ns + self.delay_ns.get(name, 0)
                self.waiting.append((came_ns, Frame(self.codec.message(name).can_id, data, came_ns)))
        self._take(t_ns + 700_000, sync_ns=t_ns)
        return self.arm.state()

    def _take(self, until_ns: int, is_late: bool = False, sync_ns: int = 0) -> None:
        self.waiting.sort()
        while self.waiting and self.waiting[0][0] < until_ns and not (sync_ns and self.arm.has_all_frames):
            came_ns, frame = self.waiting.pop(0)
            self.arm.accept(frame, is_late=bool(sync_ns) and came_ns < sync_ns)

    def settle(self) -> "Devices":
        for _ in range(SETTLED):
            assert self.step().is_complete
        return self


def sampled(state) -> tuple[float, ...]:
    """Return in which cycle each value was sampled, as it says itself."""
    return tuple(np.round(np.array((*state.q, *state.tau_J)) * 1e3).astype(int).tolist())


DELAYS_US = range(50, 1501, 50)


@pytest.mark.slow
@pytest.mark.parametrize("name", long_but(2, USUAL_NS))
@pytest.mark.parametrize("config", long_but(1, ["paper", "stock"]))
def test_a_sample_is_of_one_sync_and_its_age_is_true_however_late_a_frame_is(config: str, name: str) -> None:
    for delay_us in DELAYS_US:
        if config == "stock" and name.startswith("Sensor") and 950 <= delay_us <= 1050:
            continue  # a period late, no counter and no motion: nobody can tell that from a lost frame
        devices = Devices(config).settle()
        devices.delay_ns[name] = 1000 * delay_us
        for _ in range(40):
            state = devices.step()
            if state.is_complete:
                ages = {*state.age_q, *state.age_tau_J}
                assert {state.cycle - age for age in ages} == set(sampled(state)), delay_us
                assert state.sampled_ns == (state.cycle - ages.pop()) * PERIOD_NS, delay_us
        assert max(*state.age_q, *state.age_tau_J) <= 2, delay_us


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("name", USUAL_NS)
@pytest.mark.parametrize("config", ["paper", "stock"])
def test_frames_that_are_late_now_and_then_leave_a_sample_in_most_cycles(config: str, name: str) -> None:
    for delay_us in (600, 800, 1200):
        for share in (0.01, 0.1, 0.5, 0.9):
            devices = Devices(config).settle()
            chance = np.random.default_rng(3)
            unseen = longest = 0
            for _ in range(300):
                devices.delay_ns = {name: 1000 * delay_us} if chance.random() < share else {}
                state = devices.step()
                unseen = 0 if state.is_complete else unseen + 1
                longest = max(longest, unseen)
                assert state.fault is FaultReason.NONE, (delay_us, share)
            assert longest <= 4, (delay_us, share)


def test_a_lost_frame_costs_one_sample_and_the_next_one_says_so() -> None:
    devices = Devices().settle()
    devices.lost = {"Sensor1Torque"}
    assert not devices.step().is_complete
    devices.lost = set()
    state = devices.step()
    assert (state.is_complete, state.steps, state.age_tau_J) == (True, 2, (0, 0))


def test_frames_that_are_late_follow_each_other_without_a_gap() -> None:
    devices = Devices().settle()
    devices.delay_ns = {"Sensor1Torque": 550_000}
    assert not devices.step().is_complete
    states = [devices.step() for _ in range(10)]
    assert {(state.is_complete, state.steps, state.age_q) for state in states} == {(True, 1, (1, 1))}
    devices.delay_ns = {}
    assert (state := devices.step()).steps == 2
    assert state.age_q == (0, 0)


def test_an_extra_frame_with_other_content_is_named_and_a_second_one_is_a_fault() -> None:
    for config in ("paper", "stock"):
        devices = Devices(config).settle()
        faults = []
        for _ in range(2):
            devices.step()
            forged = devices.frame("Sensor1Torque", devices.cycle, offset=3.0)
            can_id = devices.codec.message("Sensor1Torque").can_id
            devices.arm.accept(Frame(can_id, forged, devices.cycle * PERIOD_NS + 600_000))
            faults.append(devices.arm.state().fault)
        assert faults == [FaultReason.NONE, FaultReason.FOREIGN_FRAMES]
        said = [event.message for event in devices.arm.strangers.take_events()]
        assert said == [
            "a second frame of sensor 1 (0x183) on one SYNC, with other content",
            "somebody else sends as sensor 1 (0x183)",
        ]


def test_the_same_frame_again_is_no_stranger_s() -> None:
    for config in ("paper", "stock"):
        devices = Devices(config).settle()
        for _ in range(5):
            state = devices.step()
            for name in USUAL_NS:
                can_id = devices.codec.message(name).can_id
                devices.arm.accept(Frame(can_id, devices.last[name], state.t_ns + 600_000))
        assert devices.arm.state().fault is FaultReason.NONE
        assert devices.arm.strangers.take_events() == []
