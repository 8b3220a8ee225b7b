"""The surface for scripts and packages: a log as arrays, arrays through the scheme, names that stay."""

import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from called import called
from foreign_arms import urdf_text

from adacd_hil import api
from adacd_hil.lab.library.array_detection import ArrayError, OfflineArm, detect, fit
from adacd_hil.lab.library.loaded_run import load
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import read_log
from adacd_hil.records import SchemeState
from adacd_hil.settings.schema import ConfigError

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"
PERIOD_S = 2e-3
PUSH_S, PUSH_NM = (9.0, 9.3), 0.5


@pytest.fixture(scope="module")
def arm() -> OfflineArm:
    return OfflineArm.from_urdf(urdf_text(1, ("0 0 1",), has_masses=False))


@pytest.fixture
def arrays() -> dict[str, Any]:
    """An inertia of 0.2 kg m² with friction, which somebody pushes once."""
    t = 100.0 + PERIOD_S * np.arange(6000)
    rates = np.array([2.0, 3.3, 5.1])
    phase = np.outer(t, rates)
    q, dq, ddq = (factor.sum(axis=1) for factor in (np.sin(phase), rates * np.cos(phase), -(rates**2) * np.sin(phase)))
    tau = 0.2 * ddq + 0.05 * dq + 0.1 * np.sign(dq) + 0.03 + 0.01 * np.random.default_rng(1).standard_normal(t.size)
    tau -= PUSH_NM * ((t - 100.0 >= PUSH_S[0]) & (t - 100.0 < PUSH_S[1]))
    return {"t": t, "q": q[:, None], "dq": dq[:, None], "tau_J": tau[:, None]}


def test_a_contact_is_found_in_arrays_and_the_model_is_the_arms(arm, arrays):
    found = detect(arrays, arm)
    named = dict(zip(found.model.names, found.model.theta, strict=True))
    assert named["F_c1"] == pytest.approx(0.1, abs=0.01)
    assert named["offset1"] == pytest.approx(0.03, abs=0.01)
    assert (found.model.margin > 1.0, found.model.verdict.is_explained) == (True, True)
    assert found.model.identified.described.columns.dq == ("1",)
    assert [(each.link, each.direction) for each in found.contacts] == [(1, (1,))]
    assert found.contacts[0].t_s - 100.0 == pytest.approx(PUSH_S[0], abs=0.03)
    assert found.t_s.shape == (6000,)
    assert found.tau_ext_hat.shape == found.threshold.shape == (6000, 1)
    assert (found.t_s[0], found.t_s[-1]) == (pytest.approx(100.0), pytest.approx(arrays["t"][-1]))


def test_a_model_of_one_recording_watches_another_and_names_of_others_are_taken(arm, arrays):
    model = fit(arrays, arm, fit_s=(100.0, 105.0))
    renamed = {"time": arrays["t"], "q": arrays["q"], "qd": arrays["dq"], "tau": arrays["tau_J"]}
    assert detect(renamed, arm, model=model).contacts == detect(arrays, arm, fit_s=(100.0, 105.0)).contacts


def test_velocities_in_another_unit_are_told_without_a_map(arm, arrays):
    verdict = fit({**arrays, "dq": np.rad2deg(arrays["dq"])}, arm).verdict
    assert "times its position's slope" in verdict.reasons[0]
    assert verdict.remedy.startswith('convert the arrays, as the map of a recording would: `units.dq` = "deg/s"')
    assert "in the map" not in " ".join([*verdict.reasons, *verdict.remarks, verdict.remedy])


@pytest.mark.parametrize("value", [0.0, 0.3])
def test_no_contact_in_the_arrays_of_a_dead_logger_is_no_finding(arm, arrays, value):
    model = fit(arrays, arm, fit_s=(100.0, 105.0))
    dead = {name: np.full_like(arrays[name], value) for name in ("q", "tau_J")} | {"dq": 0.0 * arrays["dq"]}
    found = detect({**arrays, **dead}, arm, model=model)
    assert [fault.partition(" is always ")[0] for fault in found.faults] == [
        "the torque of joint1 (1)",
        "the arm does not move",
    ]
    assert "not judged: the torque of joint1" in repr(found)
    assert detect(arrays, arm, model=model).faults == ()


