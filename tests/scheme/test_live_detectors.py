"""Detectors that run live: added from outside by an entry point, contained where they fail, and replayed to the bit."""

import re
import sys
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from analysis.replay_rig import settings_of_run
from click.testing import CliRunner
from documents import ROOT
from planar_arm import THETA, ClosedLoop

from adacd_hil.cli.embedded_run import Cast, run_embedded
from adacd_hil.cli.main import cli
from adacd_hil.cli.output import ExitCode
from adacd_hil.clock import MonotonicClock
from adacd_hil.control.pacing import DetectorTiming
from adacd_hil.log.reader import read_log
from adacd_hil.records import FaultReason, Request, SchemeState
from adacd_hil.replay.replay import replay
from adacd_hil.scheme.detect import detector_registry
from adacd_hil.scheme.detect.detectors import (
    DetectorBank,
    DetectorBankSettings,
    live_makers,
    make_stream,
    register,
    unregister,
)
from adacd_hil.scheme.detect.live_detectors import LiveDetectors, LiveSample, LiveStream
from adacd_hil.scheme.pipeline.pipeline import Pipeline
from adacd_hil.scheme.supervisor.transitions import CONTACT_SHIFT
from adacd_hil.settings.schema import ConfigError, DetectorError
from adacd_hil.settings.scheme_settings import DetectorSettings, LiveDetectorSettings
from firmware_sim.scenario.scenario import load_scenario

EXAMPLE = ROOT / "docs/examples/detector"
PUSH_S = 1.4
NEVER_NM = (50.0, 50.0)
"""Thresholds of the scheme's own that no push exceeds: what is found, a live detector has found."""


def watched_by(*rows, settings=None):
    """Settings of a short run of the paper's scheme in which only live detectors can find anything."""
    settings = settings or settings_of_run()
    return replace(settings, detector=replace(settings.detector, threshold_Nm=NEVER_NM, live=rows))


def row(name, threshold=0.5, level="collision"):
    return LiveDetectorSettings(name, (threshold, threshold), level)


def play(folder, settings):
    """A push on link 1; return the log's path."""
    pushed = load_scenario("push-link1")
    scenario = replace(pushed, contacts=(replace(pushed.contacts[0], at_s=PUSH_S, duration_s=0.1),), faults=())
    run_embedded(Cast(settings, scenario), "lockstep", folder)
    return folder / "run.mcap"


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """The example's package, installed in a folder of its own on the path: nothing of ours is changed."""
    site = tmp_path / "site"
    install(site, EXAMPLE / "pyproject.toml", (EXAMPLE / "lab_detectors.py").read_text())
    monkeypatch.syspath_prepend(str(site))
    yield from looked_up_anew()


def looked_up_anew():
    detector_registry._LOADED.clear()
    yield
    detector_registry._remove_loaded()
    detector_registry._LOADED[:] = ["adacd_hil.detectors"]


def install(site, pyproject, text):
    """Put down what pip would, of a package of one module."""
    project = tomllib.loads(pyproject.read_text())["project"]
    ((group, entries),) = project["entry-points"].items()
    (module,) = {value.partition(":")[0] for value in entries.values()}
    info = site / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in entries.items()))
    (site / f"{module}.py").write_text(text)


@pytest.fixture(scope="module")
def lab_run(tmp_path_factory):
    """A run that only the example's detector can find the push in; the package is gone again afterwards."""
    folder = tmp_path_factory.mktemp("lab")
    patch = pytest.MonkeyPatch()
    install(folder / "site", EXAMPLE / "pyproject.toml", (EXAMPLE / "lab_detectors.py").read_text())
    patch.syspath_prepend(str(folder / "site"))
    for _ in looked_up_anew():
        path = play(folder / "run", watched_by(row("mean of 20")))
        replayed = replay(path)
    patch.undo()
    return path, replayed


