"""Tuning: what is counted and bounded, what is chosen on one half, which candidate is suggested, and as what."""

import dataclasses
import functools
import hashlib
import json
import math
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from called import called

from adacd_hil.lab.drawing import COLOURS
from adacd_hil.lab.score.rates import least_rate_per_h, rate_bound_per_h, share_bounds
from adacd_hil.lab.thresholds import free_motion
from adacd_hil.lab.thresholds.false_alarms import TooLittleMotionError, calibrate_detector
from adacd_hil.lab.tune import tune_candidates, tune_roc
from adacd_hil.lab.tune.tune import (
    base_of,
    best_of,
    draw_delays,
    draw_roc,
    problems_of,
    slowest_adaptation,
    suggested_toml,
    write_tuning,
)
from adacd_hil.lab.tune.tune_candidates import (
    ShownLog,
    candidates,
    observe_candidates,
    thresholds_as_changes,
)
from adacd_hil.lab.tune.tune_roc import (
    FACTORS,
    Candidate,
    Observed,
    Trial,
    Tuning,
    TuningOutcome,
    Window,
    choose,
    delay_ms,
    read_logs,
    rising,
)
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import begin_of_log, read_log
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.records import SchemeState
from adacd_hil.replay.log_source import LogSource
from adacd_hil.scheme.pipeline.pipeline import layout_of
from adacd_hil.score.emulator_truth import contacts_beside
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.setting_keys import apply_settings
from adacd_hil.settings.toml_text import to_toml

M, A = SchemeState.MONITOR, SchemeState.ADAPT


def test_rates_and_shares_have_exact_bounds():
    for alarms, hours, most, least in ((0, 10.0, 0.299573, 0.0), (3, 2.0, 3.876828, 0.408846), (0, 0.0, math.inf, 0.0)):
        assert rate_bound_per_h(alarms, hours) == pytest.approx(most, rel=1e-5)
        assert least_rate_per_h(alarms, hours) == pytest.approx(least, rel=1e-5)
    shares = {(0, 10): (0.0, 0.308497), (10, 10): (0.691503, 1.0), (8, 10): (0.443905, 0.974789), (0, 0): (0.0, 1.0)}
    for found, bounds in shares.items():
        assert share_bounds(*found) == pytest.approx(bounds, rel=1e-5)


