"""The verdict on a recording: whether there is a torque to explain, whether it is explained, which mistake it was."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from called import called
from foreign_arms import AXES, Motion, record, rigid_torque, urdf_text, write_recording
from joint_state_bags import State, write_mcap
from scipy.integrate import solve_ivp

from adacd_hil.lab.offline.column_checks import CORRECT_UNITS
from adacd_hil.lab.offline.recording_identification import Identified, identify
from adacd_hil.lab.offline.recording_import import read_recording
from adacd_hil.lab.offline.recording_map import read_map
from adacd_hil.lab.offline.recording_verdict import Verdict
from adacd_hil.lab.serial_arm.urdf import read_urdf

LEVEL, UPRIGHT = ("0 0 1",) * 7, ("0 1 0",) * 7
"""Axes of an arm that gravity doesn't reach, and of one that it does."""

pytestmark = pytest.mark.slow  # for the first fit, which compiles


@pytest.fixture(scope="module")
def upright() -> Motion:
    return record(urdf_text(2, UPRIGHT))


@pytest.fixture(scope="module")
def level() -> Motion:
    return record(urdf_text(2, LEVEL))


def judged(folder: Path, motion: Motion, axes=UPRIGHT, has_dq: bool = False, more: str = "", **urdf) -> Identified:
    text = urdf_text(motion.q.shape[1], axes, **urdf)
    recording, described = write_recording(folder, text, motion, has_dq, more)
    return identify(read_map(described), [read_recording(recording, read_map(described))], None)


def noise(shape, seed: int = 3) -> np.ndarray:
    return 0.02 * np.random.default_rng(seed).standard_normal(shape)


# What has to be explained, and is.


GOOD = {
    "one joint": (1, UPRIGHT, False, {}),
    "two upright ones": (2, UPRIGHT, False, {}),
    "much noise": (2, UPRIGHT, False, {"noise_Nm": 0.1}),
    "slow and small motion": (2, UPRIGHT, True, {"amplitude_rad": 0.25}),
    "1 kHz": (2, UPRIGHT, False, {"period_s": 1e-3}),
    "seven": (7, AXES, False, {}),
}


@pytest.mark.parametrize("kind", GOOD)
def test_a_good_recording_is_explained(tmp_path, kind):
    joints, axes, has_dq, options = GOOD[kind]
    found = judged(tmp_path, record(urdf_text(joints, axes), **options), axes, has_dq)
    assert found.verdict.is_explained, found.verdict
    assert found.verdict.headline == f"explained; margin {found.certificate.margin:.2f}"
    assert (found.verdict.reasons, found.verdict.remedy) == ((), "")
    assert not any("times" in remark or "drives" in remark or "stuck" in remark for remark in found.verdict.remarks)


def test_joints_are_explained_though_their_sensors_have_no_noise_and_the_margin_is_small(tmp_path):
    """Whatever a model lacks is more than no noise; 99 % of the torque is explained all the same."""
    motion = record(urdf_text(3, AXES), noise_Nm=0.0)
    stribeck = 0.3 * motion.truth["F_c"] * np.sign(motion.dq) * np.exp(-np.abs(motion.dq) / 0.1)
    found = judged(tmp_path, replace(motion, tau=motion.tau + stribeck), AXES, has_dq=True)
    assert found.verdict.is_explained
    assert found.certificate.margin < 1.0
    assert found.explained.min() > 0.99
    assert "of the torque at the worst joint; margin" in found.verdict.headline
    (remark,) = found.verdict.remarks
    assert "contacts show from about joint" in remark


def test_a_sensor_that_dies_is_stuck_and_not_clipped(tmp_path, upright):
    verdict = judged(tmp_path, dead_from_the_middle_on(upright)).verdict
    stuck = "the torque of joint1 (tau1) is stuck at 0 Nm for 4 s, from 8.005 s on, while the arm moves"
    assert verdict.reasons[0] == stuck
    assert "check the sensor" in verdict.remedy
    assert "clipped" not in " ".join([*verdict.reasons, *verdict.remarks])


