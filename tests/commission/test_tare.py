"""The tare: what it refuses, what it finds, against the emulator in virtual time and on arrays made by hand."""

import dataclasses
import re

import numpy as np
import pytest
from tare_rig import CODEC, SETTLED_CYCLE, WINDOW_S, Hand, TareRig, tare_settings

from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.lab.commission.tare import Pose, TareRefusedError, measure_pose, solve_tare
from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.bus import Frame

OFFSET = (0.3, -0.2)
NINE = {"gravity": True, "P0": (8.0, 4.0, 4.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5)}
CAD = (0.18, 0.037, 0.019, 0.0, 0.0, 0.0, 0.0, 5.5, 1.4)
A4, A5 = 5.9, 1.6
SPREAD_POSES = [(-30.0, -60.0), (40.0, -60.0), (40.0, 50.0), (-50.0, 80.0)]


def gravity(q: np.ndarray) -> np.ndarray:
    """Torque at rest of an arm whose axes are horizontal, worked out by hand, Nm."""
    outer = A5 * np.cos(q[0] + q[1])
    return np.array([A4 * np.cos(q[0]) + outer, outer])


def window(count: int = 400, seed: int = 1) -> dict[str, np.ndarray]:
    """Samples of a still arm at (0.1, -0.2) rad with an offset and white noise."""
    noise = np.random.default_rng(seed).normal(0.0, 0.02, (count, 2))
    return {"q": np.tile([0.1, -0.2], (count, 1)), "dq": np.zeros((count, 2)), "tau_J": np.array(OFFSET) + noise}


def exact_pose(q_deg: tuple[float, float], torque: np.ndarray) -> Pose:
    tiny = np.full(2, 1e-3)
    return Pose(np.radians(np.array(q_deg)), torque, tiny, tiny, tiny, tiny, 100)


def gravity_poses(poses_deg: list[tuple[float, float]], offset: tuple[float, float] = OFFSET) -> list[Pose]:
    return [exact_pose(pose, gravity(np.radians(np.array(pose))) + offset) for pose in poses_deg]


def test_a_still_window_gives_its_mean_and_its_standard_error():
    pose = measure_pose(**window(), settings=tare_settings())
    np.testing.assert_allclose(pose.mean_Nm, OFFSET, atol=3 * 0.02 / 20)
    np.testing.assert_allclose(pose.standard_error_Nm, 0.02 / 20, rtol=0.6)
    np.testing.assert_allclose(pose.q, [0.1, -0.2])


def test_noise_that_is_slower_than_the_samples_makes_the_standard_error_larger():
    samples = window(4000)
    slow = np.repeat(np.random.default_rng(2).normal(0.0, 0.01, (10, 2)), 400, axis=0)
    samples["tau_J"] = samples["tau_J"] + slow
    pose = measure_pose(**samples, settings=tare_settings())
    assert pose.standard_error_Nm.min() > 3 * 0.02 / np.sqrt(4000)


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize(
    ("field", "rows", "change", "words"),
    [
        ("dq", slice(7, 8), -0.06, "|dq[{}]| = 0.06 rad/s exceeds safety.rest_velocity_rad_s = 0.05 rad/s"),
        ("dq", slice(7, 8), np.nan, "|dq[{}]| = nan rad/s exceeds"),
        ("q", slice(390, 400), 0.002, "q[{}] went through 0.115 deg"),
        ("tau_J", slice(0, 400, 2), 0.13, "standard deviation of tau_J[{}] = "),
        ("tau_J", slice(3, 4), 0.5, "peak-to-peak value of tau_J[{}] = "),
        ("tau_J", slice(200, 400), 0.025, "drift of tau_J from first to second half[{}] = "),
        ("tau_J", slice(7, 8), np.nan, "standard deviation of tau_J[{}] = nan Nm"),
    ],
)
def test_a_window_that_is_not_still_is_refused_with_value_and_bound(joint, field, rows, change, words):
    samples = window()
    samples[field][rows, joint] += change
    with pytest.raises(TareRefusedError) as refusal:
        measure_pose(**samples, settings=tare_settings())
    assert words.format(f"joint{joint + 1}") in str(refusal.value)


def test_a_window_within_every_bound_is_taken():
    for field, rows, change in (
        ("dq", slice(7, 8), 0.05),
        ("q", slice(390, 400), 0.0017),
        ("tau_J", slice(0, 400, 2), 0.09),
        ("tau_J", slice(3, 4), 0.4),
        ("tau_J", slice(200, 400), 0.012),
    ):
        samples = window()
        samples[field][rows] += change
        assert measure_pose(**samples, settings=tare_settings()).samples == 400