def observed(seconds=600.0, trials=(), seed=1):
    """Peaks of two joints: most are 0, some exponential ones stand apart; the first half chooses."""
    generator = np.random.default_rng(seed)
    count = round(seconds / 0.1)
    peaks = 0.01 * generator.random((count, 1, 2))
    peaks[::20, 0] += generator.exponential(0.02, (len(peaks[::20]), 2))
    return Observed("made", peaks, np.arange(count) < count // 2, trials)


def touched(height, is_chosen_on=False):
    """The statistic of joint 2 rises by `height` each 10 ms."""
    since_s = np.arange(20) * 0.01
    statistic = np.zeros((20, 1, 2))
    statistic[:, 0, 1] = height * np.arange(20)
    return Trial(since_s, statistic, is_chosen_on)


NOTHING = Trial(np.zeros(0), np.zeros((0, 1, 2)), False)


def test_thresholds_are_chosen_on_one_half_and_checked_on_the_other():
    before = choose(observed(), 1.0)
    made = observed()
    made.peaks[-100, 0, 1] = 99.0
    after = choose(made, 1.0)
    np.testing.assert_array_equal(after.thresholds, before.thresholds)
    assert (after.chosen.alarms, before.checked.alarms, after.checked.alarms) == (0, 0, 1)
    assert before.checked.hours == pytest.approx(300.0 / 3600.0)
    assert (before.roc[-1][1].alarms, after.roc[-1][1].alarms) == (0, 1)


def test_the_bound_of_the_tail_is_the_wanted_rate():
    choice = choose(observed(), 1.0)
    calibration = choice.calibration
    assert choice.method == "tail model, extrapolated 12-fold"
    assert choose(observed(), 60.0).method == "tail model"
    assert calibration.bound > 1.05 * calibration.threshold
    thresholds, exact = calibrate_detector(observed().half(True), 1.0)
    np.testing.assert_allclose(choice.thresholds, exact.bound / exact.threshold * thresholds, rtol=1e-12)
    predicted = dict(zip(FACTORS, (rate for _, _, rate in choice.roc), strict=True))
    assert predicted[1.0] < 1.0
    assert predicted[FACTORS[0]] is None
    assert predicted[1.0] == pytest.approx(calibration.tail.rate_at(calibration.bound / calibration.threshold))


def test_a_delay_is_that_of_the_first_sample_over_a_threshold_and_what_was_not_armed_is_missed():
    made = observed(trials=(touched(1e4), touched(1e-9), NOTHING, touched(1e4, is_chosen_on=True)))
    choice = choose(made, 1.0)
    assert (choice.chosen.contacts, choice.checked.contacts) == (1, 3)
    assert choice.checked.delays_ms == pytest.approx((10.0,))
    exact = choose(observed(trials=(touched(choice.thresholds[0, 1] / 5.0),)), 1.0)
    assert exact.checked.delays_ms == pytest.approx((60.0,)), "over, not equal"


def test_what_is_left_out_of_a_contact_changes_no_delay():
    generator = np.random.default_rng(3)
    statistic = np.cumsum(generator.normal(0.0, 1.0, (500, 3, 2)), axis=0)
    statistic[100:110, 1] = np.nan
    whole = Trial(np.arange(500) * 1e-3, statistic, True)
    kept = rising(whole)
    assert len(kept.since_s) < 250
    for _ in range(200):
        thresholds = generator.uniform(-5.0, 40.0, (3, 2))
        assert delay_ms(kept, thresholds) == delay_ms(whole, thresholds)
    assert rising(NOTHING) == NOTHING


def test_along_a_roc_fewer_alarms_are_paid_with_fewer_contacts():
    choice = choose(observed(trials=tuple(touched(0.002 * k) for k in range(1, 30))), 1.0)
    alarms = [found.alarms for _, found, _ in choice.roc]
    shares = [len(found.delays_ms) for _, found, _ in choice.roc]
    assert alarms == sorted(alarms, reverse=True)
    assert shares == sorted(shares, reverse=True)
    assert alarms[0] > 10 > alarms[-1] == 0
    assert shares[0] > 20 > shares[-1]
    assert choice.roc[0][1].hours == pytest.approx(300.0 / 3600.0), "alarms are counted where nothing was chosen"


def test_too_little_motion_gives_the_largest_value_seen_and_says_so():
    made = observed(20.0)
    choice = choose(made, 1.0)
    assert choice.calibration is None
    assert "too little motion" in choice.method
    np.testing.assert_array_equal(choice.thresholds, made.peaks[:100].max(axis=0))
    assert {rate for _, _, rate in choice.roc} == {None}
    made.peaks[:100] = np.nan
    with pytest.raises(TooLittleMotionError, match="no contact-free motion"):
        choose(made, 1.0)


def test_candidates_change_filter_and_gain_within_what_a_configuration_can_have():
    paper = load_settings("paper")
    first, *_ = tried = candidates(paper)
    assert (first, len(tried)) == ({}, 12)
    assert {"filter.a_rad_s": "20.0", "filter.b_rad_s": "20.0"} in tried
    assert {"estimator.P0": "[2.4, 1.2, 1.2, 0.15, 0.15, 0.15, 0.15]"} in tried
    near_the_end = apply_settings(paper, {"filter.a_rad_s": "400"})
    assert not [each for each in candidates(near_the_end) if each.get("filter.a_rad_s") == "1600.0"]
    certified = candidates(load_settings("certified"))
    assert {"certified.cutoffs_rad_s": "[20.0, 100.0, 400.0]"} in certified
    assert {"certified.residual_Nm": "0.03651"} in certified, "a third of the gain"


def test_thresholds_become_settings_that_are_never_lower(monkeypatch):
    def changed(name, *thresholds):
        return thresholds_as_changes(load_settings(name), np.array([thresholds]))

    assert changed("paper", 0.12344, 1e-5) == {"detector.threshold_Nm": "[0.1235, 0.001]"}
    assert changed("paper", 400.0, 0.2)["detector.threshold_Nm"].startswith("[100.0, ")
    assert changed("certified", 2.0) == {"certified.noise_sigmas": "13.01", "certified.model_sigmas": "6.503"}
    assert set(changed("certified", 1e-3).values()) == {"1.0"}
    assert set(changed("certified", 1e3).values()) == {"50.0"}
    monkeypatch.setattr(tune_candidates, "bounds_of", lambda section, name: (2.0, 30.0))
    assert set(changed("certified", 1e3).values()) == {"30.0"}


def hand_made_log(count=400):
    """400 cycles, all free but for a contact in rows 200 to 249; a second one, of which nobody was armed."""
    is_free = np.ones(count, bool)
    is_free[150:300] = False
    windows = (Window(1, 200, 249, True, True), Window(2, 260, 270, False, False))
    return SimpleNamespace(
        t_ns=np.arange(count) * 1_000_000,
        windows=windows,
        motion=SimpleNamespace(is_free=is_free, period_s=1e-3),
        is_chosen_on=np.ones(4, bool),
        block=100,
    )


def batch_of(settings, states, **fields):
    """Decisions of some cycles: their states, and what a block has in each."""
    layout = layout_of(settings)
    block = np.zeros((len(states), layout.size))
    for name, value in fields.items():
        block[:, layout.slices[name]] = value
    return SimpleNamespace(block=block, previous_state=np.array(states, np.uint8))


def shown_by(settings, states, late_ns=0, **fields) -> ShownLog:
    """Give what a candidate shows of the log made by hand; late_ns: of its cycles from 100 on."""
    shown = ShownLog(hand_made_log(), settings)
    rows = SimpleNamespace(t_ns=np.arange(400) * 1_000_000 + late_ns * (np.arange(400) >= 100))
    shown.take_stretch(rows, batch_of(settings, states, **fields))
    return shown


def test_the_paper_s_residual_is_taken_less_what_friction_may_hold_where_it_monitors_untouched():
    value = np.linspace(0.0, 1.0, 400)[:, None] * [1.0, -2.0]
    threshold = 100.0 + np.array([0.0, 0.5])
    shown = shown_by(load_settings("paper"), [A] * 50 + [M] * 350, tau_ext_hat=value, threshold=threshold)
    peaks = shown.peaks()
    np.testing.assert_allclose(peaks[0, 0], [99 / 399, 2 * 99 / 399 - 0.5], atol=1e-12)
    assert np.isnan(peaks[1:3]).all(), "a block of which a part doesn't count"
    np.testing.assert_allclose(peaks[3, 0], [1.0, 1.5])
    (contact,) = shown.trials()
    assert len(contact.since_s) == 50
    np.testing.assert_allclose(contact.statistic[0, 0], [200 / 399, 400 / 399 - 0.5])
    assert contact.since_s[-1] == pytest.approx(0.049)


def test_a_candidate_that_does_not_monitor_misses_the_contact_and_counts_no_motion():
    shown = shown_by(load_settings("paper"), [M] * 100 + [A] * 300, tau_ext_hat=1.0, threshold=100.0)
    assert np.isfinite(shown.peaks()[:, 0, 0]).tolist() == [True, False, False, False]
    assert [len(contact.since_s) for contact in shown.trials()] == [0]


def test_the_certified_scheme_s_statistic_is_the_largest_ratio_to_its_thresholds():
    settings = load_settings("certified")
    bank = np.zeros(2 * settings.channel_count)
    bank[3] = -0.3
    peaks = shown_by(settings, [M] * 400, late_ns=7, tau_ext_bank=bank, threshold_bank=0.2).peaks()
    assert peaks[0].item() == pytest.approx(1.5)
    assert np.isnan(peaks[1:]).all(), "cycles that the log knows nothing of"


def outcome(**changes):
    return dataclasses.replace(TuningOutcome((5.0, 6.0), 0, 0, 0, 0.01, (2.0, 4.0), 0), **changes)


@functools.cache
def choice_of(seconds):
    return choose(observed(seconds, trials=(touched(1.0), touched(1.0, True))), 1.0)


def candidate(delay_ms=2.0, name="made", changes=None, problems=(), seconds=600.0):
    choice = choice_of(seconds)
    chosen = choice.chosen._replace(delays_ms=() if delay_ms is None else (delay_ms,))
    choice = dataclasses.replace(choice, chosen=chosen)
    return Candidate(name, changes or {"filter.a_rad_s": "20.0"}, choice, outcome(), problems)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({}, ()),
        ({"adaptation_s": (5.0,)}, ("1 adaptations don't finish",)),
        ({"missed": 1}, ("1 missed",)),
        ({"missed": None, "false_alarms": None}, ()),
        ({"false_alarms": 2, "armed_false_alarms": 1}, ("1 false alarms",)),
        ({"false_alarms": 1, "armed_false_alarms": 1, "hours": 10.0}, ()),
        ({"false_alarms": 1}, ()),  # while it adapts: the hours are those of MONITOR
    ],
)
def test_a_candidate_is_fit_if_it_adapts_misses_nothing_and_alarms_no_more_than_wanted(changes, problem):
    assert problems_of(candidate().choice, outcome(**changes), outcome(), 1.0) == problem