def test_a_coarse_sensor_is_not_clipped_and_rare_rows_have_no_jump(tmp_path, upright):
    rare = record(urdf_text(2, UPRIGHT), 40.0, 0.05)
    for motion in (replace(upright, tau=upright.tau.round()), replace(rare, q=rare.q * [1.0, 1.9])):
        verdict = judged(tmp_path, motion).verdict
        assert not re.search("clipped|jumps", " ".join([*verdict.reasons, *verdict.remarks]))


# What can't be explained.


def still(motion: Motion, *joints: int) -> Motion:
    q = motion.q.copy()
    q[:, joints] = q[0, joints]
    return replace(motion, q=q)


def stuck(motion: Motion) -> Motion:
    tau = motion.tau.copy()
    tau[900:1100, 0] = tau[900, 0]
    return replace(motion, tau=tau)


def dead_from_the_middle_on(motion: Motion) -> Motion:
    """Stop a sensor at 0 Nm, the largest of its readings, within the motion that is not fitted."""
    tau = motion.tau.copy()
    tau[1600:, 0] = 0.0
    return replace(motion, tau=tau)


def clipped(motion: Motion) -> Motion:
    limit = np.quantile(np.abs(motion.tau[:, 0]), 0.7)
    return replace(motion, tau=np.clip(motion.tau, [-limit, -np.inf], [limit, np.inf]))


def bounded(motion: Motion) -> Motion:
    """Clip a torque before the sensor adds its noise, so that no two readings are equal."""
    cut = clipped(motion)
    return replace(cut, tau=cut.tau + noise(cut.tau.shape))


def spiked(motion: Motion) -> Motion:
    tau = motion.tau.copy()
    tau[[500, 501, 1400], 0] = [400.0, -400.0, 300.0]
    return replace(motion, tau=tau)


def two_sources(motion: Motion) -> Motion:
    tau = motion.tau.copy()
    tau[1::2] += 1.0
    return replace(motion, tau=tau)


def set_to_zero_anew(motion: Motion) -> Motion:
    q = motion.q.copy()
    q[1000:, 1] += 0.12
    return replace(motion, q=q)


def held(motion: Motion) -> Motion:
    q = motion.q.copy()
    q[850:1000, 1] = q[850, 1]
    return replace(motion, q=q)


def short(motion: Motion) -> Motion:
    return Motion(*(values[:300] for values in (motion.t, motion.q, motion.dq, motion.tau)))


def drift(motion: Motion) -> Motion:
    return replace(motion, tau=np.cumsum(noise(motion.tau.shape), axis=0))


def times(**factors: Any) -> Callable[[Motion], Motion]:
    """Scale columns of a recording."""
    return lambda motion: replace(motion, **{name: getattr(motion, name) * by for name, by in factors.items()})


UNEXPLAINED: dict[str, tuple[Callable[[Motion], Motion], str, str]] = {
    "a dead sensor": (
        lambda m: replace(m, tau=m.tau * [1.0, 0.0] + [0.0, 0.31]),
        "the torque of joint2 (tau2) is always 0.31 Nm",
        "`columns.tau_J`",
    ),
    "noise": (
        lambda m: replace(m, tau=noise(m.tau.shape)),
        "the torque of joint1 and joint2 is noise, unrelated to the motion",
        "`columns.tau_J` (tau1, tau2)",
    ),
    "a sensor that drifts": (
        drift,
        "the torque of joint1 and joint2 is unexplained: the sensor is dead",
        "columns.tau",
    ),
    "a stuck sensor": (stuck, r"the torque of joint1 \(tau1\) is stuck at .* for 0.99 s, from 4.5", "--from"),
    "a clipped sensor": (clipped, "the torque of joint1 (tau1) is clipped at -", "range"),
    "a dead encoder": (lambda m: still(m, 1), "the position of joint2 (q2) is always", "`columns.q`"),
    "a bound before the noise of the sensor": (
        bounded,
        r"joint1: .*% is explained, 99 % are needed.*of the time, as if clipped",
        "range of that sensor",
    ),
    "single samples that were read wrong": (
        spiked,
        "the torque of joint1 (tau1) jumps for single samples, 3 times, first to 400 Nm at 2.5 s",
        "empty these cells",
    ),
    "two sources in one column": (
        two_sources,
        "the torque of joint1 (tau1) goes to and fro from row to row",
        "one source",
    ),
    "an encoder that is set to zero anew": (
        set_to_zero_anew,
        r"the position of joint2 \(q2\) jumps by 0.1.* rad at 5 s: its zero has changed",
        "--from and --until",
    ),
    "an encoder that stands still for a while": (
        held,
        r"the position of joint2 \(q2\) jumps by .* rad at 5 s: it was stuck before",
        "check that encoder",
    ),
    "a torque that is late": (
        lambda m: replace(m, tau=np.column_stack([m.tau[:, 0], np.roll(m.tau[:, 1], 8)])),
        "the torque of joint2 is late, by about 40 ms",
        "shift what is late",
    ),
    "positions that are noise": (
        lambda m: replace(m, q=30.0 * noise(m.q.shape)),
        "the position of joint1 (q1) and joint2 (q2) is noise",
        "`columns.q`",
    ),
    "an encoder that is noise": (
        lambda m: replace(m, q=np.column_stack([m.q[:, 0], 30.0 * noise(len(m.q))])),
        "the position of joint2 (q2) is noise",
        "check that encoder",
    ),
    "an arm at rest": (lambda m: still(m, 0, 1), "the arm does not move", "motion of every joint"),
    "mNm at one joint": (
        times(tau=[1, 1e3]),
        "the torque of joint2 is 1000 times too large: so",
        "in the map: `scale.tau_J` = [1, 0.001]",
    ),
    "degrees at one joint": (
        times(q=[1, 57.29578]),
        "joint2 (q2) goes to",
        "if the positions are degrees: `scale.q` = [1, 0.0174533]",
    ),
    "too short": (short, "too short: 0.9 s fitted and 0.6 s tested", "record more"),
}