@pytest.mark.slow
def test_a_detector_of_a_lab_s_package_finds_a_contact_live_and_says_so(lab_run):
    log = read_log(lab_run[0])
    (found,) = [logged for logged in log.events if logged.event.name == "detector"]
    assert found.event.message.startswith("contact found by mean of 20 (joint 1: 0.5")
    reacts = log.scheme["state"].reshape(-1) == SchemeState.REACT
    begin_ns = int(log.scheme.t_ns[reacts][0])
    assert found.t_ns == begin_ns
    truth = read_log(lab_run[0].with_name("truth.mcap")).topics["/truth"]
    onset_ns = int(truth.t_ns[truth["contact_force"].reshape(-1) > 0.0][0])
    assert 0 < begin_ns - onset_ns < 20_000_000
    assert len(log.topics["/contact"]) == 2
    assert log.topics["/contact"]["link"].reshape(-1).tolist() == [1, 1]


@pytest.mark.slow
def test_the_report_s_card_of_a_contact_says_who_found_it(lab_run):
    result = CliRunner().invoke(cli, ["report", str(lab_run[0])])
    assert result.exit_code == ExitCode.OK, result.output
    page = lab_run[0].with_name("report.html").read_text()
    assert page.count("<dt>found by</dt>") == 1
    assert "<dd>mean of 20 (joint 1: 0.5" in page


@pytest.mark.slow
def test_a_log_with_a_live_detector_replays_to_the_bit(lab_run):
    _, replayed = lab_run
    assert replayed.is_identical
    assert replayed.compared > 1500
    assert replayed.notes == ()


@pytest.mark.slow
def test_a_log_whose_detector_is_not_registered_is_refused_in_one_line(lab_run):
    result = CliRunner().invoke(cli, ["replay", str(lab_run[0])])
    assert result.exit_code == ExitCode.DETECTOR_MISSING == 6
    assert "no detector mean of 20 is registered here" in result.output
    assert result.output.count("\n") == 2  # the line of progress, and this one


@pytest.mark.slow
def test_a_detector_with_other_code_is_replayed_and_the_difference_is_told(lab_run, tmp_path, monkeypatch):
    text = (EXAMPLE / "lab_detectors.py").read_text()
    install(tmp_path, EXAMPLE / "pyproject.toml", text.replace("np.abs(torque.mean(axis=0))", "0.0 * held[0]"))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "lab_detectors", raising=False)
    for _ in looked_up_anew():
        replayed = replay(lab_run[0])
    assert not replayed.is_identical
    assert any(note.startswith("live detectors have other code here: mean of 20: sha256") for note in replayed.notes)
    assert replayed.contacts == ()


def test_the_example_passes_its_own_test(lab, monkeypatch):
    names = {}
    exec(compile((EXAMPLE / "test_lab_detectors.py").read_text(), "example", "exec"), names)
    for name, test in names.items():
        if name.startswith("test_"):
            test()


def test_a_package_s_detector_stands_among_those_of_thresholds(lab):
    settings = DetectorBankSettings()
    assert settings.detectors["mean of 20"] == (len(settings.channels) - 1,)
    assert "mean of 20" in live_makers()


# -- what fails, fails safe --------------------------------------------------------------------------------------------


class Faithful:
    """The plainest live detector."""

    limit = 1_000_000_000

    def __init__(self, period_s):
        self.state = {"count": np.zeros(1)}

    def take(self, z, held_Nm):
        self.state["count"] += len(z)
        return np.abs(z) if self.state["count"][0] <= self.limit else self.fail(z)

    def fail(self, z):
        raise RuntimeError("out of\nluck")


class Nan(Faithful):
    def fail(self, z):
        return np.full(z.shape, np.nan)


class ThreeJoints(Faithful):
    def fail(self, z):
        return np.zeros((1, 3))


class Nothing(Faithful):
    def fail(self, z):
        return None


class Leaves(Faithful):
    def fail(self, z):
        raise SystemExit(0)


class Forgets(Faithful):
    def fail(self, z):
        return self.nothing