def test_a_handful_of_samples_is_no_window():
    with pytest.raises(TareRefusedError, match="19 complete samples in a pose are below 20"):
        measure_pose(**window(19), settings=tare_settings())


def test_with_vertical_axes_the_offset_is_the_mean_and_its_error_comes_from_the_spread():
    torques = np.array(OFFSET) + np.array([[0.02, 0.0], [-0.02, 0.0], [0.03, 0.0], [-0.03, 0.0]])
    poses = [exact_pose(q, torque) for q, torque in zip(SPREAD_POSES, torques, strict=True)]
    solution = solve_tare(poses, tare_settings())
    np.testing.assert_allclose(solution.offset_Nm, OFFSET, atol=1e-12)
    np.testing.assert_allclose(solution.spread_Nm, [0.06, 0.0], atol=1e-12)
    np.testing.assert_allclose(solution.standard_error_Nm, [np.std([2, -2, 3, -3], ddof=1) / 200, 5e-4], rtol=1e-9)


@pytest.mark.parametrize(
    ("torques", "words"),
    [
        ([(2.1, 0.0)], r"offset\[joint1\] = 2.1 Nm exceeds tare.offset_limit_Nm = 2 Nm; something pushes"),
        ([(0.0, -2.1)], r"offset\[joint2\] = -2.1 Nm exceeds tare.offset_limit_Nm = 2 Nm; something pushes"),
        ([(0.0, 0.1), (0.0, -0.01)], r"spread between poses of tau_J\[joint2\] = 0.11 Nm exceeds"),
    ],
)
def test_an_offset_or_a_spread_over_its_bound_is_refused(torques, words):
    with pytest.raises(TareRefusedError, match=words):
        solve_tare([exact_pose((20.0 * n, 0.0), np.array(each)) for n, each in enumerate(torques)], tare_settings())


def test_gravity_is_estimated_with_the_offsets():
    solution = solve_tare(gravity_poses(SPREAD_POSES), tare_settings(NINE, {"cad_theta": ()}))
    np.testing.assert_allclose(solution.gravity_Nm, [A4, A5], rtol=1e-9)
    np.testing.assert_allclose(solution.offset_Nm, OFFSET, atol=1e-9)
    assert 1.0 < solution.condition < 30.0


def test_noise_of_the_poses_spreads_into_the_offsets_as_their_error_says():
    settings = tare_settings(NINE, {"cad_theta": ()})
    generator = np.random.default_rng(3)
    found, claimed = [], []
    for _ in range(100):
        poses = [
            dataclasses.replace(pose, mean_Nm=pose.mean_Nm + generator.normal(0.0, 1e-3, 2))
            for pose in gravity_poses([*SPREAD_POSES, (70.0, 10.0), (-70.0, 100.0)])
        ]
        solution = solve_tare(poses, settings)
        found.append(solution.offset_Nm)
        claimed.append(solution.standard_error_Nm)
    scatter = np.std(found, axis=0)
    assert np.all(scatter < 1.2 * np.mean(claimed, axis=0))
    assert np.all(scatter > 0.6 * np.mean(claimed, axis=0))


def test_gravity_may_come_from_the_cad_model_in_a_single_pose():
    settings = tare_settings(NINE, {"cad_theta": (*CAD[:7], A4, A5)}, gravity_model="cad")
    solution = solve_tare(gravity_poses(SPREAD_POSES[:1]), settings)
    np.testing.assert_allclose(solution.offset_Nm, OFFSET, atol=1e-12)
    np.testing.assert_allclose(solution.gravity_Nm, [A4, A5])


def test_a_cad_model_that_is_wrong_shows_in_the_residuals():
    settings = tare_settings(NINE, {"cad_theta": CAD}, gravity_model="cad")
    with pytest.raises(TareRefusedError, match=r"residual of pose 1\[joint1\] = -?0.\d+ Nm exceeds tare.pose_limit_Nm"):
        solve_tare(gravity_poses([(0.0, 0.0), (80.0, 0.0), (80.0, 90.0)]), settings)