@pytest.mark.parametrize("kind", UNEXPLAINED)
def test_what_can_not_be_explained_is_named_with_the_next_thing_to_do(tmp_path, upright, kind):
    spoil, cause, remedy = UNEXPLAINED[kind]
    verdict = judged(tmp_path, spoil(upright)).verdict
    assert not verdict.is_explained
    assert verdict.headline.startswith("NOT explained")
    (reason,) = verdict.reasons
    assert re.search(cause if ".*" in cause else re.escape(cause), reason)
    assert remedy in verdict.remedy


def test_the_share_is_that_of_what_the_same_filter_leaves_of_the_torque(tmp_path, upright):
    """Noise that the filter takes away is no merit of the model's: of noise alone nothing is explained, at any rate."""
    for period_s in (5e-3, 1e-3):
        motion = record(urdf_text(2, UPRIGHT), period_s=period_s)
        found = judged(tmp_path, replace(motion, tau=noise(motion.tau.shape)))
        assert np.all(found.explained < 0.1)
        assert not found.verdict.is_explained
    half = replace(upright, tau=upright.tau + 1.5 * np.std(upright.tau, axis=0) * np.sin(40.0 * upright.t)[:, None])
    assert np.all(judged(tmp_path, half).explained > 0.95)  # 40 rad/s hardly pass 10 rad/s twice


def test_a_passive_joint_is_told_from_a_dead_sensor(tmp_path):
    """The forearm swings freely below a driven one: nothing but noise is at its sensor, as its motion says, too."""
    text = urdf_text(2, UPRIGHT)
    arm, t_s = read_urdf(text), 5e-3 * np.arange(1600)

    def slope(at_s: float, state: np.ndarray) -> np.ndarray:
        q, dq, tau = state[:2], state[2:], 6.0 * np.sin(1.3 * at_s) + 3.0 * np.sin(3.1 * at_s)
        rest, *columns = rigid_torque(arm, np.array([[q] * 3, [dq] * 3, [np.zeros(2), *np.eye(2)]]))
        M, friction = np.column_stack([column - rest for column in columns]), [0.4, 0.02] * dq
        return np.concatenate([dq, np.linalg.solve(M, [tau - 6.0 * q[0] - 2.0 * dq[0], 0.0] - rest - friction)])

    moved = solve_ivp(slope, (0.0, 8.0), [0.1, 1.3, 0.0, 0.0], t_eval=t_s, rtol=1e-6).y.T
    driven = 6.0 * np.sin(1.3 * t_s) + 3.0 * np.sin(3.1 * t_s) - 6.0 * moved[:, 0] - 2.0 * moved[:, 2]
    tau = np.column_stack([driven, np.zeros(len(t_s))]) + noise((len(t_s), 2))
    verdict = judged(tmp_path, Motion(t_s, moved[:, :2], moved[:, 2:], tau), has_dq=True).verdict
    assert verdict.joints[0].is_explained
    (reason,) = verdict.reasons
    assert reason.startswith("the torque of joint2 is noise, and by the model of the others it is tiny: a passive")