@pytest.fixture
def registered():
    names = []

    def add(name, make):
        register(name, make)
        names.append(name)

    yield add
    for name in names:
        unregister(name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (Faithful, "RuntimeError: out of luck"),
        (Nan, "ValueError: statistics nan, nan are not finite"),
        (ThreeJoints, r"ValueError: a statistic (1, 3) for a sample (1, 2)"),
        (Nothing, "ValueError: a statistic () for a sample (1, 2)"),
        (Leaves, "SystemExit: 0"),
        (Forgets, "AttributeError: 'Forgets' object has no attribute 'nothing'"),
    ],
)
def test_a_detector_that_fails_in_cycle_500_stops_the_arm_for_good(registered, monkeypatch, make, words):
    registered("frail", make)
    monkeypatch.setattr(Faithful, "limit", 500)
    loop = ClosedLoop(watched_by(row("frail", 1e6)), THETA["P"])
    loop.run_until(SchemeState.MONITOR)
    outputs = loop.run(600)
    first = next(k for k, output in enumerate(outputs) if output.state is SchemeState.FAULT)
    assert first == 500
    assert {output.fault for output in outputs[first:]} == {FaultReason.DETECTOR}
    (line,) = loop.pipeline.describe_detector()
    assert line == f"detector frail failed in cycle {outputs[first].cycle}: {words}"


@pytest.mark.slow
def test_the_log_of_a_detector_that_fails_says_so_and_replays(registered, monkeypatch, tmp_path):
    registered("frail", Faithful)
    monkeypatch.setattr(Faithful, "limit", 450)
    settings = watched_by(row("frail", 1e6))
    settings = replace(settings, operator=replace(settings.operator, acknowledge_faults=0))
    path = play(tmp_path, settings)
    lines = [logged.event for logged in read_log(path).events if logged.event.level == "error"]
    assert len(lines) == 1
    said = r"MONITOR -> FAULT: DETECTOR; detector frail failed in cycle \d+: RuntimeError: out of luck"
    assert re.match(said, lines[0].message)
    assert replay(path).is_identical


@pytest.mark.slow
def test_a_detector_that_always_fires_stops_the_arm_and_no_word_releases_it(registered):
    registered("eager", Faithful)
    settings = watched_by(row("eager", 1e-9))
    loop = ClosedLoop(settings, THETA["P"])
    loop.run_until(SchemeState.MONITOR)
    outputs = loop.run(1500)
    assert outputs[-1].state is SchemeState.STOPPED
    (event,) = [event for event in loop.pipeline.take_events() if event.name == "detector"]
    assert event.message.startswith("contact found by eager")
    loop.request = Request.ACKNOWLEDGE
    assert loop.run(200)[-1].state is SchemeState.STOPPED


@pytest.mark.slow
def test_a_detector_that_never_fires_takes_no_alarm_of_the_scheme_away(registered):
    registered("blind", Faithful)
    settings = settings_of_run()
    settings = replace(settings, detector=replace(settings.detector, live=(row("blind", 1e9),)))
    loops = [ClosedLoop(each, THETA["P"]) for each in (settings, settings_of_run())]
    outputs = []
    for loop in loops:
        loop.run_until(SchemeState.MONITOR)
        loop.run(100)
        loop.tau_ext[0] = 2.0
        outputs.append(loop.run(300))
    assert SchemeState.REACT in {output.state for output in outputs[0]}
    for one, other in zip(*outputs, strict=True):
        assert one.state is other.state
        assert one.block.tobytes() == other.block.tobytes()
    events = [event.message for event in loops[0].pipeline.take_events() if event.name == "detector"]
    assert events == ["contact found by the scheme's own thresholds (joint 1)"]


def sample(cycle, torque=0.0):
    return LiveSample(cycle, np.zeros(2), np.zeros(2), np.full(2, torque), np.zeros(7), 1e-3)


# -- one implementation ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["first-order 10", "smoothed 200", "band-pass", "observer 25", "cusum", "paper"])
def test_a_built_in_channel_gives_live_what_it_gives_offline(name):
    make = live_makers()[name]
    assert detector_registry.check_contract(name, make)
    z = np.random.default_rng(7).standard_normal((50, 2))
    settings = DetectorBankSettings()
    bank = DetectorBank(settings, np.zeros((2, 6, 144)), 1e-3).take(z, np.abs(z))
    place = settings.channels.index(name if name != "paper" else "first-order 10")
    np.testing.assert_array_equal(make(1e-3).take(z, np.abs(z)), bank[:, place])