@pytest.mark.parametrize(
    ("poses_deg", "motion"),
    [
        ([(30.0, 60.0), (30.0, -20.0), (30.5, 5.0)], r"cos\(q1\) only goes from 0.86 to 0.87; move joint 1 further"),
        ([(0.0, 60.0), (40.0, 20.0), (60.0, 0.5)], r"cos\(q1 \+ q2\) only goes from 0.49 to 0.50; turn link 2 further"),
        ([(10.0, 20.0)] * 3, "condition number of 3 poses = "),
    ],
)
def test_poses_that_cant_tell_gravity_from_offsets_are_refused_with_the_motion_that_is_missing(poses_deg, motion):
    with pytest.raises(TareRefusedError, match=motion) as refusal:
        solve_tare(gravity_poses(poses_deg), tare_settings(NINE, {"cad_theta": ()}))
    assert "exceeds tare.condition_limit = 30" in str(refusal.value)


def test_poses_of_a_hanging_arm_are_judged_by_how_far_it_is_from_the_level():
    hanging = tare_settings(NINE, {"cad_theta": (), "mounting_deg": (90.0, 0.0)})
    poses = gravity_poses([(60.0, 60.0), (60.0, -20.0), (60.5, 5.0)])
    with pytest.raises(TareRefusedError, match=r"cos\(q1 - 90 deg\) only goes from 0.87 to 0.87; move joint 1 further"):
        solve_tare(poses, hanging)


def test_a_weight_that_a_flat_arm_has_not_is_named_with_the_mounting():
    with pytest.raises(TareRefusedError, match=r"offset\[joint1\] = .* the mounting is not flat"):
        solve_tare(gravity_poses([(10.0, 20.0)]), tare_settings())


def test_the_offset_is_in_joint_direction_and_the_configured_one_is_not_subtracted():
    settings = tare_settings(arm={"sign": (1, -1), "torque_offset_Nm": (0.25, 0.25)})
    tare = TareRig(settings, torque_offset_Nm=OFFSET, noise=False).session.run()
    np.testing.assert_allclose(tare.offset_Nm, [0.3, 0.2], atol=1e-3)
    assert tare.sign == (1, -1)
    assert tare.mounting_deg is None


@pytest.mark.slow
def test_drives_stay_disabled_and_without_torque_on_the_wire():
    rig = TareRig(tare_settings(poses=2))
    Hand(rig, [(-10.0, -60.0)])
    rig.session.run()
    commands = [CODEC.by_id[can_id].decode_values(data) for can_id, data, *_ in rig.sent if can_id in (0x201, 0x202)]
    assert len(commands) > 1000
    assert set(commands) == {(0.0, 0.0)}
    assert rig.sent[-1][:2] == (0x000, bytes((0x80, 0)))
    assert not any(drive.is_enabled for drive in rig.bench.drives)


def test_the_sensors_offsets_are_found_and_stored_with_where_they_came_from():
    rig = TareRig(torque_offset_Nm=OFFSET, old_offset_Nm=(0.1, 0.0))
    for sensor, temperature in zip(rig.bench.devices[2:], (2345, -150), strict=True):
        sensor.serve(0x2111, 0, lambda value=temperature: value)
    tare = rig.session.run()
    errors = np.array(tare.standard_error_Nm)
    assert np.all(np.abs(np.subtract(tare.offset_Nm, OFFSET)) < 3 * errors)
    assert np.all(errors < 0.005)
    assert tare.samples == round(WINDOW_S * 1000)
    assert (tare.sensor1.temperature_C, tare.sensor2.temperature_C) == (23.45, -1.5)
    named = [(sensor.name, sensor.node_id, sensor.vendor) for sensor in tare.sensors]
    assert named == [("Sensor1", 3, 0x41444143), ("Sensor2", 4, 0x41444143)]
    assert (tare.old_offset_Nm, tare.interface, tare.config) == ((0.1, 0.0), "embedded", "paper")
    assert tare.layout_digest == f"0x{CODEC.layout_digest:08X}"
    np.testing.assert_allclose(np.degrees(tare.poses[0].q_rad), [-30.0, -60.0], atol=1e-3)


def refusal_of(rig: TareRig) -> str:
    with pytest.raises(TareRefusedError) as refusal:
        rig.session.run()
    return str(refusal.value)


@pytest.mark.parametrize("joint", [0, 1])
def test_a_moving_arm_is_refused(joint):
    rig = TareRig()
    rig.hand = lambda cycle: np.eye(2)[joint] * 1e-4 * max(0, cycle - SETTLED_CYCLE - 100)
    assert f"the arm moves: |dq[joint{joint + 1}]| = 0.1 rad/s exceeds" in refusal_of(rig)


