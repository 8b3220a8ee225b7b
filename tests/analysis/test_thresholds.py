"""Thresholds and the comparison of the detectors, from a synthetic recording."""

import json
import math
import os
import runpy
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from called import called
from scheme.smooth_motion import torque_of

from adacd_hil.lab.detectors.detector_registry import detectors, register, unregister
from adacd_hil.lab.thresholds import free_motion as module
from adacd_hil.lab.thresholds.detector_comparison import (
    STEPS_NM,
    Comparison,
    DelayRow,
    compare_detectors,
    step_shape,
    write_comparison,
)
from adacd_hil.lab.thresholds.false_alarms import TooLittleMotionError
from adacd_hil.lab.thresholds.free_motion import read_motion, sample_of
from adacd_hil.lab.thresholds.recorded_thresholds import (
    compute_thresholds,
    find_lag,
    run_detectors,
)
from adacd_hil.log.log_files import LogError
from adacd_hil.plain_values import plain_values
from adacd_hil.records import SchemeState
from adacd_hil.score.emulator_truth import KnownTruth
from adacd_hil.score.judge import TrueContact
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.toml_files import read_toml

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
compiled_only = pytest.mark.skipif(INTERPRETED, reason="minutes of recording take minutes when interpreted")

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "detector" / "lab_detectors.py"
T = 1e-3
THETA = np.array([0.3841, 0.06825, 0.04035, 0.12, 0.06, 0.15, 0.08])
LAG_S = 1.5e-3
RATES = np.array([1.7, 2.9])


def positions(t_s):
    phase = np.outer(t_s, RATES)
    return 0.6 * np.sin(phase), 0.6 * RATES * np.cos(phase), -0.6 * RATES**2 * np.sin(phase)


def log_of(seconds, seed=1, **changes):
    """A log in memory: the arm moves in MONITOR, its torque noisy, its velocity late and in steps of 5e-4 rad/s."""
    count = round(seconds / T)
    t_s = np.arange(count) * T
    q, dq, ddq = positions(t_s)
    generator = np.random.default_rng(seed)
    late = positions(t_s - LAG_S)[1] + 2e-4 * generator.standard_normal((count, 2))
    scheme = {
        "q": q,
        "dq": np.round(late / 5e-4) * 5e-4,
        "tau_J": torque_of(q, dq, ddq, THETA) + 0.02 * generator.standard_normal((count, 2)),
        "theta_hat": np.tile(THETA, (count, 1)),
        "period_s": np.full((count, 1), T),
        "cycle": np.arange(count),
        "state": np.full(count, SchemeState.MONITOR, np.uint8),
        "contact_joints": np.zeros(count, np.uint8),
    }
    for name, value in changes.items():
        scheme[name] = value(scheme[name].copy())
    scheme["previous_state"] = np.roll(scheme["state"], 1)
    scheme["threshold"] = np.full((count, 2), 0.1)
    return Series(scheme)


class Series(dict):
    """Columns of /scheme."""

    def __len__(self):
        return len(self["cycle"])

    @property
    def t_ns(self):
        return np.round(np.asarray(self["cycle"]) * T * 1e9).astype(np.int64)

    def pieces(self, count):
        for first in range(0, len(self), count):
            yield Series({name: column[first : first + count] for name, column in self.items()})


@contextmanager
def logs_of(logs, count=20_000):
    """Let logs be read that are in memory, by their names, so many cycles at a time."""
    before, module.schemes = module.schemes, lambda path, bounds_ns: logs[path.name].pieces(count)
    try:
        yield [Path(name) for name in logs]
    finally:
        module.schemes = before


def motion_of(log, count=20_000):
    with logs_of({"run.mcap": log}, count) as (path,):
        return sample_of([read_motion(path)])


def statistics_of(logs, count=20_000):
    with logs_of(logs, count) as paths:
        return run_detectors([read_motion(path) for path in paths])


@pytest.fixture(scope="module")
def statistics():
    return statistics_of({"run.mcap": log_of(120.0)})


