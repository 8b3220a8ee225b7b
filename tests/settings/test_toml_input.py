"""TOML of strangers: bounded in depth, numbers, time and memory, and what is wrong is one line."""

import datetime
import os
import re
import time
import tracemalloc
from pathlib import Path

import pytest

from adacd_hil.control.history_file import read_history
from adacd_hil.control.tare_file import read_tare
from adacd_hil.device.device_files import load_profile
from adacd_hil.lab.offline.recording_map import read_map
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import parse_toml, read_toml
from firmware_sim.scenario.scenario import load_scenario

DEEP = 100_000
MOST_PEAK_BYTES = 100 << 20

BOMBS = {
    "lists": ("x = " + "[" * DEEP, "more than 16 tables or lists within each other"),
    "inline tables": ("x = " + "{a=" * DEEP, "more than 16 tables or lists within each other"),
    "closed lists": ("x = " + "[" * 20 + "]" * 20, "`x`: more than 16 tables or lists within each other"),
    "a dotted key": ("a." * DEEP + "a = 1", "more than 16 tables or lists within each other"),
    "a dotted key with spaces": ("a . " * DEEP + "a = 1", "more than 16 tables or lists within each other"),
    "a dotted table": (f"[{'a.' * DEEP}a]", "more than 16 tables or lists within each other"),
    "a quoted dotted key": ('"a".' * DEEP + '"a" = 1', "more than 16 tables or lists within each other"),
    "a key of 17 parts": ("a." * 17 + "b = 1", "more than 16 tables or lists within each other"),
    "digits": ("x = " + "9" * 5000, "an integer has more than 64 bits"),
    "an integer of 65 bits": (f"x.y = {2**63}", "`x.y` is an integer of more than 64 bits"),
    "a negative one in a list": (f"x = [1, {-(2**63) - 1}]", "`x` is an integer of more than 64 bits"),
    "a hexadecimal one": ("x = 0x" + "f" * 5000, "`x` is an integer of more than 64 bits"),
}


@pytest.mark.parametrize(("text", "reason"), BOMBS.values(), ids=BOMBS)
def test_a_bomb_is_one_line_and_cheap(text, reason):
    begin_s = time.process_time()
    with pytest.raises(ConfigError) as error:
        parse_toml(text)
    assert reason in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 200
    assert time.process_time() - begin_s < 5.0  # takes 0.1 s; without the bound hours


@pytest.mark.long
@pytest.mark.slow
def test_a_long_key_with_many_below_it_takes_little_memory():
    text = f"[{'k' * 400_000}]\n" + "".join(f"a{number}=1\n" for number in range(40_000))
    tracemalloc.start()
    try:
        table = parse_toml(text)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(next(iter(table.values()))) == 40_000
    assert peak < MOST_PEAK_BYTES


def test_what_is_within_the_bounds_is_read_as_it_is():
    assert parse_toml(f"a = {2**63 - 1}\nb = {-(2**63)}") == {"a": 2**63 - 1, "b": -(2**63)}
    assert parse_toml("x = " + "[" * 15 + "1" + "]" * 15)["x"]
    assert parse_toml('about = "' + "no.key." * 20 + '"\nwhen = 1979-05-27') == {
        "about": "no.key." * 20,
        "when": datetime.date(1979, 5, 27),
    }


def test_bytes_that_are_no_text_are_named_by_their_place():
    with pytest.raises(ConfigError, match="byte 4 is not UTF-8"):
        parse_toml(b"x = \xff")


@pytest.mark.parametrize(
    ("text", "hint"),
    [("a = 0,5", "`a = 0,5`"), ("a = { b = 1, high = -8,5 }", "`high = -8,5`"), ("a = [1,2]\nb", "")],
)
def test_a_decimal_comma_is_named(text, hint):
    with pytest.raises(ConfigError) as raised:
        parse_toml(text)
    assert re.findall(r"; (`.*`): a decimal point", str(raised.value)) == [hint][: bool(hint)]