def test_an_adaptation_outside_the_stretch_is_not_said_to_fail():
    assert slowest_adaptation(outcome(adaptation_s=(), unfinished=1)) == "not finished"
    assert slowest_adaptation(outcome(adaptation_s=())) == "not looked at"


def test_alarms_in_the_half_to_check_on_and_too_short_a_motion_are_no_fit():
    choice = candidate().choice
    alarmed = dataclasses.replace(choice, checked=choice.checked._replace(alarms=2))
    assert problems_of(alarmed, outcome(), outcome(), 1.0) == ("2 false alarms in the half to check on",)
    assert problems_of(candidate(seconds=20.0).choice, outcome(), outcome(), 1.0)[0] == "too little motion for a tail"


def with_choice(made, choice=None, **chosen):
    choice = choice or made.choice
    return dataclasses.replace(made, choice=dataclasses.replace(choice, chosen=made.choice.chosen._replace(**chosen)))


def test_of_the_fit_ones_the_fastest_is_suggested():
    slow, fast, unfit = candidate(4.0), candidate(3.0), candidate(1.0, problems=("1 missed",))
    assert best_of([slow, fast, unfit, candidate(None)]) is fast
    assert best_of([unfit]) is None
    early, late = (with_choice(fast, delays_ms=delays) for delays in ((2.0, 3.0, 8.0), (2.0, 3.0, 9.0)))
    assert best_of([late, early]) is early