@pytest.mark.parametrize("other", [{"has_rotors": True}, {"gravity_m_s2": (0.0, 9.81, 0.0)}])
def test_a_model_of_another_arm_is_refused(arm, arrays, other):
    with pytest.raises(ArrayError, match=r"^model is of another arm"):
        detect(
            arrays, OfflineArm.from_urdf(urdf_text(1, ("0 0 1",), has_masses=False), **other), model=fit(arrays, arm)
        )


@pytest.mark.parametrize("fitted", ["measured", "derived"])
def test_a_model_of_the_other_kind_of_velocity_is_refused(arm, arrays, fitted):
    derived = {name: arrays[name] for name in ("t", "q", "tau_J")}
    first, second = (arrays, derived) if fitted == "measured" else (derived, arrays)
    with pytest.raises(ArrayError, match="one kind of velocity"):
        detect(second, arm, model=fit(first, arm))


def test_a_lag_without_velocities_is_refused(arm, arrays):
    with pytest.raises(ArrayError, match=r"^velocity_lag_s = 0.001 is no time within 0 to 0 s, as dq is not given$"):
        detect({name: arrays[name] for name in ("t", "q", "tau_J")}, arm, velocity_lag_s=1e-3)


@pytest.mark.parametrize("gravity", [(0.0, 0.0), (0.0, 0.0, np.nan), 9.81])
def test_a_gravity_that_is_no_vector_is_refused(gravity):
    with pytest.raises(ConfigError, match=r"^`gravity_m_s2"):
        OfflineArm.from_urdf(urdf_text(1, ("0 0 1",), has_masses=False), gravity_m_s2=gravity)


def test_touches_that_are_known_are_left_out_of_the_fit(arm, arrays):
    touched = (arrays["t"] >= 100.0 + PUSH_S[0]) & (arrays["t"] < 100.0 + PUSH_S[1])
    blind = fit(arrays, arm, fit_s=(106.0, 112.0))
    told = fit({**arrays, "touched": touched}, arm, fit_s=(106.0, 112.0))
    offset = told.names.index("offset1")
    assert abs(told.theta[offset] - 0.03) < 0.005 < abs(blind.theta[offset] - 0.03)


def spoilt(arrays: dict[str, Any], name: str, place: Any, value: float) -> dict[str, Any]:
    values = arrays[name].copy()
    values[place] = value
    return {**arrays, name: values}


WRONG = {
    "array 'tau_J' is missing; there are t, q": lambda a: {"t": a["t"], "q": a["q"]},
    "unknown array 'tau_K'; did you mean 'tau_J'?": lambda a: {**a, "tau_K": a["q"]},
    "array 'dq' is given twice, once as 'qd'": lambda a: {**a, "qd": a["dq"]},
    "q has shape (5, 1), (6000, 1) is expected": lambda a: {**a, "q": a["q"][:5]},
    "q has shape (6000,), (6000, 1) is expected": lambda a: {**a, "q": a["q"][:, 0]},
    "t has shape (6000, 1), (k,) with k ≥ 50 is expected": lambda a: {**a, "t": a["t"][:, None]},
    "t[7] = 100 s is not after t[6] = 100.012 s": lambda a: spoilt(a, "t", 7, 100.0),
    "t[3] = nan s is not finite": lambda a: spoilt(a, "t", 3, np.nan),
    "q[5, 0] = nan rad is not at most 1e+06 rad": lambda a: spoilt(a, "q", (5, 0), np.nan),
    "tau_J[9, 0] = -2e+06 Nm is not at most 1e+06 Nm": lambda a: spoilt(a, "tau_J", (9, 0), -2e6),
    "q is of complex128, real numbers in rad are expected": lambda a: {**a, "q": a["q"] + 1j},
    "q is of list, real numbers in rad are expected": lambda a: {**a, "q": [[0.0], [0.0, 1.0]]},
    "t has a median period of 2 s, 1e-05 to 0.05 s are expected": lambda a: {**a, "t": a["t"] * 1000.0},
    "touched has shape (6000,) of float64, (6000,) of bool is expected": lambda a: {**a, "touched": a["t"]},
    "tau_J is of masked values, real numbers in Nm are expected": lambda a: {
        **a,
        "tau_J": np.ma.masked_greater(a["tau_J"], 0.5),
    },
    "arrays are of list, a mapping from names is expected, as `run.motion`": lambda a: [a["t"], a["q"]],
    "unknown array 1; known: t, q, tau_J, dq, touched, t_s, time, qd, tau": lambda a: {**a, 1: a["q"]},
}