def test_a_wrong_model_says_how_far_it_is_off(tmp_path, upright):
    spring = replace(upright, tau=upright.tau + [0.0, 1.5] * np.sin(3.0 * upright.q))
    verdict = judged(tmp_path, spring).verdict
    assert any(reason.startswith("joint2: ") and "99 % are needed" in reason for reason in verdict.reasons)
    assert "--out" in verdict.remedy
    motors = judged(tmp_path, spring, more='[units]\ntau_J = "A"\n').verdict
    assert "`arm.has_rotors` = true" in motors.remedy


def test_friction_that_is_negative_is_said_with_both_terms(tmp_path, upright):
    compensated = replace(upright, tau=upright.tau - 2.0 * upright.truth["F_c"] * np.sign(upright.dq))
    verdict = judged(tmp_path, compensated, has_dq=True).verdict
    assert any(re.match("friction of joint1 is negative: F_v .*, F_c -0.5", remark) for remark in verdict.remarks)
    curved = replace(upright, tau=upright.tau - 0.5 * upright.truth["F_v"] * upright.dq * 3.0)
    verdict = judged(tmp_path, curved, has_dq=True).verdict
    assert any(remark.startswith("friction of joint1 is negative: F_v -0.1") for remark in verdict.remarks)


def test_an_inertia_that_no_masses_make_is_said(tmp_path, level):
    ddq = np.gradient(level.dq, level.t, axis=0)
    odd = replace(level, tau=level.tau - np.array([3.0, 0.0]) * ddq)
    verdict = judged(tmp_path, odd, LEVEL, has_dq=True).verdict
    assert any("the inertia about joint1 is negative, -" in reason and "kg m²" in reason for reason in verdict.reasons)


def test_motion_that_tells_nothing_of_a_parameter_is_too_little_excitation(tmp_path):
    text = urdf_text(2, UPRIGHT)
    motion = record(text)
    held = replace(motion, q=motion.q * [1.0, 0.0] + [0.0, 0.3], dq=motion.dq * [1.0, 0.0])
    arm = read_urdf(text)
    ddq = np.gradient(held.dq, held.t, axis=0)
    tau = rigid_torque(arm, np.array([held.q, held.dq, ddq])) + 0.3 * np.sign(held.dq) + noise(held.q.shape)
    verdict = judged(tmp_path, replace(held, tau=tau), has_dq=True).verdict
    assert any("too little excitation" in text for text in verdict.remarks)
    assert any("joint2 (q2) is always 0.3 rad" in text for text in (*verdict.remarks, *verdict.reasons))


def rests(motion: Motion, first: int, last: int, joints: list[int]) -> Motion:
    """Hold joints where they are at a row, until another one; the torque there is noise about what it is then."""
    q, tau = motion.q.copy(), motion.tau.copy()
    q[first:last, joints] = q[first, joints]
    tau[first:last, joints] = tau[first, joints] + noise((last - first, len(joints)))
    return replace(motion, q=q, tau=tau)


@pytest.mark.parametrize(
    ("part", "joints", "said"),
    [
        ((0, 1440), [0, 1], "the arm does not move in the part that is fitted"),
        ((1440, 2400), [0, 1], "the arm does not move in the part that is tested"),
        ((0, 1440), [1], "joint2 does not move in the part that is fitted"),
    ],
)
def test_an_arm_or_a_joint_that_rests_in_the_fit_or_in_the_test_is_said_to(tmp_path, upright, part, joints, said):
    verdict = judged(tmp_path, rests(upright, *part, joints)).verdict
    assert said in verdict.reasons
    if len(joints) == 2:
        assert len(verdict.reasons) == 1
        assert "--test" in verdict.remedy


# Common mistakes.

TURNED = np.array([1.0, -1.0])
SUMS = np.array([[1.0, 0.0], [1.0, 1.0]])
"""Columns that count from the base: q1, q1 + q2."""
DEGREE = math.pi / 180.0


