"""Recordings of arms that others made: read by a map, identified, tested and searched for contacts."""

import json
from pathlib import Path

import numpy as np
import pytest
from called import called
from numpy.testing import assert_allclose
from scheme.smooth_motion import smooth_motion, torque_of

from adacd_hil.lab.offline import recorded_columns
from adacd_hil.lab.offline.recording_identification import identify
from adacd_hil.lab.offline.recording_import import read_recording
from adacd_hil.lab.offline.recording_map import read_map
from adacd_hil.lab.serial_arm.offline import model_of
from adacd_hil.log.log_files import LogError
from adacd_hil.log.time_window import WHOLE, TimeWindow
from adacd_hil.settings.schema import ConfigError

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "foreign"
THETA = np.array([0.19205, 0.034125, 0.020175, 0.03, 0.015, 0.0375, 0.02])
LENGTH_M = 0.35
PERIOD_S = 2e-3
NOISE_NM = 0.005
TOUCH_S = (6.0, 6.3)
TOUCH_NM = np.array([0.5, 0.25])


def table(seconds: float, start_s: float = 0.0, touch=None):
    """Return time ms, q deg, tau mNm, touched, elbow turned, as the example's map wants it."""
    time_s = start_s + PERIOD_S * np.arange(round(seconds / PERIOD_S))
    q, dq, ddq = smooth_motion(time_s)
    tau_J = torque_of(q, dq, ddq, THETA)
    tau_J += NOISE_NM * np.random.default_rng(7).standard_normal(tau_J.shape)
    touched = np.zeros(len(time_s))
    if touch:
        touched[(time_s >= touch[0]) & (time_s < touch[1])] = 1.0
        tau_J -= touched[:, None] * TOUCH_NM
    turned = np.array([1.0, -1.0])
    return np.column_stack([time_s * 1e3, np.degrees(q) * turned, tau_J * 1e3 * turned, touched])


HEAD = "time_ms,j1_deg,j2_deg,j1_mNm,j2_mNm,touched"


def write(path: Path, rows) -> Path:
    np.savetxt(path, rows, delimiter=",", header=HEAD, comments="", fmt="%.6f")
    return path


@pytest.fixture(scope="module")
def free(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("free") / "free.csv", table(10.0))


@pytest.fixture(scope="module")
def touched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("touched") / "touched.csv", table(3.0, 4.5, TOUCH_S))


@pytest.fixture(scope="module")
def example():
    return read_map(EXAMPLE / "map.toml")


def copy_example(folder: Path, change=("", ""), urdf=("", "")) -> Path:
    """Copy the example's map and URDF, with a text of each replaced, and return the map."""
    for name, (old, new) in (("map.toml", change), ("planar-arm.urdf", urdf)):
        text = (EXAMPLE / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))
    return folder / "map.toml"


def test_units_and_signs_are_those_of_the_map_period_and_noise_the_recordings(free, example):
    recording = read_recording(free, example)
    assert (recording.period_s, recording.duration_s) == pytest.approx((PERIOD_S, 10.0))
    assert_allclose(recording.noise_Nm, NOISE_NM, rtol=0.1)
    (stretch,) = recording.stretches
    q, dq, ddq = smooth_motion(PERIOD_S * np.arange(len(stretch.record.q)))
    assert_allclose(stretch.record.q, q, atol=1e-7)
    assert_allclose(stretch.record.dq[20:-20], dq[20:-20], atol=2e-3)
    assert_allclose(stretch.record.tau_J[:200], torque_of(q[:200], dq[:200], ddq[:200], THETA), atol=6 * NOISE_NM)


@pytest.mark.long
def test_parameters_torque_and_touches_are_found(free, touched, example):
    found = identify(example, [read_recording(free, example)], None, [read_recording(touched, example)])
    estimates = dict(zip(found.model.parameter_names, found.estimate.theta, strict=True))
    assert estimates["Izz_1"] == pytest.approx(THETA[0] - THETA[2], rel=0.01)
    assert estimates["mx_2"] == pytest.approx(THETA[1] / LENGTH_M, rel=0.02)
    assert estimates["Izz_2"] == pytest.approx(THETA[2], rel=0.03)
    assert [estimates["F_v1"], estimates["F_v2"]] == pytest.approx(THETA[3:5], abs=0.004)
    assert [estimates["F_c1"], estimates["F_c2"]] == pytest.approx(THETA[5:7], abs=0.004)
    assert found.explained.min() > 0.98
    assert found.fit_s == pytest.approx(6.0)
    (watched,) = found.watched
    (contact,) = watched.contacts
    assert (watched.touches, watched.missed, watched.false_contacts) == (1, 0, 0)
    assert (contact.link, contact.direction, contact.is_true) == (2, (1, 1), True)
    assert contact.start_s == pytest.approx(TOUCH_S[0] - 4.5, abs=0.02)


