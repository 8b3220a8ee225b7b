"""Host and emulated arm in one process for tests of the tare: a hand that moves the arm, gravity, faults in frames."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from loaded import encoded
from rig import CODEC, Rig

from adacd_hil.device.device_files import place_devices
from adacd_hil.lab.commission.tare_session import TareSession
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from firmware_sim.scenario.scenario import Scenario, load_scenario

FEEDBACK_IDS, TORQUE_IDS = (0x181, 0x182), (0x183, 0x184)
WINDOW_S = 0.3
SETTLED_CYCLE = 200  # the first pose is measured from here on


def tare_settings(estimator: dict[str, Any] | None = None, arm: dict[str, Any] | None = None, **tare: Any) -> Settings:
    """Settings with a short window and what a test wants different."""
    settings = load_settings("paper")
    values = {"window_s": WINDOW_S, "settle_s": 0.05, "move_timeout_s": 3.0} | tare
    return dataclasses.replace(
        settings,
        tare=dataclasses.replace(settings.tare, **values),
        arm=dataclasses.replace(settings.arm, **(arm or {})),
        estimator=dataclasses.replace(settings.estimator, **(estimator or {})),
    )


class HandledRig(Rig):
    """An arm that somebody handles. Angles in rad, joint torques in Nm, all in device direction.

    `hand`: pose offset (2,) by cycle, added to what the encoders say. `push`: torque (2,) by cycle and pose, added to
    what the sensors say.
    """

    def __init__(self, settings: Settings | str = "paper", scenario: Scenario | None = None, **parts: Any) -> None:
        self.hand: Callable[[int], np.ndarray] = lambda cycle: np.zeros(2)
        self.push: Callable[[int, np.ndarray], np.ndarray] = lambda cycle, q: np.zeros(2)
        self._senders = [CODEC.message(f"Sensor{joint}Torque").sender() for joint in (1, 2)]
        played = scenario or load_scenario("idle", "P")
        self.start_rad = played.start_rad
        super().__init__(settings, played, **parts)

    def deliver(self, can_id: int, data: bytes) -> None:
        """Pass on what a device sends, as the hand and the push make it."""
        cycle = self.bench.cycle
        if can_id in FEEDBACK_IDS:
            data = self._moved(cycle, FEEDBACK_IDS.index(can_id), data)
        elif can_id in TORQUE_IDS:
            data = self._pushed(cycle, TORQUE_IDS.index(can_id), data)
        super().deliver(can_id, data)

    def _moved(self, cycle: int, joint: int, data: bytes) -> bytes:
        message = CODEC.message(f"Drive{joint + 1}Feedback")
        position, velocity = message.decode_values(data)
        here, before = self.hand(cycle)[joint], self.hand(cycle - 1)[joint]
        return bytes(encoded(message, position + here, velocity + (here - before) / self.settings.bus.period_s))

    def _pushed(self, cycle: int, joint: int, data: bytes) -> bytes:
        message = CODEC.message(f"Sensor{joint + 1}Torque")
        (torque,) = message.decode_values(data)
        frame = encoded(message, torque + self.push(cycle, self.start_rad + self.hand(cycle))[joint])
        frame[1] = data[1] & 0xF0
        return self._senders[joint].protect(frame)


class TareRig(HandledRig):
    """A tare session with the emulator."""

    def __init__(
        self,
        settings: Settings | None = None,
        is_auto_zeroing: bool = False,
        old_offset_Nm: tuple[float, float] = (0.0, 0.0),
        **scenario: Any,
    ) -> None:
        self.lines: list[str] = []
        self.on_line: Callable[[str], None] = lambda line: None
        super().__init__(settings or tare_settings(), dataclasses.replace(load_scenario("idle", "P"), **scenario))
        devices = place_devices(self.settings)
        parts = (self.settings, CODEC, devices, self.bus, self.clock, "embedded")
        self.session = TareSession(*parts, old_offset_Nm, is_auto_zeroing, self._progress)

    def _progress(self, line: str) -> None:
        self.lines.append(line)
        self.on_line(line)


class Hand:
    """A person who moves the arm to the next of some poses each time the host asks for one. Angles in deg."""

    def __init__(self, rig: TareRig, poses_deg: list[tuple[float, float]], speed_deg_s: float = 200.0) -> None:
        self._poses = [np.radians(np.array(pose)) - rig.start_rad for pose in poses_deg]
        self._cycles = 0
        self._since = 0
        self._speed_rad = np.radians(speed_deg_s) * rig.settings.bus.period_s
        self._from = self._to = np.zeros(2)
        self._rig = rig
        rig.on_line = self._hear
        rig.hand = self._place

    def _hear(self, line: str) -> None:
        if "by hand" in line:
            self._from, self._to = self._to, self._poses.pop(0)
            self._since = self._rig.bench.cycle + 20
            self._cycles = max(1, int(np.abs(self._to - self._from).max() / self._speed_rad))

    def _place(self, cycle: int) -> np.ndarray:
        share = np.clip((cycle - self._since) / self._cycles, 0.0, 1.0) if self._cycles else 1.0
        return self._from + share * (self._to - self._from)
