"""`adacd-hil tare`, and `adacd-hil run --tare`: the commands on the embedded bus."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from bus_lab import BUS_MISSING, OFFSET, SHORT_RUN, USAGE, Lab
from called import complaints

from adacd_hil.control.tare_file import read_tare

pytestmark = pytest.mark.slow

FAILURE = 1
REST_CYCLES = 200  # before the drives are enabled


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lab:
    return Lab(tmp_path, monkeypatch)


def test_a_tare_is_measured_stored_and_printed(lab):
    result = lab.tare("--json")
    assert result.exit_code == 0, result.stderr
    assert "measuring" in result.stderr
    printed = json.loads(result.stdout)
    stored = read_tare(lab.tare_file)
    assert (printed["file"], printed["backup"]) == (str(lab.tare_file), None)
    assert tuple(printed["offset_Nm"]) == stored.offset_Nm
    np.testing.assert_allclose(stored.offset_Nm, OFFSET, atol=0.005)
    assert stored.samples == 300


@pytest.mark.parametrize(("has_noise", "joints"), [(True, []), (False, ["joint1", "joint2"])])
def test_a_torque_that_never_changes_is_warned_of(lab, has_noise, joints):
    lab.scenario["noise"] = has_noise
    result = lab.tare()
    assert result.exit_code == 0
    assert re.findall(r"warning: the torque of (\w+) never changed", result.stdout) == joints


def test_a_second_tare_keeps_the_first_and_says_what_it_replaces(lab):
    lab.tare()
    first = read_tare(lab.tare_file)
    lab.scenario["torque_offset_Nm"] = [0.4, -0.2]
    result = lab.tare()
    assert read_tare(lab.tare_file).old_offset_Nm == first.offset_Nm
    assert read_tare(lab.tare_file.with_name("tare.toml.1")) == first
    assert f"(was {first.offset_Nm[0]:+.4f})" in result.stdout
    assert result.stdout.splitlines()[-1] == f"{lab.tare_file}; the one before is {lab.tare_file}.1"


def test_a_refused_tare_is_one_line_and_leaves_the_file_as_it_was(lab):
    lab.tare()
    before = lab.tare_file.read_bytes()
    lab.scenario["torque_offset_Nm"] = [0.3, 3.0]
    result = lab.tare()
    assert result.exit_code == FAILURE
    (line,) = complaints(result)
    assert line.startswith("adacd-hil: tare refused: offset[joint2] = 3")
    assert lab.tare_file.read_bytes() == before
    assert [path.name for path in lab.folder.iterdir() if path.name.startswith("tare")] == ["tare.toml"]


def test_a_file_that_is_no_tare_is_not_overwritten(lab):
    lab.tare_file.write_text(SHORT_RUN)
    result = lab.tare()
    assert result.exit_code == USAGE
    (line,) = complaints(result)
    assert "unknown key `operator`" in line
    assert lab.tare_file.read_text() == SHORT_RUN


def test_the_options_outweigh_the_configuration_whose_offset_a_first_tare_replaces(lab):
    lab.settings_file.write_text("[tare]\nposes = 3\nwindow_s = 5.0\n[arm]\ntorque_offset_Nm = [0.25, 0.0]\n")
    result = lab.tare("--config", str(lab.settings_file), "--poses", "1")
    assert result.exit_code == 0, result.stderr
    assert (read_tare(lab.tare_file).samples, read_tare(lab.tare_file).old_offset_Nm) == (300, (0.25, 0.0))


def test_with_the_tare_the_run_sees_no_torque_at_rest_and_the_log_holds_raw_tared_and_the_tare_itself(lab):
    lab.tare()
    result = lab.run("--tare", str(lab.tare_file))
    assert result.exit_code == 0, result.stderr
    log, offset = lab.log, read_tare(lab.tare_file).offset_Nm
    tared = log.scheme["tau_J"]
    raw = np.column_stack([log.topics[f"/decoded/Sensor{joint}Torque"]["torque"] for joint in (1, 2)])[: len(tared)]
    np.testing.assert_allclose(tared[:REST_CYCLES].mean(axis=0), 0.0, atol=4 * 0.02 * (1 / 200 + 1 / 300) ** 0.5)
    np.testing.assert_allclose(raw[:REST_CYCLES].mean(axis=0), OFFSET, atol=4 * 0.02 / 200**0.5)
    np.testing.assert_allclose(tared, raw - offset, atol=1e-12)
    assert log.attachments["tare.toml"] == lab.tare_file.read_bytes()
    assert f"torque_offset_Nm = {list(offset)}" in log.attachments["config.toml"].decode()
    assert log.metadata["tare_offset_Nm"] == f"{offset[0]!r}, {offset[1]!r}"
    assert log.metadata["tare"] == str(lab.tare_file)
    assert any(entry.event.name == "tare" and entry.event.level == "info" for entry in log.events)


def test_a_tare_of_other_sensors_is_refused_before_the_arm_is_started(lab):
    lab.tare()
    lab.serials[3] = 4711
    result = lab.run("--tare", str(lab.tare_file))
    assert result.exit_code == BUS_MISSING
    (line,) = complaints(result)
    assert line.startswith("adacd-hil: Sensor2 (node 4): serial number 4711 is not the ")
    log = lab.log
    assert log.is_complete
    assert len(log.scheme["tau_J"]) == 0


def test_an_old_tare_is_used_with_a_warning_on_the_terminal_and_in_the_log(lab):
    lab.tare()
    date = read_tare(lab.tare_file).date_utc
    lab.tare_file.write_text(lab.tare_file.read_text().replace(date, "2020-01-01T00:00:00Z"))
    result = lab.run("--tare", str(lab.tare_file))
    assert result.exit_code == 0, result.stderr
    warned = [entry.event.message for entry in lab.log.events if entry.event.name == "tare"]
    for text in (result.stderr, "".join(warned)):
        assert "more than tare.warn_age_h = 24 h" in text