def test_a_rate_too_far_from_the_motion_leaves_filter_and_gain_as_they_are():
    for rate_per_h, extrapolation, is_kept in ((0.12, 100.0, True), (0.125, 96.0, False)):
        own, faster = (with_choice(candidate(ms), choose(observed(), rate_per_h)) for ms in (4.0, 3.0))
        assert own.choice.extrapolation == pytest.approx(extrapolation)
        assert best_of([own, faster]) is (own if is_kept else faster)


def tuning_of(best, rate_per_h=1.0, path="run.mcap", **changes):
    free = SimpleNamespace(is_free=np.ones(7200, bool), period_s=1e-3)
    settings = apply_settings(load_settings("paper"), changes.pop("settings", {}))
    log = SimpleNamespace(path=Path(path), digest="ab" * 32, settings=settings, motion=free, windows=())
    others = {"own": outcome(), "detectors": (), "notes": (), **changes}
    return Tuning(rate_per_h, (log,), candidates=(best,), best=best, **others)


def test_the_suggestion_is_a_configuration_of_the_changed_keys_with_where_they_come_from(tmp_path):
    changes = {"filter.a_rad_s": "20.0", "filter.b_rad_s": "10.0", "detector.threshold_Nm": "[0.2, 0.3]"}
    best = candidate(changes=changes)
    tuning = tuning_of(best, path="a\nb.mcap", settings={"arm.profile": "M", "termination.beta_Nm": "0.2"})
    text = suggested_toml(tuning, best, "paper", load_settings("paper", "M"))
    (tmp_path / "tuned.toml").write_text(text)
    settings = load_settings(str(tmp_path / "tuned.toml"))
    assert settings == dataclasses.replace(apply_settings(load_settings("paper", "M"), changes), name="tuned")
    rows = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert rows == [
        'extends = "paper"', "[arm]", 'profile = "M"', "[filter]", "a_rad_s = 20.0", "[detector]",
        "threshold_Nm = [0.2, 0.3]",
    ]  # fmt: skip
    for words in (
        "version", "SHA-256 " + "ab" * 32, "0.0020 h", "a?b.mcap", "1 false alarms per hour", "extrapolated 12-fold",
        "0 false alarms in 0.0833 h, 95 % bound 35.9 per hour; 1 of 1 contacts found (3 to 100 %)", "not shown",
        "2 adaptations of 5.00 to 6.00 s, 0 missed, 0 false alarms, delay: median 3.0 ms", "termination.beta_Nm",
    ):  # fmt: skip
        assert words in text