@pytest.mark.long
@compiled_only
def test_the_lag_of_the_velocity_is_identified():
    lag_s, of_joint_s = find_lag(motion_of(log_of(30.0)))
    np.testing.assert_allclose(lag_s, LAG_S, rtol=0.1)
    np.testing.assert_allclose(of_joint_s, LAG_S, rtol=0.2)


def between(first, last, value):
    def change(column):
        column[first:last] = value
        return column

    return change


@pytest.mark.parametrize(
    ("changes", "bad"),
    [
        ({"state": between(0, 3000, SchemeState.ADAPT)}, range(0, 3600)),
        ({"contact_joints": between(5000, 5010, 2)}, range(4400, 5610)),
        ({"tau_J": between(5000, 5001, np.nan)}, range(4400, 5601)),
        ({"cycle": lambda cycle: cycle + (cycle >= 5000)}, range(4400, 5601)),
        ({"period_s": between(5000, 5001, 3e-3)}, range(4400, 5601)),
    ],
)
def test_what_is_near_a_contact_a_gap_or_another_state_does_not_count(changes, bad):
    is_free = motion_of(log_of(10.0, **changes), 700).is_free
    expected = np.ones(10_000, bool)
    expected[:601] = False  # nobody knows what was before the first sample
    expected[list(bad)] = False
    np.testing.assert_array_equal(is_free, expected)


TOUCH = TrueContact(number=1, link=1, cycle=np.array([4990, 5020]), tau_ext=np.full((2, 2), 1.0), rows=1)


@pytest.mark.parametrize(
    ("truth", "free", "false_alarms"),
    [
        (None, [*range(601, 4400), *range(6900, 10_000)], None),
        ((), [*range(601, 5101), *range(6900, 10_000)], 1),
        ((TOUCH,), [*range(601, 4390), *range(6900, 10_000)], 0),
    ],
    ids=["truth unknown", "nobody there", "touched"],
)
def test_an_alarm_stands_for_a_contact_unless_the_truth_says_that_nobody_was_there(
    monkeypatch, truth, free, false_alarms
):
    known = None if truth is None else KnownTruth(truth, ((0, 0), (0, 9999)), None)
    monkeypatch.setattr(module, "contacts_beside", lambda *_: known)
    monkeypatch.setattr(module, "logged_settings", lambda _: Settings())
    reacts = {"state": between(5000, 6300, SchemeState.REACT), "contact_joints": between(5000, 5010, 2)}
    with logs_of({"run.mcap": log_of(10.0, **reacts)}, 700) as (path,):
        motion = read_motion(path)
    assert np.flatnonzero(motion.is_free).tolist() == free
    assert (motion.alarms, None if motion.contacts is None else motion.false_alarms) == (1, false_alarms)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"state": between(0, None, SchemeState.ADAPT)}, "b.mcap.*no motion in MONITOR"),
        ({"period_s": between(0, None, 0.0)}, "b.mcap.*no measured period"),
        ({"period_s": lambda period: 2.0 * period}, r"1\.000 and 2\.000 ms"),
    ],
)
def test_logs_that_can_not_be_used_are_named(changes, words):
    with pytest.raises(LogError, match=words):
        statistics_of({"a.mcap": log_of(2.0), "b.mcap": log_of(2.0, **changes)})


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"link_length_m": (0.5, 0.3)}, LogError, r"a.mcap and b.mcap are of two arms: arm.link_length_m is .*0.5"),
        ({"mass_kg": (2.0, 1.0)}, LogError, r"arm.mass_kg is unset and .*2.0"),
        ({"zero_deg": (3.0, 0.0), "torque_limit_Nm": (8.0, 4.0)}, TooLittleMotionError, "too few"),
    ],
    ids=["another arm", "another emulated arm", "another zero, another limit"],
)
def test_logs_of_two_arms_are_refused(monkeypatch, changes, error, words):
    found = {"a.mcap": Settings(), "b.mcap": replace(Settings(), arm=replace(Settings().arm, **changes))}
    monkeypatch.setattr(module, "logged_settings", lambda path: found[path.name])
    with pytest.raises(error, match=words):
        compute_thresholds(statistics_of({name: log_of(2.0) for name in found}), 1.0)