@pytest.mark.parametrize("spoiled", [0.0, 500.0])
def test_contacts_in_a_recording_whose_torque_is_dead_or_noise_are_not_judged(free, tmp_path, spoiled):
    rows = table(3.0, 4.5)
    rows[:, 3] = spoiled * np.random.default_rng(1).standard_normal(len(rows))
    watched = write(tmp_path / "spoiled.csv", rows)
    done = called("identify", free, "--map", EXAMPLE / "map.toml", "--watch", watched, "--json")
    (found,) = json.loads(done.stdout)["watched"]
    assert (done.exit_code, len(found["faults"])) == (3, 1)


def test_what_is_touched_is_not_learnt(touched, example):
    recording = read_recording(touched, example)
    before, after = recording.free.stretches
    begin_s, end_s = (at_s - 4.5 for at_s in TOUCH_S)
    free_s = before.start_s + len(before.record.q) * PERIOD_S, after.start_s
    assert free_s == pytest.approx((begin_s - recording.blur_s, end_s + recording.blur_s), abs=2 * PERIOD_S)


def test_a_gap_and_a_missing_value_part_a_recording(tmp_path, example):
    rows = table(2.0)
    rows[500:540, 3] = np.nan  # 80 ms
    recording = read_recording(write(tmp_path / "gap.csv", np.delete(rows, slice(200, 240), axis=0)), example)
    assert [round(stretch.start_s, 3) for stretch in recording.stretches] == [0.0, 0.48, 1.08]
    assert [len(stretch.record.q) for stretch in recording.stretches] == [200, 260, 460]


def test_a_test_in_two_stretches_is_judged_by_the_worse(free, tmp_path, example):
    rows = table(4.0)
    rows[1200:, 3:5] *= 1.5
    tested = read_recording(write(tmp_path / "two.csv", np.delete(rows, slice(1100, 1200), axis=0)), example)
    whole, first = (
        identify(example, [read_recording(free, example)], part).certificate for part in (tested, tested.between(0, 2))
    )
    assert len(tested.stretches) == 2
    assert first.margin > 1.0 > whole.margin
    assert (whole.residual_max_Nm > 3.0 * first.residual_max_Nm).all()


def test_rotors_are_parameters_only_of_motors(tmp_path, example):
    described = read_map(copy_example(tmp_path, ("[columns]", "has_rotors = true\n\n[columns]")))
    rows = table(6.0)
    acceleration = smooth_motion(rows[:, 0] * 1e-3)[2] * np.array([0.0, -0.05])
    rows[:, 3:5] += acceleration * 1e3
    found = identify(described, [read_recording(write(tmp_path / "geared.csv", rows), described)], None)
    names = found.model.parameter_names
    assert names[-2:] == ("rotor1", "rotor2")
    assert found.estimate.theta[names.index("rotor2")] == pytest.approx(0.05, abs=0.005)
    assert not any(name.startswith("rotor") for name in model_of(example.urdf.chain).parameter_names)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('time = "time_ms"', 'time = "tme_ms"', "has no column 'tme_ms'; did you mean 'time_ms'?"),
        ('q = "deg"', 'q = "degree"', "did you mean 'deg'?"),
        ('["j1_mNm", "j2_mNm"]', '["j1_mNm"]', "`columns.tau_J` has 1 values; the arm has 2 moving joints"),
        ("[scheme]", "[schemes]", "unknown section `schemes`"),
        ("[scheme]", "[scheme]\nperiod_s = 0.01", "`scheme.period_s` is no setting: the recording's own period"),
        ("planar-arm.urdf", "none.urdf", "none.urdf: No such file"),
    ],
)
def test_a_wrong_map_is_one_line(tmp_path, free, old, new, line):
    described = copy_example(tmp_path, (old, new))
    with pytest.raises(ConfigError) as refusal:
        read_recording(free, read_map(described))
    assert line in str(refusal.value)
    assert "\n" not in str(refusal.value)


