"""Remedies in messages: a slip of the pen is recognised, an unrelated name is not, commands can be typed as said."""

import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest

from adacd_hil import extras
from adacd_hil.extras import install_command
from adacd_hil.remedies import nearest_name
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import SUCCESSORS, parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.setting_keys import apply_settings

KEYS = ("a_rad_s", "b_rad_s", "threshold_Nm", "torque_limit_Nm", "torque_rate_limit_Nm_s", "Kp", "Kd", "condition")
DOTTED = ("filter.a_rad_s", "detector.threshold_Nm", "certified.condition", "certified.noise_sigmas")


@pytest.mark.parametrize(
    ("word", "known", "meant"),
    [
        ("a_rads", KEYS, "a_rad_s"),
        ("threshold", KEYS, "threshold_Nm"),
        ("treshold_nm", KEYS, "threshold_Nm"),
        ("torque_limit", KEYS, "torque_limit_Nm"),
        ("kp", KEYS, "Kp"),
        ("amr", ("stock", "arm"), "arm"),
        ("sockecan", ("slcan", "socketcan", "socketcand"), "socketcan"),
        ("detectr.threshold_Nm", DOTTED, "detector.threshold_Nm"),
        ("detector.treshold", DOTTED, "detector.threshold_Nm"),
        ("deviations", KEYS, None),
        ("K", KEYS, None),
        ("detector", DOTTED, None),
        ("", KEYS, None),
        ("x" * 10**6, ("x" * 10**6,), None),
        ("a", (), None),
    ],
)
def test_the_nearest_name_is_one_that_may_have_been_meant(word: str, known: tuple[str, ...], meant: str | None) -> None:
    assert nearest_name(word, known) == meant


@pytest.mark.parametrize("key", sorted(SUCCESSORS))
def test_a_key_that_is_gone_names_its_successor_and_nothing_else(key: str) -> None:
    section, name = key.split(".")
    line = f"unknown key `{key}`; its successor is {SUCCESSORS[key]}"
    with pytest.raises(ConfigError) as of_file:
        parse(Settings, {section: {name: 1.0}})
    with pytest.raises(ConfigError) as of_option:
        apply_settings(load_settings(), {key: "1.0"})
    assert str(of_file.value) == str(of_option.value) == line
    for successor in SUCCESSORS[key].replace("`", "").split(" and "):
        section, name = successor.split(".")
        assert hasattr(getattr(load_settings("certified"), section), name)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[filter]\nreversal_share = 1", "unknown key `filter.reversal_share`; known: a_rad_s, b_rad_s"),
        ("flux = 1", "unknown key `flux`; known: name, scheme, arm, "),
    ],
)
def test_an_unrelated_key_gets_the_known_ones(text: str, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(Settings, tomllib.loads(text))
    assert str(caught.value).startswith(line)


@pytest.mark.parametrize(
    ("key", "line"),
    [
        ("filter.flux", "unknown key `filter.flux`; `filter` has a_rad_s, b_rad_s"),
        ("flux", "unknown key `flux`; it begins with a section: name, scheme, arm, "),
        ("filter", "`filter` is a section; its keys are filter.a_rad_s, filter.b_rad_s"),
        ("collision_Nm", "unknown key `collision_Nm`; did you mean `detector.collision_Nm`?"),
    ],
)
def test_an_unrelated_option_gets_what_its_section_has(key: str, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        apply_settings(load_settings(), {key: "1.0"})
    assert str(caught.value).startswith(line)


ROOT = Path(__file__).resolve().parent.parent


def test_in_a_clone_it_is_the_line_of_the_documents(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "executable", str(ROOT / ".venv" / "bin" / "python"))
    monkeypatch.setattr(Path, "exists", lambda path: path.name == "pip")
    assert install_command("live") == ".venv/bin/pip install -e '.[live]'"


def test_from_elsewhere_it_names_the_clone_and_a_pip_that_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    program, *words = shlex.split(install_command("sweep"))
    assert Path(program).is_file()
    assert words[-3:] == ["install", "-e", f"{ROOT}[sweep]"]


def test_without_a_source_tree_it_names_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "_SOURCE_TREE", tmp_path)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "bin" / "python"))
    monkeypatch.chdir(tmp_path)
    assert install_command("mf4") == "bin/python -m pip install 'adacd-hil[mf4]'"


def test_every_extra_that_is_named_is_one() -> None:
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {
        name
        for path in (ROOT / "adacd_hil").rglob("*.py")
        for name in re.findall(r"install_command\(['\"](\w+)", path.read_text())
    }
    assert named == {"live", "sweep", "tables", "mf4"}
    assert named | {"pandas", "polars"} <= set(known)  # `LoadedRun` names the one that it converts to