CONFIGURATIONS = {
    "arm is a number": ("arm = 5", "`arm` = 5 must be a table"),
    "profiles are a number": ("profiles = 5", "`profiles` = 5 must be a table"),
    "a profile is a number": ("[profiles]\nP = 5", "`profiles.P` = 5 must be a table"),
    "a profile is a list": ("[profiles]\nP = [1]", "`profiles.P` = [1] must be a table"),
    "a list as the chosen profile": ("[arm]\nprofile = [1]", "profile [1] is not in configuration"),
    "extends a number": ("extends = 5", "`extends` = 5 must be the name of a configuration or a file"),
    "extends a device": ('extends = "/dev/zero"', "configuration /dev/zero: it is no regular file"),
    "extends a folder": ('extends = "/"', "configuration /: it is a folder"),
    "extends a name with a NUL": ('extends = "a\\u0000b.toml"', "null byte"),
    "extends a very long name": (f'extends = "{"a" * 70_000}.toml"', "File name too long"),
    "is a section": ("name = []", "`name` = [] must be"),
    "controller is a list": ("controller = [1]", "`controller`"),
    "huge": ("# " + "x" * (1 << 20), "it has more than 1048576 bytes"),
}


@pytest.mark.parametrize(("text", "reason"), CONFIGURATIONS.values(), ids=CONFIGURATIONS)
def test_a_configuration_that_cannot_be_is_refused(text, reason, tmp_path):
    path = tmp_path / "my.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_settings(str(path))
    assert reason in str(error.value)


def test_configurations_that_extend_each_other_without_end_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number in range(12):
        (tmp_path / f"c{number}.toml").write_text(f'extends = "c{number + 1}.toml"')
    (tmp_path / "c12.toml").write_text("")
    with pytest.raises(ConfigError, match=r"configuration c0.toml extends more than 8 others"):
        load_settings("c0.toml")
    assert load_settings("c8.toml")


@pytest.mark.parametrize("load", [load_settings, load_scenario, lambda name: read_toml(Path(name))])
def test_a_fifo_or_a_device_is_no_configuration_and_no_scenario(load, tmp_path):
    fifo = tmp_path / "x.toml"
    os.mkfifo(fifo)
    for name in (str(fifo), "/dev/zero", "/dev/stdin"):
        with pytest.raises(ConfigError, match="it is no regular file"):
            load(name)


@pytest.mark.parametrize(
    ("kind", "read"),
    [
        ("configuration", lambda path: load_settings(str(path))),
        ("scenario", lambda path: load_scenario(str(path))),
        ("map", read_map),
        ("tare", read_tare),
        ("history", read_history),
        ("device profile", lambda path: load_profile(str(path), "drive")),
    ],
)
def test_an_error_says_what_kind_of_file_it_is_of(kind, read, tmp_path):
    path = tmp_path / "x.toml"
    with pytest.raises(ConfigError, match=rf"^{kind} {path} does not exist"):
        read(path)
    path.symlink_to("nowhere")
    with pytest.raises(ConfigError, match=rf"^{kind} {path} does not exist(?!.*did you mean)"):
        read(path)
    path.unlink()
    path.write_text("[broken\n")
    with pytest.raises(ConfigError, match=rf"^{kind} {path}: Expected"):
        read(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(ConfigError, match=rf"^{kind} {path}: it is a folder"):
        read(path)


def test_a_byte_order_mark_is_left_out(tmp_path):
    (tmp_path / "x.toml").write_bytes(b"\xef\xbb\xbf[filter]\r\na_rad_s = 12.5\r\n")
    assert load_settings(str(tmp_path / "x.toml")).filter.a_rad_s == 12.5
    assert parse_toml("\ufeffa = 1") == {"a": 1}


def test_a_phase_can_last_as_long_as_the_rest_that_it_needs():
    with pytest.raises(ConfigError, match=r"phase_timeout_s` = 0.2 s must be longer than .*commission_s` = 0.2 s"):
        parse(Settings, {"safety": {"phase_timeout_s": 0.2, "commission_s": 0.2}})