def gravity_torque(motion: Motion, *gravity_m_s2: tuple[float, float, float]) -> np.ndarray:
    arm = read_urdf(urdf_text(2, UPRIGHT), *gravity_m_s2)
    return rigid_torque(arm, np.array([motion.q, 0.0 * motion.q, 0.0 * motion.q]))


def exchanged(*names: str) -> Callable[[Motion], Motion]:
    """Write columns of joint 2 for those of joint 1."""
    return lambda motion: replace(motion, **{name: getattr(motion, name)[:, ::-1] for name in names})


def summed(motion: Motion) -> Motion:
    """Count positions and velocities from the base."""
    return replace(motion, q=motion.q @ SUMS.T, dq=motion.dq @ SUMS.T)


MISTAKES: dict[str, tuple[Callable[[Motion], Motion] | str, str, str]] = {
    "mNm": (times(tau=1e3), "they are mNm", '`units.tau_J` = "mNm"'),
    "degrees": (times(q=1 / DEGREE, dq=1 / DEGREE), "the positions are degrees", '`units.q` = "deg"'),
    "a torque that is turned": (
        times(tau=TURNED),
        "the torque of joint2 has the other sign",
        "`scale.tau_J` = [1, -1]",
    ),
    "all torques turned": (times(tau=-1.0), "all torques have the other sign", "`scale.tau_J` = [-1, -1]"),
    "a position that is turned": (
        times(q=TURNED, dq=TURNED),
        "the position of joint2 counts the other way round",
        "`scale.q` = [1, -1]",
    ),
    "a joint that is turned": (
        times(q=TURNED, dq=TURNED, tau=TURNED),
        "joint2 counts the other way round, position and torque",
        "`scale.q` = [1, -1], `scale.tau_J` = [1, -1]",
    ),
    "torques exchanged": (exchanged("tau"), "the torques of joint1 and joint2 are exchanged", "`columns.tau_J`"),
    "positions exchanged": (exchanged("q", "dq"), "the positions of joint1 and joint2 are exchanged", "`columns.q`"),
    "joints exchanged": (
        exchanged("q", "dq", "tau"),
        "joint1 and joint2 are exchanged, positions and torques",
        "`columns.q`, `columns.tau_J`",
    ),
    "positions that count from the base": (
        summed,
        "the column of joint2 has the sum of joint1 and joint2:",
        "own positions",
    ),
    "coupled joints": (
        lambda m: replace(summed(m), tau=m.tau @ np.linalg.inv(SUMS)),
        "the column of joint2 has the sum of joint1 and joint2, and so do the torques:",
        "own positions",
    ),
    "torques without gravity": (
        lambda m: replace(m, tau=m.tau - gravity_torque(m)),
        "there is no gravity in the torques",
        "`arm.gravity_m_s2` = [0, 0, 0]",
    ),
    "an arm that is mounted on its side": (
        lambda m: replace(m, tau=m.tau - gravity_torque(m) + gravity_torque(m, (9.81, 0.0, 0.0))),
        "gravity acts along +x of the URDF's root:",
        "`arm.gravity_m_s2` = [9.80665, 0, 0]",
    ),
    "rotors": (
        lambda m: replace(m, tau=m.tau + np.array([0.9, 0.5]) * np.gradient(m.dq, m.t, axis=0)),
        "geared motors, which turn their rotors too",
        "`arm.has_rotors` = true",
    ),
    "mNm that are none": ('[units]\ntau_J = "mNm"\n', "they are Nm", '`units.tau_J` = "Nm"'),
    "degrees that are none": ('[units]\nq = "deg"\n', "the positions are radians", '`units.q` = "rad"'),
    "revolutions that are none": ('[units]\nq = "rev"\n', "the positions are radians", '`units.q` = "rad"'),
    "a torque that the map turns": (
        "[scale]\ntau_J = [1, -1]\n",
        "joint2 has the other sign",
        "`scale.tau_J` = [1, 1]",
    ),
}
"""What is wrong with the recording, or keys of the map that are; what is said, and the remedy."""


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_common_mistake_is_named_with_its_key(tmp_path, upright, mistake):
    spoil, said, remedy = MISTAKES[mistake]
    has_dq = list(MISTAKES).index(mistake) % 2 == 0
    if isinstance(spoil, str):
        verdict = judged(tmp_path, upright, has_dq=has_dq, more=spoil).verdict
    else:
        verdict = judged(tmp_path, spoil(upright), has_dq=has_dq).verdict
    assert not verdict.is_explained
    assert said in verdict.reasons[0]
    assert verdict.remedy.startswith("in the map: ")
    assert remedy in verdict.remedy


