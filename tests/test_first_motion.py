"""The first motion says what the host was told wrongly of its arm: each mistake is noticed, named, with its place."""

import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from adacd_hil.api import LoadedRun, load
from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.control import first_motion
from adacd_hil.control.device_readings import READINGS, TorqueRatio, may_be_arm
from adacd_hil.control.first_motion import FirstMotion
from adacd_hil.records import ArmState, FaultReason, SchemeState
from adacd_hil.replay.replay import replay
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.run_settings import RequestSettings

pytestmark = pytest.mark.slow

ARM = """
extends = "certified"

[arm]
link_length_m = [0.4, 0.25]
rated_torque_Nm = [12.0, 12.0]
torque_limit_Nm = [12.0, 6.0]
cad_theta = [0.2875, 0.05, 0.0208333, 0.0, 0.0, 0.0, 0.0]

[devices]
drive_node = [11, 12]
sensor_node = [21, 22]
contract = ""

[controller]
Kp = [402.4, 21.97]
Kd = [20.12, 0.8239]
"""
BOTH_JUDGED_S = 4.0
"""By then both joints of the right arms below are known."""


def rehearse(folder: Path, truth: str = "", arm: str = ARM, lasts_s: float = BOTH_JUDGED_S) -> FaultReason:
    """Play the arm with what is true otherwise, TOML or the name of one of the package, to its end or a fault."""
    config = folder / "my-arm.toml"
    config.write_text(arm)
    name = truth or None
    if "=" in truth:
        name = str(folder / "truth.toml")
        Path(name).write_text(truth)
    cast = resolve(str(config), "paper", None, None, name)
    finish = (RequestSettings(at_s=lasts_s, request="finish"),)
    operator = dataclasses.replace(cast.settings.operator, script=finish, acknowledge_faults=0)
    settings = dataclasses.replace(cast.settings, operator=operator)
    summary, _ = run_embedded(cast._replace(settings=settings), "lockstep", folder / "run")
    assert summary.result is not None
    return summary.result.fault


def fault_line(folder: Path) -> str:
    [line] = [event.message for event in load(folder / "run").events if "-> FAULT" in event.message]
    return line


class Feed:
    """The recorded motion of a right arm, to be changed as a wrong statement would have it, and judged again."""

    def __init__(self, run: LoadedRun) -> None:
        self.state = run.state
        self.q, self.dq, self.tau_J, self.tau_c = (np.array(run[name]) for name in ("q", "dq", "tau_J", "tau_c"))

    def scale(self, factor: float, joint: int, *names: str) -> None:
        for name in names:
            getattr(self, name)[:, joint - 1] *= factor

    def judged(self) -> FirstMotion:
        """Return who has judged it."""
        judge = FirstMotion(load_settings("certified"), SimpleNamespace(drives=(), gear_ratios=(1.0, 1.0)))  # type: ignore[arg-type]
        before = SchemeState.INIT
        for row, state in enumerate(self.state.tolist()):
            values = {"q": self.q[row], "dq": self.dq[row], "tau_J": self.tau_J[row]}
            judge.add_cycle(BLANK._replace(**values), before, self.tau_c[row])
            before = SchemeState(state)
            if judge.line:
                break
        return judge


BLANK = ArmState(0, 0, 1, np.zeros(2), np.zeros(2), np.zeros(2), (0, 0), (0, 0), True, True, FaultReason.NONE, steps=1)


@pytest.fixture(scope="module")
def right_run(tmp_path_factory: pytest.TempPathFactory) -> LoadedRun:
    folder = tmp_path_factory.mktemp("right")
    assert rehearse(folder) is FaultReason.NONE
    return load(folder / "run")


@pytest.fixture
def feed(right_run: LoadedRun) -> Feed:
    return Feed(right_run)


def lines_of(run: LoadedRun, level: str) -> list[str]:
    return [event.message for event in run.events if event.name == "first motion" and event.level == level]


def test_a_right_arm_is_left_alone_and_what_its_sensors_measure_is_logged(right_run: LoadedRun, feed: Feed) -> None:
    assert [line[:7] for line in lines_of(right_run, "info")] == ["joint 1", "joint 2"]
    assert lines_of(right_run, "warning") == []
    assert feed.judged().line == ""