@pytest.mark.parametrize(
    ("offset", "status", "flags"),
    [
        ((50.1, 0.0), "Sensor1", "NOT_VALID, POSITIVE_OVERLOAD (0x6150 = 3)"),
        ((0.0, -50.1), "Sensor2", "NOT_VALID, NEGATIVE_OVERLOAD (0x6150 = 5)"),
    ],
)
def test_a_saturated_sensor_is_refused(offset, status, flags):
    refusal = refusal_of(TareRig(torque_offset_Nm=offset))
    assert refusal == f"{status} reports {flags}"


def test_boot_ups_from_before_the_reset_are_not_taken_for_answers():
    rig = TareRig()
    for node_id in (1, 2, 3, 4):
        rig.bus.deliver(0x700 + node_id, b"\x00")
    rig.bus.attach(lambda frame: None)
    with pytest.raises(DeviceError, match=r"no boot-up from Drive1 \(node 1\), Drive2"):
        rig.session.run()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("is_lost", "refusal"),
    [
        (lambda cycle, can_id: can_id == 0x184, "data are missing from Sensor2: no 0.2 s of complete cycles within"),
        (
            lambda cycle, can_id: can_id == 0x181 and cycle > SETTLED_CYCLE + 20,
            "Drive1 has sent nothing usable for 4 cycles, bus.max_age_cycles = 3",
        ),
        (
            lambda cycle, can_id: can_id == 0x183 and cycle > 200 and cycle % 40 == 0,
            "of the cycles lacked frames or had wrong ones, more than tare.missing_limit = 1.0%",
        ),
        (lambda cycle, can_id: can_id == 0x183 and cycle > 200 and cycle % 160 == 0, ""),
    ],
    ids=["never", "falls silent", "too many lost", "a few lost"],
)
def test_a_device_that_is_not_heard_is_refused_unless_few_frames_are_lost(is_lost, refusal):
    rig = TareRig()
    rig.tamper = lambda cycle, can_id, data: None if is_lost(cycle, can_id) else data
    if refusal:
        assert refusal in refusal_of(rig)
    else:
        assert rig.session.run().samples in (298, 299)


def test_a_frame_with_a_wrong_crc_is_no_sample():
    rig = TareRig(torque_offset_Nm=OFFSET, noise=False)

    def corrupt(cycle: int, can_id: int, data: bytes) -> bytes:
        return bytes((*data[:5], data[5] ^ 0x40)) if can_id == 0x183 and cycle == SETTLED_CYCLE + 50 else data

    rig.tamper = corrupt
    tare = rig.session.run()
    assert (tare.samples, tare.poses[0].peak_to_peak_Nm[0]) == (299, 0.0)


@pytest.mark.slow
def test_poses_are_taken_as_a_hand_moves_the_arm_and_friction_shows_as_spread():
    rig = TareRig(tare_settings(poses=3), torque_offset_Nm=OFFSET)
    friction = {-30: 0.0, -10: 0.04, 20: -0.02}
    rig.push = lambda cycle, q: np.array([friction.get(round(np.degrees(q[0])), 0.0), 0.0])
    Hand(rig, [(-10.0, -60.0), (20.0, -20.0)])
    tare = rig.session.run()
    np.testing.assert_allclose(
        np.degrees([pose.q_rad for pose in tare.poses]), [(-30, -60), (-10, -60), (20, -20)], atol=0.01
    )
    assert tare.spread_Nm[0] == pytest.approx(0.06, abs=0.006)
    errors = np.array(tare.standard_error_Nm)
    assert np.all(np.abs(np.subtract(tare.offset_Nm, OFFSET)) < 3 * errors)
    assert errors[0] > 4 * errors[1]
    assert [line for line in rig.lines if "by hand by more than 10 deg" in line] == [
        f"pose {n} of 3: move a joint by hand by more than 10 deg, then let go" for n in (2, 3)
    ]


@pytest.mark.slow
def test_a_pose_that_moves_again_while_it_is_measured_is_measured_anew():
    rig = TareRig(tare_settings(poses=2))
    Hand(rig, [(-10.0, -60.0)])
    steady = rig.hand
    cycle_of_nudge = SETTLED_CYCLE + 300 + 20 + 100 + 150  # first pose, reaction, way, half of the second pose

    def nudged(cycle: int) -> np.ndarray:
        return steady(cycle) + np.array([1e-4, 0.0]) * np.clip(cycle - cycle_of_nudge, 0, 50)

    rig.hand = nudged
    tare = rig.session.run()
    assert any("pose 2 of 2: the arm moves" in line and line.endswith("let go of it") for line in rig.lines)
    assert len(tare.poses) == 2