def test_factors_are_those_to_the_unit_of_the_map(tmp_path, upright):
    in_revolutions = {"more": '[units]\nq = "rev"\n'}
    mixed = times(q=[0.5 / math.pi, 1 / DEGREE])(upright)
    assert "`scale.q` = [1, 0.00277778]" in judged(tmp_path, mixed, **in_revolutions).verdict.remedy
    slow = record(urdf_text(1, LEVEL), amplitude_rad=0.2)
    assert '`units.q` = "rad"' in judged(tmp_path, slow, LEVEL, **in_revolutions).verdict.remedy


@pytest.mark.parametrize("mistake", ["torques exchanged", "positions exchanged", "joints exchanged"])
def test_exchanged_columns_leave_the_scale_to_the_joint(tmp_path, upright, mistake):
    spoil, said, remedy = MISTAKES[mistake]
    other = times(q=TURNED, dq=TURNED, tau=np.array([1.0, -2.0]))(upright)
    verdict = judged(tmp_path, spoil(other), more="[scale]\nq = [1.0, -1.0]\ntau_J = [1.0, -0.5]\n").verdict
    assert said in verdict.reasons[0]
    assert verdict.remedy == f"in the map: exchange them in {remedy}"


def test_torques_of_an_unknown_unit_are_not_said_to_be_what_the_map_has(tmp_path, upright):
    verdict = judged(tmp_path, times(tau=1e6)(upright), more='[units]\ntau_J = "mNm"\n', has_masses=False).verdict
    assert "reaches" in verdict.reasons[0]
    assert "mNm" not in verdict.remedy


def test_torques_in_the_columns_of_positions_are_no_jumps_and_no_degrees_where_the_map_has_degrees(tmp_path, upright):
    exchanged_both = replace(upright, q=1e3 * upright.tau, tau=upright.q)
    verdict = judged(tmp_path, exchanged_both, more='[units]\nq = "deg"\n').verdict
    assert "beyond the" in verdict.reasons[0]
    assert verdict.remedy == CORRECT_UNITS


def test_noise_of_two_levels_is_not_two_sources(tmp_path, upright):
    """By this seed just over half of the rows differ from the next one, and just under half from the one after it."""
    level = np.random.default_rng(9).integers(0, 2, len(upright.tau))
    flickering = replace(upright, tau=np.column_stack([upright.tau[:, 0], 0.1 * level]))
    reasons = judged(tmp_path, flickering).verdict.reasons
    assert not any("to and fro" in reason for reason in reasons)


def test_what_is_named_makes_the_recording_explained(tmp_path, upright):
    turned = replace(upright, q=upright.q * TURNED, dq=upright.dq * TURNED, tau=1e3 * upright.tau * TURNED)
    keys = '[units]\ntau_J = "mNm"\n[scale]\nq = [1, -1]\ntau_J = [1, -1]\n'
    assert not judged(tmp_path, turned).verdict.is_explained
    assert judged(tmp_path, turned, more=keys).verdict.is_explained


def test_three_positions_that_count_from_the_base_are_named_with_their_torques(tmp_path):
    motion = record(urdf_text(3, AXES))
    sums = np.tril(np.ones((3, 3)))
    coupled = replace(motion, q=motion.q @ sums.T, tau=motion.tau @ np.linalg.inv(sums))
    said = "each position counts from the base, not from the link before, and so do the torques"
    assert said in judged(tmp_path, coupled, AXES).verdict.reasons[0]


def test_which_joint_of_an_arm_without_gravity_is_turned_nobody_can_say(tmp_path, level):
    turned = replace(level, q=level.q * TURNED, tau=level.tau * TURNED)
    (reason,) = judged(tmp_path, turned, LEVEL).verdict.reasons
    assert "joint1 counts the other way round, position and torque, or joint2 counts" in reason or (
        "joint2 counts the other way round, position and torque, or joint1 counts" in reason
    )