def test_the_wanted_rate_is_shown_only_by_what_was_counted():
    assert not tuning_of(candidate(), 35.0).is_shown
    assert tuning_of(candidate(), 36.0).is_shown
    assert not dataclasses.replace(tuning_of(candidate(), 36.0), best=None).is_shown


def test_a_configuration_that_nobody_can_extend_is_asked_for():
    own = dataclasses.replace(load_settings("paper"), name="mine")
    with pytest.raises(ConfigError, match=r"'mine' isn't built in.*--config"):
        base_of(own, None)
    assert base_of(own, "certified")[1].scheme == "certified"


def test_the_report_has_the_figures_and_what_they_show(tmp_path):
    with_truth = write_tuning(tuning_of(candidate()), tmp_path / "a")
    assert [path.name for path in with_truth] == ["tune.json", "roc.png", "roc.svg", "delays.png", "delays.svg"]
    content = json.loads(with_truth[0].read_text())
    assert content["suggested"]["thresholds"]["checked_on"]["found"] == 1
    assert len(content["suggested"]["thresholds"]["roc"]) == len(FACTORS)
    blind = dataclasses.replace(candidate(), choice=choose(observed(trials=None), 1.0))
    assert blind.choice.checked.contacts is None
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match="can't be written"):
        write_tuning(tuning_of(blind), tmp_path / "file")


def test_every_detector_has_a_look_of_its_own():
    best = candidate()
    detectors = tuple(dataclasses.replace(best.choice, name=f"d{k}") for k in range(12))
    tuning = tuning_of(best, detectors=detectors)
    for figure in (draw_roc(tuning).figure, draw_delays(tuning).figure):
        lines = [line for line in figure.axes[0].get_lines() if not line.get_label().startswith("_")]
        assert [line.get_label() for line in lines[1:]] == [f"d{k}" for k in range(12)]
        assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == 13
        assert COLOURS["alarm"] not in {line.get_color() for line in lines[1:]}


SECOND_ATTEMPT = 1200
"""Cycle of the host in which the emulator counts from 0 again: the contact is in the second attempt of the log."""


def test_a_log_gives_its_contacts_and_the_motion_away_from_them(log):
    (read,) = read_logs([log])
    cycle = read_log(log, ("/scheme",)).scheme["cycle"]
    contacts = contacts_beside(log).contacts
    assert [cycle[window.first] - SECOND_ATTEMPT for window in read.windows] == [contact.onset for contact in contacts]
    assert [(window.is_armed, window.is_chosen_on) for window in read.windows] == [(True, True)]
    for window, contact in zip(read.windows, contacts, strict=True):
        assert contact.end < cycle[window.last] - SECOND_ATTEMPT < contact.end + 1000
        assert not read.motion.is_free[window.first - 600 : window.last + 600].any()
    assert read.is_chosen_on.tolist() == [
        k * 10 // len(read.is_chosen_on) % 2 == 0 for k in range(len(read.is_chosen_on))
    ]
    assert read.digest == hashlib.sha256(log.read_bytes()).hexdigest()