def rows(joints: str, count: int = 60) -> str:
    return "".join(f"{k},{joints},4,5,0\n" for k in range(1, count + 1))


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (HEAD + "\n", "has 0 rows"),
        (
            HEAD + "\n" + "1,2,3,4,5,0\n" * 60,
            "has 1 row, 50 are the least; 59 rows with the time of the row before left out (row 3: 0 s once more)",
        ),
        (
            HEAD + "\n" + "".join(f"{k},{k},3,4,5,0\n{k},{k + 20},3,4,5,0\n" for k in range(60)),
            "row 3: 0 s once more; 60 rows with the time of the row before have other values, column 'j1_deg' by 20",
        ),
        (HEAD + "\n" + rows("1e300,3"), "column 'j1_deg' is 1e+300 at 0 s, more than 1e+06 rad"),
        (HEAD + "\n" + rows("1,3") + "100,1,-2e12,4,5,0\n", "column 'j2_deg' is -2e+12 at 0.099 s"),
        (HEAD + "\n" + rows("inf,3"), "0 rows with all values, 50 needed"),
    ],
)
def test_a_wrong_recording_is_one_line(tmp_path, example, text, line):
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises((LogError, ConfigError)) as refusal:
        read_recording(tmp_path / "bad.csv", example)
    assert line in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_row_is_counted_over_all_blocks_that_are_read(tmp_path, example, monkeypatch):
    monkeypatch.setattr(recorded_columns, "BLOCK_ROWS", 25)
    for text, note in (
        ("60,1,3,4,5,0\n", "1 row with the time of the row before left out (row 62: 0.059 s once more)"),
        ("61,1,x,4,5,0\n", "1 row that can't be read left out (row 62: column 'j2_deg' is 'x', no number)"),
        ("59,1,3,4,5,0\n", "1 row out of order left out (row 62: time goes back to 0.058 s)"),
    ):
        (tmp_path / "some.csv").write_text(f"{HEAD}\n{rows('1,3')}{text}")
        assert read_recording(tmp_path / "some.csv", example).notes == (note,)


def test_of_a_recording_that_is_too_long_only_a_span_is_kept(free, example, monkeypatch):
    whole = read_recording(free, example).between(4.0, 7.0)
    monkeypatch.setattr(recorded_columns, "BLOCK_ROWS", 500)
    monkeypatch.setattr(recorded_columns, "MOST_ROWS", 3000)
    with pytest.raises(LogError, match=r"more than 3000 rows: cut it$"):
        read_recording(free, example)
    with pytest.raises(LogError, match=r"more than 3000 rows: choose a part with --from and --until$"):
        read_recording(free, example, span=WHOLE)
    part = read_recording(free, example, span=TimeWindow(4.0, 7.0)).between(4.0, 7.0)
    assert part.duration_s == pytest.approx(3.0, abs=2.0 * part.period_s)
    (mine,), (read,) = part.stretches, whole.stretches
    late = round((mine.start_s - read.start_s) / part.period_s)  # by a sample, as the bound falls on one
    assert abs(late) <= 1
    assert_allclose(mine.record.q[1 - late : -1 - late], read.record.q[1:-1], atol=1e-9)
    assert_allclose(mine.record.dq[1 - late : -1 - late], read.record.dq[1:-1], atol=1e-6)
    with pytest.raises(LogError, match=r"has 0 rows from 1000 s until 2000 s, 50 are the least"):
        read_recording(free, example, span=TimeWindow(1000.0, 2000.0))


def test_a_period_that_would_make_too_many_samples_is_refused(tmp_path, free):
    described = read_map(copy_example(tmp_path, ("[scheme]", "[sampling]\nperiod_s = 1e-9\n[scheme]")))
    with pytest.raises(LogError, match="more than 4000000 samples of 1e-09 s"):
        read_recording(free, described)


def test_a_number_of_the_urdf_that_nothing_can_be_reckoned_with_is_one_line(tmp_path):
    axis, origin = '<axis xyz="0 0 1"/>', '<origin xyz="0.35 0 0"/>'
    for old, new, said in (
        (axis, axis.replace("1", "1e300"), r"1e300 is more than 1e\+18"),
        (origin, origin.replace("0 0", "-1e308 0"), r"-1e308 is more than 1e\+18"),
    ):
        with pytest.raises(ConfigError, match=said):
            read_map(copy_example(tmp_path, urdf=(old, new)))
    largest = (origin, '<origin xyz="1e18 1e18 1e18"/>')
    model_of(read_map(copy_example(tmp_path, urdf=largest)).urdf.chain)


def test_the_command_says_by_its_status_whether_the_test_is_explained(tmp_path, free, touched):
    mapped = ("--map", str(EXAMPLE / "map.toml"), "--json")
    explained = called("identify", free, *mapped, "--out", tmp_path / "out")
    result = json.loads(explained.stdout)
    assert (explained.exit_code, result["test"]["margin"] > 1.0) == (0, True), explained.stderr
    assert json.loads((tmp_path / "out" / "identify.json").read_text()) == result
    assert (tmp_path / "out" / "test.png").stat().st_size > 10_000
    payload = write(tmp_path / "payload.csv", table(3.0) * np.array([1.0, 1.0, 1.0, 1.5, 1.5, 1.0]))
    other = called("identify", free, "--test", payload, *mapped)
    assert other.exit_code == 3