def test_an_arm_without_masses_in_its_urdf_is_judged_by_its_effort_and_by_its_reach(tmp_path, upright):
    milli = replace(upright, tau=1e3 * upright.tau)
    (reason,) = judged(tmp_path, milli, has_masses=False).verdict.reasons
    assert "Nm, the URDF allows 60 Nm" in reason
    (reason,) = judged(tmp_path, milli, has_masses=False, effort=1e6).verdict.reasons
    assert "kg at the arm's reach" in reason
    assert judged(tmp_path, upright, has_masses=False).verdict.is_explained


def test_torques_of_a_third_of_what_the_masses_need_are_a_remark(tmp_path, upright):
    """As currents taken for torques, of motors with a few Nm/A behind their gears."""
    verdict = judged(tmp_path, replace(upright, tau=0.35 * upright.tau)).verdict
    assert any(remark.startswith("the torques are 0.3") and "a gain is wrong" in remark for remark in verdict.remarks)
    assert verdict.is_explained
    cogging = replace(upright, tau=0.35 * upright.tau * (1.0 + 0.04 * np.sin(9.0 * upright.q)))
    verdict = judged(tmp_path, cogging).verdict
    assert not verdict.is_explained
    assert any(remark.startswith("the torques are 0.4") for remark in verdict.remarks)


@pytest.mark.parametrize("joint", [0, 1])
def test_whichever_joint_has_no_torque_in_the_test_the_others_tell_the_unit(tmp_path, upright, joint):
    tau = 1e3 * upright.tau
    tau[1430:, joint] = 0.0
    assert "they are mNm" in judged(tmp_path, replace(upright, tau=tau)).verdict.reasons[0]


def test_masses_of_a_urdf_that_are_none_make_no_verdict(tmp_path, upright):
    """Some have a thousandth of a kilogram to please a simulator."""
    verdict = judged(tmp_path, upright, density=1e-3).verdict
    assert verdict.is_explained
    assert any("times those that the masses of the URDF need: a unit" in remark for remark in verdict.remarks)


VELOCITIES: dict[str, tuple[Callable[[Motion], Motion], str, str]] = {
    "deg/s": (times(dq=1 / DEGREE), "the velocity of joint1 (dq1) is 57.3 times", '`units.dq` = "deg/s"'),
    "another sign": (times(dq=TURNED), "the velocity of joint2 (dq2) has the other sign", "`columns.dq`"),
    "exchanged": (exchanged("dq"), "the velocity of joint1 (dq1) is in the column of joint2", "`columns.dq`"),
    "exchanged, of joints that move much alike": (
        lambda m: replace(m, dq=(m.dq @ [[1.0, 0.7], [0.0, 0.7]])[:, ::-1]),
        "the velocity of joint1 (dq1) is in the column of joint2",
        "`columns.dq`",
    ),
}


@pytest.mark.parametrize("kind", VELOCITIES)
def test_velocities_that_are_not_the_slope_of_the_positions_are_named(tmp_path, upright, kind):
    spoil, said, remedy = VELOCITIES[kind]
    verdict = judged(tmp_path, spoil(upright), has_dq=True).verdict
    assert not verdict.is_explained
    assert said in verdict.reasons[0]
    assert remedy in verdict.remedy


def test_a_position_that_stays_while_its_velocity_does_not_is_a_dead_encoder(tmp_path, level):
    verdict = judged(tmp_path, still(level, 1), LEVEL, has_dq=True).verdict
    assert "though by its velocity it turns: a dead encoder" in verdict.reasons[0]
    assert not verdict.is_explained


def test_a_threshold_that_is_wide_for_want_of_motion_explains_no_dead_encoder(tmp_path):
    """Its velocity has one sign in the fit, where friction looks like an offset, and the other in the test."""
    motion = record(urdf_text(2, LEVEL), seconds=9.0, amplitude_rad=np.array([0.7, 0.0]))
    dq = np.column_stack([motion.dq[:, 0], 1e-6 * np.sign(5.4 - motion.t)])
    dead = replace(motion, dq=dq, tau=motion.tau + 0.15 * np.sin(5.0 * motion.t)[:, None])
    verdict = judged(tmp_path, dead, LEVEL, has_dq=True).verdict
    assert all(joint.is_explained for joint in verdict.joints)
    assert min(joint.share for joint in verdict.joints) < 0.8
    assert "a dead encoder" in verdict.reasons[0]
    assert not verdict.is_explained