def test_motion_is_free_only_as_long_as_the_truth_goes_on(log, monkeypatch):
    known, (whole,) = contacts_beside(log), read_logs([log])
    ((attempt, _), _) = known.span
    cycle = read_log(log, ("/scheme",)).scheme["cycle"].reshape(-1)
    first, last = np.quantile(cycle[whole.motion.is_free], (0.2, 0.8), method="lower").tolist()
    short = known._replace(span=((attempt, first), (attempt, last)))
    monkeypatch.setattr(free_motion, "contacts_beside", lambda *_: short)
    (read,) = read_logs([log])
    is_covered = (first <= cycle) & (cycle <= last)
    assert read.motion.is_free.tolist() == (whole.motion.is_free & is_covered).tolist()
    assert 0 < read.motion.is_free.sum() < whole.motion.is_free.sum()


def test_contacts_of_a_later_attempt_are_counted_from_its_beginning(log, monkeypatch):
    known = contacts_beside(log)
    (first,) = known.contacts
    later = [dataclasses.replace(first, number=n + 1, attempt=n) for n in range(3)]
    monkeypatch.setattr(free_motion, "contacts_beside", lambda *_: known._replace(contacts=later))
    (read,) = read_logs([log])
    cycle = read_log(log, ("/scheme",)).scheme["cycle"]
    gap = 1204 - first.onset  # between the attempts
    counted = [(window.number, cycle[window.first] - first.onset) for window in read.windows]
    assert counted == [(1, gap), (2, SECOND_ATTEMPT)]


@pytest.mark.long
def test_of_a_stretch_its_motion_and_its_contacts_count(log):
    (whole,) = read_logs([log])
    (window,) = whole.windows
    at_s = (whole.t_ns[window.first] - begin_of_log(log)) * 1e-9
    (with_it,) = read_logs([log], stretch=TimeWindow(at_s - 0.0504, at_s + 1.9))
    assert len(with_it.t_ns) < len(whole.t_ns)
    assert with_it.t_ns[with_it.windows[0].first] == whole.t_ns[window.first]
    assert with_it.windows[0].number == 1
    (after,) = read_logs([log], stretch=TimeWindow(at_s + 0.001))
    assert after.windows == ()
    assert after.t_ns[-1] == whole.t_ns[-1]
    done = tune(log, "--from", at_s + 0.7, "--until", at_s + 1.7, "--json")
    found = json.loads(done.stdout)
    assert done.exit_code == 3, done.output
    assert (found["logs"][0]["contacts"], found["own"]["adaptations"]) == (0, 0)
    assert 0.0 < found["logs"][0]["free_h"] * 3600.0 < 1.0
    assert found["own"]["monitored_h"] * 3600.0 == pytest.approx(1.0, abs=0.002)


def test_of_one_log_every_other_contact_is_for_choosing(log, monkeypatch):
    known = contacts_beside(log)
    (first,) = known.contacts
    three = [dataclasses.replace(first, number=number) for number in (1, 2, 3)]
    monkeypatch.setattr(free_motion, "contacts_beside", lambda *_: known._replace(contacts=three))
    assert [window.is_chosen_on for window in read_logs([log])[0].windows] == [True, False, True]


def test_every_other_log_is_for_choosing(log, tmp_path):
    for name in ("run.mcap", "truth.mcap"):
        shutil.copy(log.with_name(name), tmp_path / name)
    logs = read_logs([log, tmp_path / "run.mcap"])
    assert [set(each.is_chosen_on) for each in logs] == [{True}, {False}]
    assert [window.is_chosen_on for each in logs for window in each.windows] == [True, False]


def test_the_candidate_without_changes_shows_the_logged_residual(log):
    (read,) = read_logs([log])
    (shown,) = observe_candidates([read], [{}], lambda _: None)
    scheme = read_log(log, ("/scheme",)).scheme
    for window, contact in zip(read.windows, shown.trials, strict=True):
        rows = slice(window.first, window.last + 1)
        allowance = scheme["threshold"][rows] - read.settings.detector.threshold_Nm
        known = np.isfinite(allowance).all(axis=1)
        logged = (np.abs(scheme["tau_ext_hat"][rows]) - allowance)[known]
        since_s = (scheme.t_ns[rows] - scheme.t_ns[window.first])[known] * 1e-9
        rises = rising(Trial(since_s, logged[:, None, :], True))
        np.testing.assert_allclose(contact.statistic, rises.statistic, atol=1e-12)
        np.testing.assert_array_equal(contact.since_s, rises.since_s)
        assert known.all()
        assert 20 < len(rises.since_s) < known.sum()