@pytest.mark.long
@compiled_only
def test_where_a_log_is_cut_into_pieces_does_not_matter():
    logs = {"a.mcap": log_of(30.05, tau_J=between(9_000, 9_001, np.nan)), "b.mcap": log_of(25.05, 2)}
    one, other = statistics_of(logs, 10**6), statistics_of(logs, 777)
    np.testing.assert_array_equal(other.peaks, one.peaks)
    np.testing.assert_array_equal(other.z, one.z)
    assert (one.lag_s, one.hours) == (other.lag_s, other.hours)
    assert len(one.peaks) == 301 + 251  # blocks begin anew with each log


@pytest.mark.long
@compiled_only
def test_of_long_motion_some_pieces_tell_the_lag_and_all_of_it_the_peaks(monkeypatch):
    log = log_of(120.0, contact_joints=between(30_000, 70_000, 1))
    whole = statistics_of({"run.mcap": log})
    monkeypatch.setattr(module, "MOST_SAMPLES", 40_000)
    thinned = statistics_of({"run.mcap": log}, 5_000)
    assert len(whole.z) == 120_000
    assert len(thinned.z) == 30_000  # a third of the 80,000 in pieces without a touch, in whole pieces
    assert thinned.is_free.sum() > 26_000, "pieces are where nobody touched the arm"
    np.testing.assert_allclose(thinned.lag_s, whole.lag_s, rtol=0.1)
    assert (thinned.hours, thinned.peaks.shape) == (whole.hours, whole.peaks.shape)
    first_order = slice(0, 3)  # the likelihood's weights, and what the lag leaves, are those of the pieces
    seen = ~np.isnan(whole.peaks[:, 0, 0])
    np.testing.assert_array_equal(~np.isnan(thinned.peaks[:, 0, 0]), seen)
    largest = [found.peaks[seen, first_order].max(axis=0) for found in (thinned, whole)]
    np.testing.assert_allclose(largest[0], largest[1], rtol=0.1)


@pytest.mark.slow
@compiled_only
def test_thresholds_are_found_limited_by_noise_and_checked(statistics, tmp_path):
    found = compute_thresholds(statistics, 1.0)
    rows = {(row.detector, row.channel): row for row in found.channels}
    smooth = rows["smoothed bank", "smoothed 50"]
    # sigma of the torque's noise in that channel is 2.9 mNm, of the velocity's 2.5e-4 rad/s less than that
    assert all(3.5 * 0.0029 < threshold < 8.0 * 0.0029 for threshold in smooth.threshold)
    assert smooth.limit == ("torque noise", "torque noise")
    assert rows["bank", "first-order 200"].limit[0] in {"velocity noise", "velocity LSB"}
    assert all(row.achievable_Nm[0] < 1.6 * row.threshold[0] for row in found.channels if row.achievable_Nm)
    assert found.is_extrapolated
    checked = [row for row in found.detectors if row.predicted_per_h is not None]
    assert checked
    assert all(0.4 < row.measured_per_h / row.predicted_per_h < 2.5 for row in checked)


def test_a_step_is_seen_as_the_loop_makes_it():
    shape = step_shape(40, 0.4e-3, T)
    assert shape[0] == 0.0
    fine = (np.arange(40_000) + 0.5) * 1e-6 - 0.4e-3
    x = np.maximum(2.0 * fine / 1.6e-3, 0.0)
    exact = (1.0 - (1.0 + x) * np.exp(-x)).reshape(40, 1000).mean(axis=1)
    np.testing.assert_allclose(shape[1:], exact[:-1], atol=1e-6)