def test_the_stream_is_the_same_sample_by_sample():
    random = np.random.default_rng(8)
    q, dq, tau_J = random.standard_normal((3, 60, 2))
    theta = np.abs(random.standard_normal(7))
    interval_s = np.full(60, 1e-3)
    interval_s[30] = 0.0
    z, held_Nm = make_stream(q, dq, tau_J, theta, interval_s)
    stream = LiveStream(settings_of_run())
    for k in range(60):
        cycle = k if k < 30 else k + 1
        live, held = stream.take(LiveSample(cycle, q[k], dq[k], tau_J[k], theta, 1e-3))
        np.testing.assert_array_equal(live[0], z[k])
        np.testing.assert_array_equal(held[0], held_Nm[k])


def test_a_detector_begins_anew_whenever_it_is_armed(registered):
    registered("plain", Faithful)
    detectors = LiveDetectors(watched_by(row("plain", 1e-3)))
    (each,) = detectors.running
    first = [detectors.step(sample(cycle, torque=0.5), True, True) for cycle in range(3)]
    assert each.detector.state["count"].tolist() == [3.0]
    assert detectors.step(sample(3, torque=0.5), True, False) == 0
    again = [detectors.step(sample(cycle, torque=0.5), True, True) for cycle in range(4, 7)]
    assert again == first
    assert first[0] == 0  # nothing is known of what was before
    assert first[1] >> CONTACT_SHIFT == 0b11
    assert each.detector.state["count"].tolist() == [3.0]


def test_a_cycle_without_a_fresh_sample_leaves_the_alarm_as_it_is(registered):
    registered("plain", Faithful)
    detectors = LiveDetectors(watched_by(row("plain", 1e-3)))
    for cycle in range(2):
        found = detectors.step(sample(cycle, torque=0.5), True, True)
    assert found
    assert detectors.step(sample(2), False, True) == found
    assert detectors.step(sample(3), True, True) == 0  # after a gap


# -- what is refused ---------------------------------------------------------------------------------------------------


class Remembers(Faithful):
    """Keeps something beside its state."""

    def __init__(self, period_s):
        super().__init__(period_s)
        self.largest = 0.0

    def take(self, z, held_Nm):
        found = np.empty(z.shape)
        for k in range(len(z)):
            self.largest = max(self.largest, float(np.abs(z[k]).max()))
            found[k] = self.largest
        return found


class Collects(Faithful):
    def __init__(self, period_s):
        super().__init__(period_s)
        self.all = []

    def take(self, z, held_Nm):
        self.all.append(1)
        return np.abs(z)


class Replaces(Faithful):
    def take(self, z, held_Nm):
        self.state["count"] = self.state["count"] + len(z)
        return np.abs(z)


class KeepsTheArray(Faithful):
    """Reads again, a sample later, the array that it was given: live it has the next sample by then."""

    def __init__(self, period_s):
        super().__init__(period_s)
        self.before = np.zeros((1, 2))

    def take(self, z, held_Nm):
        found = np.abs(np.concatenate((self.before[-1:], z[:-1])))
        self.before = z
        return found


class NoArrays(Faithful):
    def __init__(self, period_s):
        self.state = {"count": 0.0}

    def take(self, z, held_Nm):
        return np.abs(z)


class Random(Faithful):
    def take(self, z, held_Nm):
        return np.random.default_rng().random(z.shape)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (Remembers, "detector odd gives sample 0 another statistic when it is reset: it keeps something beside"),
        (Collects, "detector odd grows: all has 200, 200 samples on 400"),
        (Replaces, "detector odd replaces its state count"),
        (KeepsTheArray, "another statistic when it is fed sample by sample"),
        (NoArrays, "detector odd: state must be numpy arrays by name"),
        (Random, "detector odd gives sample 0 another statistic"),
    ],
)
def test_a_live_detector_that_breaks_the_contract_is_refused_and_named(make, words):
    with pytest.raises(ValueError, match=words):
        register("odd", make)
    assert "odd" not in DetectorBankSettings().registered