def tune(*words):
    return called("tune", *words)


def test_tune_says_that_so_little_motion_shows_nothing(log, tmp_path):
    config, out = tmp_path / "hasty.toml", tmp_path / "tuned.toml"
    config.write_text(to_toml(LogSource(log).settings).replace('name = "paper"', 'name = "hasty"'))
    done = tune(log.parent, "--out", out, "--json", "--config", config)
    assert done.exit_code == 3, done.output
    found = json.loads(done.stdout)
    assert (found["suggested"], out.exists()) == (None, False)
    assert (found["own"]["missed"], found["own"]["false_alarms"]) == (0, 0)
    unchosen = [note for note in found["notes"] if "no contact-free motion in the half" in note]
    assert len(found["candidates"]) + len(unchosen) == 12
    assert {"too little motion for a tail"} <= {word for each in found["candidates"] for word in each["problems"]}
    assert found["logs"][0]["contacts"] == 1


def test_a_suggestion_in_any_folder_extends_the_given_file_whatever_its_name(log, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = 'a "\x7f\n\U0001f9be.toml'
    Path(name).write_text("[filter]\nb_rad_s = 30.0\n")
    monkeypatch.setattr(
        "adacd_hil.lab.tune.tune.tune", lambda *_: tuning_of(candidate(changes={"filter.a_rad_s": "20"}))
    )
    done = tune(log, "--config", name, "--out", "below/tuned.toml", "--json")
    assert done.exit_code == 3, done.output
    made = load_settings("below/tuned.toml").filter
    assert (made.a_rad_s, made.b_rad_s) == (20.0, 30.0)


def test_without_truth_only_thresholds_are_looked_for(log, tmp_path):
    shutil.copy(log, tmp_path / "run.mcap")
    done = tune(tmp_path)
    assert done.exit_code == 3, done.output
    assert f"the true contacts of {tmp_path / 'run.mcap'} are not known" in done.stdout
    assert "filter.a_rad_s" not in done.stdout


def test_tune_notes_what_a_replay_notes_of_a_damaged_log(log, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-1000])
    (replayed,) = json.loads(called("replay", cut, "--json").stdout)
    found = json.loads(tune(cut, "--json").stdout)
    assert replayed["notes"]
    assert found["notes"][-len(replayed["notes"]) :] == [f"{cut}: {note}" for note in replayed["notes"]]


def test_what_can_not_be_tuned_is_said_in_one_line(log, tmp_path):
    link, copy = tmp_path / "link.mcap", tmp_path / "copy.mcap"
    link.symlink_to(log)
    shutil.copy(log, copy)
    called("log", "recover", log, "--out", tmp_path / "saved.mcap")
    called("log", "cut", log, "--until", 1.0, "--out", tmp_path / "early.mcap")
    for words, code, said in (
        ((log, log), 2, "a log is given twice"),
        ((log, link), 2, "a log is given twice"),
        ((log, copy), 2, "a log is given twice"),
        ((log, tmp_path / "saved.mcap"), 2, "a log is given twice"),
        ((log, tmp_path / "early.mcap"), 1, "no motion in MONITOR"),
        ((log, "--config", "paper"), 1, "with the settings to start from"),
    ):
        done = tune(*words)
        assert done.exit_code == code, (words, done.output)
        assert said in done.stderr.splitlines()[-1]


def test_logs_of_different_settings_are_not_tuned_together(log, monkeypatch):
    own = LogSource(log).settings
    sources = iter([own, apply_settings(own, {"filter.a_rad_s": "12"})])
    monkeypatch.setattr(tune_roc, "LogSource", lambda _: SimpleNamespace(settings=next(sources)))
    with pytest.raises(LogError, match=r"different settings, such as filter.a_rad_s"):
        read_logs([log, log])