GROWING = "must be two growing times, s, up to 112, the end of t"
OPTIONS = {
    f"fit_s = (105.0, 101.0) {GROWING}": {"fit_s": (105.0, 101.0)},
    f"fit_s = (100.0, 300.0) {GROWING}": {"fit_s": (100.0, 300.0)},
    "too little free motion to fit from 100 to 100.1 s: 100 samples in a row are the least": {"fit_s": (100.0, 100.1)},
    "noise_Nm has 2 values, the arm 1 joints": {"noise_Nm": (0.1, 0.1)},
    "`deviations` = 0.0 is below 1": {"deviations": 0.0},
    "unknown key `deviation`; did you mean `deviations`?": {"deviation": 5.0},
    "velocity_lag_s = -1.0 is no time within 0 to 0.05 s": {"velocity_lag_s": -1.0},
    "velocity_lag_s = nan is no time within 0 to 0.05 s": {"velocity_lag_s": np.nan},
    "velocity_lag_s = '1' is no time within 0 to 0.05 s": {"velocity_lag_s": "1"},
    f"fit_s = (0.0, nan) {GROWING}": {"fit_s": (0.0, np.nan)},
    f"fit_s = (nan, 105.0) {GROWING}": {"fit_s": (np.nan, 105.0)},
    f"fit_s = 5.0 {GROWING}": {"fit_s": 5.0},
    f"fit_s = ('5', '0') {GROWING}": {"fit_s": ("5", "0")},
    "`period_s` is no setting: the recording's own period is taken": {"period_s": 1.04 * PERIOD_S},
    "model is of str, a Model is expected, as of `fit`": {"model": "model"},
}


@pytest.mark.parametrize("line", [*WRONG, *OPTIONS])
def test_arrays_and_options_that_can_not_be_used_are_one_line(arm, arrays, line):
    change, options = WRONG.get(line, dict), OPTIONS.get(line, {})
    with pytest.raises(ArrayError, match=f"^{re.escape(line)}$"):
        detect(change(arrays), arm, **options)


def test_a_log_is_arrays_with_a_row_for_each_cycle(log):
    run, raw = load(log.parent), read_log(log)
    assert len(run) == len(raw.scheme)
    assert np.array_equal(run["tau_J"], raw.scheme["tau_J"])
    assert np.array_equal(run["tau_c"], raw.control["tau_c"])
    assert run["lateness_ns"].shape == run.t_s.shape
    assert run.t_s[np.flatnonzero(run.state == SchemeState.ADAPT)[0]] == 0.0
    assert run.problem == ""
    assert run.settings.bus.period_s == pytest.approx(np.diff(run.t_s).min())
    assert len(run.contacts) == len({report.cycle for _, report in raw.contacts})
    assert [event.name for event in run.events].count("supervisor") > 3
    with pytest.raises(KeyError, match="did you mean 'tau_J'"):
        run["tau_K"]
    with pytest.raises(ValueError, match="read-only"):
        run["q"][0] = 1.0


