"""`adacd-hil run --history` and `adacd-hil history`: the commands on the embedded bus."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from bus_lab import BUS_MISSING, USAGE, Lab, answered
from called import called, complaints

from adacd_hil.cli.commands.run_command import ask_first_run
from adacd_hil.clock import wall_ns
from adacd_hil.control.history_file import (
    HISTORY_FORMAT,
    CertificateRecord,
    History,
    Origin,
    UsedHistory,
    devices_digest,
    read_history,
    use_history,
)
from adacd_hil.dates import date_ns
from adacd_hil.device.network import Identity
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import parse_toml
from adacd_hil.settings.toml_text import to_toml

pytestmark = pytest.mark.slow

CERTIFIED = 'extends = "certified"\n[operator]\nscript = [{at_s = 3.5, request = "finish"}]\n'


def certified_lab(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Lab:
    lab = Lab(folder, monkeypatch)
    lab.scenario["torque_offset_Nm"] = [0.0, 0.0]
    lab.settings_file.write_text(CERTIFIED)
    return lab


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lab:
    return certified_lab(tmp_path, monkeypatch)


@pytest.fixture(scope="module")
def first_history(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What a first run leaves."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        lab = certified_lab(tmp_path_factory.mktemp("first"), monkeypatch)
        path = lab.folder / "arm.toml"
        result = lab.run("--history", str(path))
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["history"] == f"{path}: 1 more, 1 in all"
    return path.read_text()


@pytest.fixture
def file(lab: Lab, first_history: str) -> Path:
    """The history that a first run has left."""
    path = lab.folder / "arm.toml"
    path.write_text(first_history)
    return path


def test_a_run_adds_its_certificate_and_the_next_one_is_compared_with_it(lab, file, first_history):
    first = read_history(file).last
    assert first.text.endswith("by this run only")
    result = lab.run("--history", str(file))
    assert result.exit_code == 0, result.stderr
    one, two = read_history(file).certificates
    assert one == first
    assert two.text.endswith(f"within what the certificate of {first.date_utc} allows")
    log = lab.log
    assert log.metadata["history_certificates"] == "1 certificate"
    assert log.attachments["history.toml"] == first_history.encode()
    assert parse_toml(log.attachments["config.toml"])["history"]["friction_Nm"] == list(first.friction_Nm)
    replayed = called("replay", lab.folder / "run.mcap")
    assert "identical, bit for bit" in replayed.stdout + replayed.stderr


def test_devices_with_other_serial_numbers_are_another_arms(lab, file):
    before = file.read_bytes()
    lab.serials[1] = 4711
    result = lab.run("--history", str(file))
    assert result.exit_code == BUS_MISSING
    (line,) = complaints(result)
    assert "serial number 4711 is not the 2" in line
    assert line.endswith(f"of history {file}: it is another arm's")
    assert file.read_bytes() == before


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("friction_Nm = [0.", "friction_Nm = [1.", "changed or damaged"),
        ("serial = 2", "serial = 3", "certificate 1 was changed or damaged"),
        ("certificates = [", "certificate = [", "did you mean `certificates`?"),
        ("format = 1", "format = 2", "`format` = 2 is above 1"),
        ('date_utc = "', 'date_utc = "x', "arm.toml: certificate 1: date_utc is not like 2026-01-31T12:00:00Z"),
    ],
)
def test_a_file_that_is_not_as_it_was_written_is_refused_in_one_line(lab, file, old, new, says):
    file.write_text(file.read_text().replace(old, new, 1))
    for result in (lab.run("--history", str(file)), called("history", file)):
        assert result.exit_code == USAGE
        (line,) = complaints(result)
        assert says in line


def test_a_certificate_is_not_added_to_what_another_arm_has_made_meanwhile(lab, first_history):
    path = lab.folder / "arm.toml"
    used = use_history(path, wall_ns())
    path.write_text(first_history)
    devices = read_history(path).devices
    mine = [Identity(**asdict(replace(device, serial=device.serial + 100))) for device in devices]
    with pytest.raises(ConfigError, match=r"serial number 101 is not the 1 of history .*: it is another arm's"):
        used.add_certificates((), mine, Origin("2026-11-22T10:00:00Z", "run.mcap", "P", "1"))
    assert path.read_text() == first_history


def test_the_picture_replaces_an_earlier_one_and_nothing_else(file, first_history):
    picture, other = file.with_name("arm.png"), file.with_name("other.toml")
    other.write_text(first_history)
    picture.touch()  # an empty file is nobody's
    for _ in range(2):
        assert called("history", file, "--plot", picture).exit_code == 0
    for taken in (other, file):
        result = called("history", file, "--plot", taken)
        assert result.exit_code == USAGE
        assert taken.read_text() == first_history


def test_the_chain_of_digests_notices_a_certificate_that_is_missing_or_moved(file):
    found = read_history(file)
    second = replace(found.last, date_utc="2030-01-01T00:00:00Z")
    second = replace(second, digest=second.digest_after(found.last.digest))
    assert len(History(HISTORY_FORMAT, found.devices, (found.last, second)).certificates) == 2
    for certificates in ((second,), (second, found.last), (found.last, found.last)):
        with pytest.raises(ValueError, match="changed or damaged"):
            History(HISTORY_FORMAT, found.devices, certificates)


def test_a_certificate_that_lacks_values_is_refused_though_its_digest_is_right(file):
    last = read_history(file).last
    with pytest.raises(ValueError, match="friction_Nm has 5 values, 6 expected"):
        replace(last, friction_Nm=last.friction_Nm[1:])
    with pytest.raises(ValueError, match="inertia_kgm2 has 3 values, 0 expected"):
        replace(last, date_utc="", friction_Nm=(), friction_std_Nm=())


def test_values_that_no_arm_has_are_refused_though_their_digest_is_right(file, monkeypatch):
    found = read_history(file)
    with monkeypatch.context() as forger:
        forger.setattr(CertificateRecord, "__post_init__", lambda self: None)
        forged = replace(found.last, friction_Nm=(1e9,) * 6)
        forged = replace(forged, digest=forged.digest_after(devices_digest(found.devices)))
        file.write_text(to_toml(History(HISTORY_FORMAT, found.devices, (forged,))))
    with pytest.raises(ConfigError, match=r"friction_Nm\[0\]` = 1000000000.0 Nm is above 1000 Nm"):
        read_history(file)


def test_the_older_a_certificate_the_less_its_zero_is_known(file):
    last = read_history(file).last
    settings = load_settings("certified")
    fresh, old = (
        use_history(file, date_ns(last.date_utc) + round(age_s * 1e9)).apply(settings).history.offset_std_Nm
        for age_s in (0.0, 30 * 86400.0)
    )
    warmed, walked = 1e-3 * 5.0, 2e-5 * (30 * 86400.0) ** 0.5
    np.testing.assert_allclose(fresh, np.hypot(last.offset_std_Nm, warmed))
    np.testing.assert_allclose(old, np.hypot(fresh, walked))


def test_a_certificate_of_the_future_is_refused(file):
    with pytest.raises(ConfigError, match="h ahead of this clock"):
        use_history(file, 1_000_000_000)


def test_it_is_listed_printed_and_drawn(lab, file):
    picture = lab.folder / "history.png"
    listed = called("history", file, "--plot", picture)
    assert listed.exit_code == 0
    last = read_history(file).last
    assert last.date_utc in listed.stdout
    assert f"{last.friction_Nm[1]:.3f}" in listed.stdout
    assert "Sensor1" in listed.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
    printed = json.loads(called("history", file, "--json").stdout)
    assert printed == json.loads(json.dumps(asdict(read_history(file))))


def test_a_run_without_a_certificate_adds_nothing(lab):
    lab.settings_file.write_text(CERTIFIED.replace("3.5", "0.5"))
    path = lab.folder / "arm.toml"
    result = lab.run("--history", str(path))
    assert "history" not in json.loads(result.stdout)
    assert not path.exists()
    assert called("history", path).exit_code == USAGE


def test_a_history_that_cannot_be_written_is_partial_and_says_so(lab):
    blocker = lab.folder / "blocker"
    blocker.write_text("no folder")
    result = lab.run("--history", str(blocker / "arm.toml"))
    assert result.exit_code == 3
    (line,) = complaints(result)
    assert line.startswith("adacd-hil: the certificate is not in the history:")


@pytest.mark.parametrize(("answer", "is_started"), [("y\n", True), ("n\n", False), ("\n", False)])
def test_before_a_first_run_the_user_says_that_nobody_touches_the_arm(monkeypatch, answer, is_started):
    result = answered(monkeypatch, lambda: ask_first_run(UsedHistory(Path("arm.toml"), b"", None)), answer)
    assert (result.exit_code, "started" in result.stdout) == (0 if is_started else 1, is_started)
    assert "this is the arm's first run" in result.stderr