@pytest.mark.parametrize(
    ("rad_per_cycle", "missing"), [(0.0, "been moved by more than tare.move_deg = 10 deg"), (2e-4, "come to rest")]
)
def test_an_arm_that_is_not_brought_to_the_next_pose_is_refused_after_the_timeout(rad_per_cycle, missing):
    rig = TareRig(tare_settings(poses=2, move_timeout_s=1.0))
    rig.hand = lambda cycle: np.array([rad_per_cycle, 0.0]) * max(0, cycle - 550)
    assert refusal_of(rig) == f"the arm has not {missing} within tare.move_timeout_s = 1 s for pose 2"


@pytest.mark.slow
def test_an_arm_under_gravity_is_tared_from_several_poses():
    rig = TareRig(tare_settings(NINE, {"cad_theta": ()}, poses=5), torque_offset_Nm=OFFSET)
    rig.push = lambda cycle, q: gravity(q)
    Hand(rig, [*SPREAD_POSES[1:], (70.0, 10.0)])
    tare = rig.session.run()
    assert np.all(np.abs(np.subtract(tare.offset_Nm, OFFSET)) < 3 * np.array(tare.standard_error_Nm))
    np.testing.assert_allclose(tare.gravity_Nm, [A4, A5], atol=0.02)
    assert tare.gravity_model == "estimated"


def test_a_plan_that_cant_work_is_refused_before_anything_is_sent():
    with pytest.raises(ConfigError, match=r"`tare.poses` = 2 is below 3"):
        TareRig(tare_settings(NINE, {"cad_theta": ()}, poses=2))
    with pytest.raises(ConfigError, match=r"needs `arm.cad_theta`"):
        TareRig(tare_settings(NINE, {"cad_theta": ()}, gravity_model="cad"))
    with pytest.raises(ConfigError, match="--auto-zero needs vertical joint axes"):
        TareRig(tare_settings(NINE, {"cad_theta": CAD}, gravity_model="cad"), is_auto_zeroing=True)


def test_an_interrupt_ends_the_tare_and_stops_the_devices():
    rig = TareRig()
    rig.on_line = lambda line: rig.session.interrupt() if "measuring" in line else None
    with pytest.raises(KeyboardInterrupt):
        rig.session.run()
    assert rig.sent[-1][:2] == (0x000, bytes((0x80, 0)))


def test_auto_zero_leaves_little_and_the_host_takes_the_rest():
    rig = TareRig(is_auto_zeroing=True, torque_offset_Nm=OFFSET)
    tare = rig.session.run()
    assert np.abs(tare.offset_Nm).max() < 0.015
    assert tare.is_auto_zeroed
    (line,) = [line for line in rig.lines if line.startswith("sensors zeroed: ")]
    assert re.match(r"sensors zeroed: \+0\.(29|30)\d\d, -0\.(19|20)\d\d Nm before, [+-]0\.0", line)


def answer_auto_zero(rig: TareRig, joint: int, answer: str) -> None:
    """Let one sensor answer the request for its own zero with these bytes, and do nothing."""
    request = CODEC.message(f"Sensor{joint}SdoRequest").can_id
    on_frame = rig.bench.on_frame

    def take(frame: Frame) -> None:
        if frame.can_id == request and frame.data[1:3] == b"\x25\x61":
            rig.bus.deliver(request - 0x80, bytes.fromhex(answer))
        else:
            on_frame(frame)

    rig.bus.attach(take)


def test_a_sensor_that_takes_the_zero_and_does_not_apply_it_is_refused():
    rig = TareRig(is_auto_zeroing=True, torque_offset_Nm=OFFSET)
    answer_auto_zero(rig, 2, "6025610100000000")
    refusal = refusal_of(rig)
    assert re.match(r"tau_J\[joint2\] = -0\.(19|20)", refusal)
    assert refusal.endswith("Nm after the sensor's own zero exceeds tare.auto_zero_limit_Nm = 0.02 Nm")


def test_a_pushed_arm_is_not_zeroed():
    rig = TareRig(is_auto_zeroing=True)
    rig.push = lambda cycle, q: np.array([-3.0, 0.0])
    assert "something pushes on the arm" in refusal_of(rig)
    assert [data for can_id, data, *_ in rig.sent if can_id == 0x603 and data[1:3] == b"\x25\x61"] == []


def test_a_sensor_without_its_own_zero_says_so():
    rig = TareRig(is_auto_zeroing=True)
    answer_auto_zero(rig, 1, "8025610100000206")
    with pytest.raises(DeviceError, match=r"Sensor1 \(node 3\): auto-zero refused: .*Object does not exist"):
        rig.session.run()