class Offline:
    def __init__(self, period_s):
        pass

    def take(self, z, held_Nm):
        return np.abs(z)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("cusun", "no detector cusun is registered here; did you mean cusum?"),
        ("smoothed bank", "smoothed bank has 5 channels, name each: first-order 50, first-order 200, smoothed 10"),
        ("likelihood 8", "likelihood 8 can't run live: its weights come from recorded motion"),
        ("offline", "detector offline can't run live: it has no `state`"),
    ],
)
def test_what_cannot_run_live_is_refused_before_the_run(registered, name, words):
    registered("offline", Offline)
    with pytest.raises(DetectorError, match=words):
        Pipeline(watched_by(row(name)))


def test_a_detector_is_named_once_for_each_level():
    with pytest.raises(ConfigError, match="cusum twice with level 'contact'"):
        DetectorSettings(live=(row("cusum", 1.0, "contact"), row("cusum", 2.0, "contact")))
    assert len(DetectorSettings(live=(row("cusum", 1.0, "contact"), row("cusum", 2.0))).live) == 2


def test_two_packages_with_one_name_are_refused_by_their_names(tmp_path, monkeypatch):
    pyproject = tmp_path / "pyproject.toml"
    for name in ("first-lab", "second-lab"):
        module = name.replace("-", "_")
        pyproject.write_text(
            f'[project]\nname = "{name}"\nversion = "1.0"\n'
            f'[project.entry-points."adacd_hil.detectors"]\n"twin" = "{module}:MeanOfTwenty"\n'
        )
        site = tmp_path / name
        install(site, pyproject, (EXAMPLE / "lab_detectors.py").read_text())
        monkeypatch.syspath_prepend(str(site))
    for _ in looked_up_anew():
        for _ in range(2):  # said again, not forgotten
            with pytest.raises(DetectorError, match=r"twin of package .*-lab 1.0 can't be used: .* already, of"):
                live_makers()


def test_a_package_that_cannot_be_imported_is_named(tmp_path, monkeypatch):
    install(tmp_path / "site", EXAMPLE / "pyproject.toml", "raise ImportError('no libfoo')\n")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    monkeypatch.delitem(sys.modules, "lab_detectors", raising=False)
    for _ in looked_up_anew():
        with pytest.raises(DetectorError, match=r"mean of 20 of package lab-detectors 1.0 .* ImportError: no libfoo"):
            live_makers()


# -- time --------------------------------------------------------------------------------------------------------------


class Clockwork:
    """A clock on which each reading is so much later."""

    def __init__(self, step_ns):
        self.step_ns, self.now = step_ns, 0

    def __call__(self):
        self.now += self.step_ns
        return self.now


def timing_of(step_ns, monkeypatch):
    detectors = LiveDetectors(watched_by(row("cusum")))
    clock = Clockwork(step_ns)
    monkeypatch.setattr(MonotonicClock, "now_ns", lambda _: clock())
    return detectors, DetectorTiming(detectors, 1_000_000, MonotonicClock())


def test_a_detector_that_is_too_slow_for_the_cycle_is_refused_in_real_time(monkeypatch):
    _, timing = timing_of(600_000, monkeypatch)
    with pytest.raises(DetectorError, match=r"detector cusum takes 600 µs a cycle, more than 0.5 of the period"):
        timing.measure(lambda _: None)


def test_a_slow_call_in_the_run_is_an_event_that_names_the_detector(monkeypatch):
    detectors, timing = timing_of(150_000, monkeypatch)
    said = []
    timing.measure(said.append)
    assert said == ["live detector cusum: 150.0 µs of a period of 1000 µs"]
    for cycle in range(3):
        detectors.step(sample(cycle), True, True)
        timing.step(cycle, cycle * 1_000_000)
    (event,) = timing.take_events()
    assert event == ("warning", "timing", "detector cusum took 150 µs in cycle 0, at most 150 µs so far")
    timing.step(3, 2_000_000_000)
    assert timing.take_events() == []