def test_noise_of_velocities_that_hides_contacts_is_a_remark(tmp_path, upright):
    noisy = replace(upright, dq=upright.dq + 1.0 * np.random.default_rng(5).standard_normal(upright.dq.shape))
    verdict = judged(tmp_path, noisy, has_dq=True).verdict
    assert any("noise of the velocities, 1 rad/s, hides contacts" in remark for remark in verdict.remarks)


def test_velocities_of_a_bag_are_measured_though_no_key_names_them(tmp_path, upright):
    write_recording(tmp_path, urdf_text(2, UPRIGHT), upright)
    (tmp_path / "map.toml").write_text('[arm]\nurdf = "arm.urdf"\n')
    described, names = read_map(tmp_path / "map.toml"), ("joint1", "joint2")

    def judged_bag(motion: Motion) -> Verdict:
        rows = zip(*(values.tolist() for values in (motion.t, motion.q, motion.dq, motion.tau)), strict=True)
        path = write_mcap(tmp_path / "r.mcap", [State(t, names, *values) for t, *values in rows])
        return identify(described, [read_recording(path, described)], None).verdict

    mixed = judged_bag(times(q=1 / DEGREE)(upright))
    assert mixed.reasons[0].startswith("the positions are degrees")
    turned = judged_bag(times(dq=TURNED)(upright))
    assert turned.reasons[0].startswith("the velocity of joint2 has the other sign")
    assert "of a bag `velocity` in its messages" in turned.remedy
    noisy = judged_bag(replace(upright, dq=upright.dq + noise(upright.dq.shape) / 0.02))
    assert any("noise of the velocities, 1 rad/s, hides contacts" in remark for remark in noisy.remarks)


def test_joints_at_rest_are_named_in_one_reason(tmp_path):
    motion = record(urdf_text(3, AXES))
    verdict = judged(tmp_path, still(motion, 0, 2), AXES).verdict
    (reason,) = verdict.reasons
    assert reason.startswith("the positions of joint1 (q1) and joint3 (q3) change by less than 0.01 rad: dead encoders")


# The command.


def test_the_command_says_verdict_rows_left_out_and_the_next_thing_to_do(tmp_path, upright):
    recording, described = write_recording(tmp_path, urdf_text(2, UPRIGHT), replace(upright, tau=upright.tau * TURNED))
    rows = recording.read_text().splitlines(keepends=True)
    recording.write_text("".join([*rows[:901], *rows[900:]]))
    arguments = ["identify", str(recording), "--map", str(described)]
    played = called(*arguments)
    assert played.exit_code == 3
    assert "s: NOT explained" in played.stdout
    assert "r.csv: 1 row with the time of the row before left out (row 902: 4.495 s once more)" in played.stdout
    assert "because the torque of joint2 has the other sign" in played.stdout
    assert "next: in the map: `scale.tau_J` = [1, -1]; then identify again" in played.stderr
    verdict = json.loads(called(*arguments, "--json").stdout)["test"]["verdict"]
    assert not verdict["is_explained"]
    assert verdict["next"] == "in the map: `scale.tau_J` = [1, -1]"


def test_json_of_a_recording_without_torque_is_json(tmp_path, upright):
    recording, described = write_recording(tmp_path, urdf_text(2, UPRIGHT), replace(upright, tau=0.0 * upright.tau))
    played = called("identify", recording, "--map", described, "--json")
    test = json.loads(played.stdout, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))["test"]
    assert (test["margin"], test["explained"]) == (None, {"joint1": None, "joint2": None})


def test_the_picture_of_the_test_has_the_thresholds_of_its_margin(tmp_path, upright):
    spring = replace(upright, tau=upright.tau + [0.0, 1.5] * np.sin(3.0 * upright.q))
    found = judged(tmp_path, spring)
    ratios = [
        threshold[1:] / np.abs(residual[1:])
        for residual, threshold in zip(found.test.tau_ext_hat, found.test.threshold, strict=True)
    ]
    assert np.concatenate(ratios).min() == pytest.approx(found.certificate.margin)
    assert found.test.contacts