@pytest.mark.long
@pytest.mark.slow
@compiled_only
def test_the_detectors_are_compared_at_one_rate(statistics, tmp_path):
    comparison = compare_detectors(statistics, 1.0, onsets=12)
    rows = {(row.detector, row.joint): row for row in comparison.rows}
    for row in comparison.rows:
        delays = np.array(row.delay_ms)
        assert np.all(delays[1:] <= delays[:-1]), row
        assert np.all(np.diff(row.roc) >= 0.0), row
    # the paper's filter alone on 1 Nm: -ln(1 - h / 1) / 10 and the loop's lag
    threshold = compute_thresholds(statistics, 1.0).channels[0].threshold[0]
    law_ms = -math.log(1.0 - threshold) * 100.0 + 1.6
    assert abs(rows["paper", 1].delay_ms[STEPS_NM.index(1.0)] - law_ms) < 1.0
    assert comparison.ranking[0] in {"smoothed bank", "likelihood ratio", "cusum"}
    paths = write_comparison(comparison, tmp_path / "new")
    assert [path.name for path in paths] == ["detectors.json", "detectors.png", "detectors.svg"]
    assert json.loads(paths[0].read_text())["ranking"][0] == comparison.ranking[0]
    assert paths[1].read_bytes().startswith(b"\x89PNG")
    assert "<svg" in paths[2].read_text()


@compiled_only
def test_a_detector_that_is_registered_is_in_the_thresholds_and_in_the_report(tmp_path):
    register("mean of 20", runpy.run_path(str(EXAMPLE))["MeanOfTwenty"])
    try:
        found = statistics_of({"run.mcap": log_of(55.0)}, count=7_001)
        thresholds = compute_thresholds(found, 5.0)
        comparison = compare_detectors(found, 5.0, onsets=4)
    finally:
        unregister("mean of 20")
    (channel,) = [row for row in thresholds.channels if row.detector == "mean of 20"]
    assert channel.channel == "mean of 20"
    bare = {row.channel: row.threshold for row in thresholds.channels}["first-order 50"]
    np.testing.assert_allclose(channel.threshold, bare, rtol=0.6)
    report = json.loads(write_comparison(comparison, tmp_path)[0].read_text())
    assert "mean of 20" in report["ranking"]
    delays = {row["detector"]: row["delay_ms"] for row in report["rows"] if row["joint"] == 1}
    assert delays["mean of 20"][-1] < delays["paper"][0]
    assert "mean of 20" not in detectors()


def test_never_is_a_dash_and_null_and_the_worst_rank():
    never = (math.inf,) * len(STEPS_NM)
    fast, slow = (
        DelayRow(name, 1, delay, (0.0,) * len(STEPS_NM), (0.5,))
        for name, delay in (("b", never), ("a", (3.0,) * len(never)))
    )
    comparison = Comparison(1.0, 2.0, (fast, slow), ())
    assert comparison.ranking == ("a", "b")
    assert comparison.table()[1][1][2] == "–"
    assert plain_values(comparison.by_key())["rows"][0]["delay_ms"][0] is None


def thresholds(logs, *arguments):
    with logs_of(logs):
        return called("thresholds", *logs, *arguments)


@pytest.mark.slow
@compiled_only
def test_the_command_prints_a_table_and_writes_toml(tmp_path):
    out = tmp_path / "new" / "thresholds.toml"
    played = thresholds({"a.mcap": log_of(40.0), "b.mcap": log_of(30.0, 2)}, "--rate-per-h", "5", "--out", str(out))
    assert played.exit_code == 0, played.output
    for words in (
        "5 false alarms per hour, from 0.02 h of contact-free motion, extrap",
        "smoothed 200",
        "torque noise",
    ):
        assert words in played.output
    stored = read_toml(out)
    assert (stored["logs"], stored["rate_per_h"]) == (["a.mcap", "b.mcap"], 5.0)
    assert len(stored["channels"]) >= 10


@compiled_only
def test_the_command_refuses_what_is_too_short():
    played = thresholds({"a.mcap": log_of(20.0)})
    assert (played.exit_code, played.stdout) == (1, "")
    (line,) = played.stderr.splitlines()
    assert "19 s of contact-free motion are too few for a tail, at least 50 s" in line