def test_a_log_without_contacts_is_none_without_a_contact(log, tmp_path):
    called("log", "cut", log, "--topic", "/scheme", "--topic", "/events", "--out", tmp_path / "part.mcap")
    run = load(tmp_path / "part.mcap")
    assert len(run) > 0
    assert "/contact" in run.problem
    assert "/events" not in run.problem


def test_cycles_that_lack_a_topic_or_go_back_are_told(log, monkeypatch):
    raw = read_log(log, ("/scheme", "/control", "/cycle", "/contact", "/events"))
    monkeypatch.setattr("adacd_hil.lab.library.loaded_run.read_log", lambda *_: raw)
    count, cycles = len(raw.scheme), raw.topics["/cycle"]
    cycles.records = cycles.records[: count - 100].copy()
    assert (len(load(log)), load(log).problem) == (
        count - 100, "100 cycles without a record of each topic left out"
    )  # fmt: skip
    cycles.records["publish_time"][50:] -= 20_000_000
    with pytest.raises(LogError, match=r"/cycle: a cycle at 0\.\d+ s is not after the one before"):
        load(log)
    cycles.records["publish_time"][:] = 1 + np.arange(len(cycles.records))
    with pytest.raises(LogError, match="no cycle has a record of each of /scheme, /control, /cycle"):
        load(log)


def test_what_is_no_log_is_one_line(tmp_path):
    with pytest.raises(LogError, match=r"run\.mcap"):
        load(tmp_path)


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_a_data_frame_has_a_column_for_each_number_and_a_row_for_each_cycle(log, library, monkeypatch):
    run = load(log)
    assert {"t_s", "q_1", "q_2", "state"} <= set(run.columns())
    assert set(run.columns()["state"]) <= set(SchemeState.__members__)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, library, None)
        with pytest.raises(ImportError, match=rf"^to_{library} needs the extra `{library}`: .*\[{library}\]'$"):
            getattr(run, f"to_{library}")()
    pytest.importorskip(library)
    frame = getattr(run, f"to_{library}")()
    assert len(frame) == len(run)
    assert np.array_equal(np.asarray(frame["tau_J_2"]), run["tau_J"][:, 1])


def python(code: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, cwd=EXAMPLES
    )
    return ran.stdout


def test_importing_the_package_costs_nothing():
    begin = "import sys, time; begin = time.process_time(); import adacd_hil, adacd_hil.api"
    seconds, has_numpy = python(f"{begin}; print(time.process_time() - begin, 'numpy' in sys.modules)").split()
    assert float(seconds) < 0.1
    assert has_numpy == "False"


@pytest.mark.parametrize("name", api.__all__)
def test_every_name_of_the_surface_is_what_it_says(name):
    text = Path(str(api.__file__)).with_suffix(".pyi").read_text()
    module, attribute = api.PLACES[name]
    assert getattr(api, name) is getattr(import_module(module), attribute)
    imported = attribute if attribute == name else f"{attribute} as {name}"
    assert re.search(rf"from {re.escape(module)} import [^\n]*\b{re.escape(imported)}\b", text)


def test_a_name_that_is_not_of_the_surface_is_an_attribute_error():
    assert sorted(api.PLACES) == dir(api)
    with pytest.raises(AttributeError, match="has no attribute 'Pipeline'"):
        _ = api.Pipeline


@pytest.mark.long
def test_the_example_is_right_for_a_type_checker_from_outside(tmp_path):
    """The package is found by its py.typed, as an installed one is."""
    file = EXAMPLES / "api" / "compare_offline.py"
    checked = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--config-file=", "--cache-dir", str(tmp_path), str(file)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert checked.stdout.strip() == "Success: no issues found in 1 source file"


@pytest.mark.long
def test_the_example_script_runs(log):
    said = python(f"import sys; sys.argv = ['', {str(log.parent)!r}]; exec(open('api/compare_offline.py').read())")
    assert said.startswith("margin ")