@pytest.mark.parametrize(
    ("is_limited", "periods"), [(False, (1,)), (True, (1,)), (False, (1, 1, 2))], ids=["still", "limited", "missing"]
)
def test_a_joint_that_is_not_known_in_time_is_named_and_judged_no_more(
    monkeypatch: pytest.MonkeyPatch, is_limited: bool, periods: tuple[int, ...]
) -> None:
    monkeypatch.setattr(first_motion, "_LONGEST_S", 0.4)
    drives = (SimpleNamespace(is_limited=is_limited),)
    judge = FirstMotion(load_settings("certified"), SimpleNamespace(drives=drives, gear_ratios=(1.0, 1.0)))  # type: ignore[arg-type]
    for k in range(399 * len(periods) // sum(periods)):
        judge.add_cycle(BLANK._replace(periods=periods[k % len(periods)]), SchemeState.ADAPT, np.zeros(2))
    assert (judge.is_on, judge.take_events()) == (True, [])
    for _ in range(2):
        judge.add_cycle(BLANK, SchemeState.ADAPT, np.zeros(2))
    events = judge.take_events()
    assert [(event.level, event.message[:7]) for event in events] == [("warning", "joint 1"), ("warning", "joint 2")]
    assert "is not known after 0.4 s, since it moves too little" in events[0].message
    assert (judge.is_on, judge.line) == (False, "")


def right_motion(seed: int, feed: Feed) -> None:
    """Overwrite a feed with 8 s of a right, rigid arm of two links on sines; every fourth moves one joint mostly."""
    rng, t_s = np.random.default_rng(seed), np.arange(8000) * 1e-3
    amplitude, frequency = rng.uniform(0.03, 0.6, 2), 2.0 * np.pi * rng.uniform(0.15, 1.5, 2)
    amplitude[1] *= 0.05 if seed % 4 == 0 else 1.0
    amplitude[0] *= 0.05 if seed % 4 == 1 else 1.0
    begun = np.clip(t_s, 0.0, 1.0)
    ramp = begun**3 * (10.0 - 15.0 * begun + 6.0 * begun**2)
    q = amplitude * np.sin(frequency * t_s[:, np.newaxis] + (0.0, 0.3)) * ramp[:, np.newaxis]
    q += rng.uniform(-0.5, 0.5, 2)
    dq = np.gradient(q, 1e-3, axis=0)
    (ddq_1, ddq_2), (dq_1, dq_2) = np.gradient(dq, 1e-3, axis=0).T, dq.T
    m2 = rng.uniform(0.5, 2.0)
    a3, a2 = m2 * 0.25**2 / 3.0, m2 * 0.4 * 0.25 / 2.0
    a1, cosine, sine = m2 * 0.4**2 * 1.6 + a3, a2 * np.cos(q[:, 1]), a2 * np.sin(q[:, 1])
    tau_1 = (a1 + 2.0 * cosine) * ddq_1 + (a3 + cosine) * ddq_2 - sine * (2.0 * dq_1 * dq_2 + dq_2**2)
    tau_2 = (a3 + cosine) * ddq_1 + a3 * ddq_2 + sine * dq_1**2
    viscous, coulomb = rng.uniform(0.0, 0.4, 2), rng.uniform(0.0, 0.3, 2) * (1.0, 0.3)
    tau = np.stack((tau_1, tau_2), axis=1) + viscous * dq + coulomb * np.sign(dq)
    noise = (0.0, 1e-4, 1e-3, 1e-2)[rng.integers(0, 4)]
    feed.q, feed.dq = q if noise == 0.0 else np.round(q, 5), dq + rng.normal(0.0, noise, q.shape)
    feed.tau_J = np.roll(tau, 2, axis=0) + rng.normal(0.0, noise, q.shape)
    feed.tau_c = tau + (0.2 * dq if seed % 3 == 0 else 0.0)  # friction before the sensor
    feed.state = np.full(len(q), int(SchemeState.ADAPT))
    feed.state[:4] = int(SchemeState.INIT)


@pytest.mark.parametrize("seed", [14, 213, 394, 1425])
def test_a_right_arm_whose_motion_tells_little_is_left_alone(feed: Feed, seed: int) -> None:
    """One joint hardly moves, nothing is noisy, so that any unknown explains the torque; or the velocity is noisy."""
    right_motion(seed, feed)
    assert feed.judged().line == ""


def test_a_joint_is_not_known_before_its_position_is_compared(feed: Feed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(first_motion, "_LEAST_WAY_RAD", 1.8)  # both torques are known before
    feed.scale(0.6, 2, "q")
    check(feed.judged().line, POSITION, 2, 0.6)


@pytest.mark.parametrize("joint", [1, 2])
def test_a_sensor_that_measures_nothing_is_not_taken_for_reversed(feed: Feed, joint: int) -> None:
    feed.tau_J[:, joint - 1] = 0.01
    line = feed.judged().line
    assert "not its joint's torque" in line
    assert f"devices.sensor_node[{joint - 1}]" in line


TORQUE = r"joint (\d): its torque sensor measures ([+-][\d.]+) times the commanded torque"
POSITION = r"joint (\d): its position moves ([+-][\d.]+) times as far as its velocity says"
GEAR = r"joint (\d)(?: wrong, it)? turns about ([+-]?[\d.]+) times as far"


def check(line: str, pattern: str, joint: int, value: float) -> None:
    found = re.search(pattern, line)
    assert found is not None, line
    assert int(found[1]) == joint
    assert float(found[2]) == pytest.approx(value, rel=0.1)


WRONG = [  # what is recorded otherwise, how many times as large, what is measured then, the cause's place
    (("tau_J",), 2.0, TORQUE, 2.0, "devices.sensor[{1}]"),
    (("tau_J",), 0.5, TORQUE, 0.5, "devices.sensor[{1}]"),
    (("tau_J",), -1.0, "either ", 0.0, "torque sensor of joint {0} reversed (devices.sensor_node[{1}])"),
    (("tau_c",), -1.0, TORQUE, -1.0, "reverse the motor of devices.drive_node[{1}]"),
    (("q",), 1.5, POSITION, 1.5, "devices.drive[{1}]"),
    (("q",), -1.0, POSITION, -1.0, "devices.drive[{1}]"),
    (("q", "dq"), 1.5, GEAR, 0.67, "devices.drive[{1}]"),
    (("q", "dq"), 0.5, GEAR, 2.0, "devices.drive[{1}]"),
    (("q", "dq"), -1.0, "either ", 0.0, "encoder of joint {0} reversed (devices.drive_node[{1}])"),
]
"""What can't be told from something else at first is one of two causes: a turned encoder from a turned sensor."""


@pytest.mark.parametrize("joint", [1, 2])
@pytest.mark.parametrize(("names", "factor", "pattern", "value", "place"), WRONG)
def test_a_wrong_scale_or_sign_is_named_with_what_is_measured_and_its_place(
    feed: Feed, joint: int, names: tuple[str, ...], factor: float, pattern: str, value: float, place: str
) -> None:
    feed.scale(factor, joint, *names)
    line = feed.judged().line
    if pattern == "either ":
        assert pattern in line
    else:
        check(line, pattern, joint, value)
        assert "either " not in line or pattern == GEAR
    assert place.format(joint, joint - 1) in line


ALL = ("q", "dq", "tau_c", "tau_J")
OTHERS = {  # what is exchanged or reversed: names, the joints' new order, their signs, what is said
    "sensors exchanged": (("tau_J",), (1, 0), (1.0, 1.0), "either torque sensors exchanged (devices.sensor_node)"),
    "drives exchanged": (ALL[:3], (1, 0), (1.0, 1.0), "either drives exchanged (devices.drive_node)"),
    "joints exchanged": (
        *(ALL, (1, 0), (1.0, 1.0)),
        "joints 1 and 2 are exchanged, drives and sensors: exchange devices.drive_node",
    ),
    "a joint reversed as a whole": (
        *(ALL, (0, 1), (1.0, -1.0)),
        "joint 2 turns the other way than arm.sign = [1, 1] says, if joint 1 is right: arm.sign = [1, -1], or "
        "[-1, 1] if it is joint 1",
    ),
    "both joints reversed, which is the arm's mirror image": (ALL, (0, 1), (-1.0, -1.0), ""),
    "sensors that both measure the reaction": (("tau_J",), (0, 1), (-1.0, -1.0), "both torque sensors"),
    "two mistakes at once": (("tau_J",), (1, 0), (-1.0, 1.0), "the drives or the sensors are exchanged"),
}


@pytest.mark.parametrize("kind", OTHERS)
def test_devices_at_each_other_s_joint_or_reversed_are_named_as_far_as_that_can_be_known(feed: Feed, kind: str) -> None:
    names, order, signs, said = OTHERS[kind]
    for name in names:
        setattr(feed, name, getattr(feed, name)[:, order] * signs)
    line = feed.judged().line
    assert said in line
    assert bool(line) == bool(said)


def test_a_reading_is_refuted_by_torques_only_as_far_as_they_are_known() -> None:
    reversed_sensor = next(reading for reading in READINGS if reading.kind == "sensor" and reading.joint == 1)
    measured = TorqueRatio(own=1.0, other=0.0, own_std=0.1, other_std=0.1)
    assert not reversed_sensor.allows((None, measured), 0.3)
    assert reversed_sensor.allows((None, measured._replace(own_std=0.4)), 0.3)
    assert reversed_sensor.allows((measured, None), 0.3)


def test_an_inertia_that_the_motion_leaves_open_refutes_nothing() -> None:
    theta = np.array([0.3, 0.05, -0.01, 0.0, 0.0, 0.0, 0.0])
    assert not may_be_arm(theta, np.full(7, 0.005))
    assert may_be_arm(theta, np.full(7, 0.03))


def test_a_torque_constant_that_is_off_by_a_fifth_is_a_warning(feed: Feed) -> None:
    feed.scale(1.2, 2, "tau_c")
    judge = feed.judged()
    assert judge.line == ""
    [warning] = [event.message for event in judge.take_events() if event.level == "warning"]
    assert warning.startswith("joint 2: its torque sensor measures 0.8")


def test_noise_of_an_arm_that_is_touched_is_no_mistake(feed: Feed) -> None:
    """The sensor is between motor and link: what pushes the link, the motor has to give, too."""
    push_Nm = np.sin(np.arange(len(feed.state))[:, np.newaxis] / 150.0) * (5.0, 3.0)
    feed.tau_J[2:] += push_Nm[:-2]
    feed.tau_c += push_Nm
    assert feed.judged().line == ""


def test_a_mistake_that_would_be_certified_stops_the_arm_first_and_replays_to_the_same(tmp_path: Path) -> None:
    assert rehearse(tmp_path, "wrong-torque-constant") is FaultReason.MISCONFIGURED
    assert load(tmp_path / "run").certificates == ()
    line = fault_line(tmp_path)
    check(line, TORQUE, 2, 0.5)
    assert "arm.rated_torque_Nm[1] = 12 Nm, scale.gear_ratio = 1 of devices.drive[1], and the motor's torque" in line
    replayed = replay(tmp_path / "run" / "run.mcap")
    assert replayed.compared > 0
    assert replayed.mismatch_count == 0
    assert replayed.states[-1].fault is FaultReason.MISCONFIGURED


RUN_AWAY = {
    "wrong-motor-sign": "perhaps motor of joint 2 reversed (devices.drive_node[1])",
    "swapped-joints": "perhaps a node, sign or scale of the devices is wrong",
}


@pytest.mark.parametrize("truth", RUN_AWAY)
def test_an_arm_that_runs_away_in_its_first_motion_is_told_what_is_likely(tmp_path: Path, truth: str) -> None:
    assert rehearse(tmp_path, truth) is FaultReason.LIMIT
    assert RUN_AWAY[truth] in fault_line(tmp_path)


UPRIGHT = (
    re.sub(r"cad_theta = .*", "cad_theta = []\nmass_kg = [2.0, 1.0]", ARM)
    + """
[estimator]
gravity = true

[certified]
prior_std = [1.0, 0.5, 0.5, 18.14, 0.3, 0.001, 0.2]

[trajectory]
amplitude_deg = [60.0, 60.0]
half_period_s = [2.606, 10.42]

[excitation]
period_s = 5.559

[safety]
rest_torque_Nm = 11.89
"""
)


def test_gravity_does_not_make_a_wrong_cause_certain(tmp_path: Path) -> None:
    cause = "torque sensor of joint 2 reversed"
    assert rehearse(tmp_path, "wrong-sensor-sign", UPRIGHT) is FaultReason.MISCONFIGURED
    line = fault_line(tmp_path)
    assert cause in line
    assert "either " in line or f"the {cause}" in line


def test_a_wrong_length_is_certified_with_a_warning_that_names_the_link(right_run: LoadedRun, tmp_path: Path) -> None:
    assert not [event for event in right_run.events if event.name == "geometry"]
    rehearse(tmp_path, "wrong-length", lasts_s=2.3)
    run = load(tmp_path / "run")
    assert len(run.certificates) == 1
    [event] = [event for event in run.events if event.name == "geometry"]
    assert event.level == "warning"
    assert re.search(r"as if link 1 were 0\.(49|50)\d m long; arm\.link_length_m\[0\] = 0\.4 m", event.message)


def test_rotors_friction_before_the_sensors_and_slow_drives_are_no_mistake(tmp_path: Path) -> None:
    truth = """
drives = { torque_constant_error = [0.1, -0.1], current_loop_Hz = [100.0, 100.0] }
mechanics = { rotor_inertia_kg_m2 = [0.3, 0.02], motor_coulomb_Nm = [0.4, 0.2], motor_viscous_Nm_s = [0.2, 0.1] }
"""
    assert rehearse(tmp_path, truth, lasts_s=2.1) is FaultReason.NONE
    assert len(lines_of(load(tmp_path / "run"), "info")) == 2
    assert lines_of(load(tmp_path / "run"), "warning") == []


def test_nothing_is_compared_where_the_user_says_so(tmp_path: Path) -> None:
    arm = ARM + "\n[safety]\nfirst_motion_error = 0.0\n"
    assert rehearse(tmp_path, "wrong-torque-constant", arm, lasts_s=1.0) is FaultReason.NONE
