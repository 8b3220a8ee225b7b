"""Detectors of a lab's own: added from outside by an entry point, and refused where they break the contract."""

import sys
import tomllib

import numpy as np
import pytest
from documents import ROOT

from adacd_hil.lab.detectors import detector_registry
from adacd_hil.lab.detectors.detector_registry import ONSET_SAMPLES, channels, detectors, register, unregister
from adacd_hil.lab.detectors.detectors import DetectorBank
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings, with_todays_keys
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError, DetectorError
from adacd_hil.settings.setting_keys import apply_settings

EXAMPLE = ROOT / "docs/examples/detector"


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """The example's package, installed in a folder of its own on the path: nothing of ours is changed."""
    site = tmp_path / "site"
    install(site, EXAMPLE / "pyproject.toml", (EXAMPLE / "lab_detectors.py").read_text())
    monkeypatch.syspath_prepend(str(site))
    yield from looked_up_anew()


def looked_up_anew():
    detector_registry.forget_loaded()
    yield
    detector_registry.forget_loaded()


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


def test_the_example_passes_its_own_test(lab):
    names = {}
    exec(compile((EXAMPLE / "test_lab_detectors.py").read_text(), "example", "exec"), names)
    for name, test in names.items():
        if name.startswith("test_"):
            test()


def test_a_package_s_detector_stands_among_those_of_thresholds(lab):
    assert detectors()["mean of 20"] == [len(channels()) - 1]


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
                detector_registry.registered()


def test_a_package_that_cannot_be_imported_is_named(tmp_path, monkeypatch):
    install(tmp_path / "site", EXAMPLE / "pyproject.toml", "raise ImportError('no libfoo')\n")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    monkeypatch.delitem(sys.modules, "lab_detectors", raising=False)
    for _ in looked_up_anew():
        with pytest.raises(DetectorError, match=r"mean of 20 of package lab-detectors 1.0 .* ImportError: no libfoo"):
            detector_registry.registered()


class Broken:
    """A detector that breaks the contract in one way."""

    def __init__(self, way):
        self.way, self.count = way, 0

    def take(self, z, held_Nm):
        self.count += len(z)
        if self.way == "in place":
            held_Nm[:] = 0.0
        if self.way == "at zero":
            with np.errstate(invalid="ignore"):
                return z * z / np.abs(z)
        if self.way == "one sample":
            return np.abs(z) if len(z) > 1 else np.zeros(z.shape)
        if self.way == "late":
            return np.abs(z) if self.count < 1000 else np.full(z.shape, np.nan)
        return {"list": z.tolist(), "yes or no": z > 1.0}.get(self.way, np.abs(z))


CAUSES = {
    "in place": "changes the samples",
    "at zero": "gives nan for sample 0 of joint 1",
    "one sample": "gives sample 136 another statistic",
    "list": "gives list, an array of real numbers",
    "yes or no": "gives bool, an array of real numbers",
}


@pytest.mark.parametrize("way", CAUSES)
def test_a_detector_that_breaks_the_contract_is_refused(way):
    with pytest.raises(ValueError, match="needs a name that can be printed, not ''"):
        register("", lambda _: Broken(way))
    with pytest.raises(ValueError, match=f"^detector its name {CAUSES[way]}"):
        detector_registry.check_contract("its name", lambda _: Broken(way))


def test_a_statistic_that_stops_being_a_number_after_the_check_is_no_threshold():
    register("its name", lambda _: Broken("late"))
    try:
        bank = DetectorBank(np.zeros((2, len(ONSET_SAMPLES), 128)), 1e-3)
        bank.take_stream(np.ones((900, 2)), np.zeros((900, 2)))
        with pytest.raises(DetectorError, match=r"^detector its name .* gives nan for sample 0 of joint 1$"):
            bank.take_stream(np.ones((900, 2)), np.zeros((900, 2)))
    finally:
        unregister("its name")


OLD = {"detector": {"threshold_Nm": [0.2, 0.2], "live_lag_s": 1.25e-3, "live": [{"name": "cusum"}]}}


@pytest.mark.parametrize("key", ["live", "live_lag_s"])
def test_a_configuration_with_a_detector_in_the_loop_names_the_command_that_compares_them(key):
    with pytest.raises(ConfigError) as of_file:
        parse(Settings, {"detector": {key: OLD["detector"][key]}})
    with pytest.raises(ConfigError) as of_option:
        apply_settings(load_settings(), {f"detector.{key}": "1"})
    assert str(of_file.value) == str(of_option.value)
    assert f"`detector.{key}`" in str(of_file.value)
    assert "adacd-hil thresholds LOG... --report FOLDER" in str(of_file.value)


def test_an_older_log_with_a_detector_in_its_loop_is_read_without_it():
    assert with_todays_keys(OLD) == {"detector": {"threshold_Nm": [0.2, 0.2]}}
