"""What a user installs: the wheel holds every file that the code reads, the licences, and the types."""

import os
import platform
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
BUILD = "import sys; from hatchling.build import build_wheel; print(build_wheel(sys.argv[1]))"
DATA = sorted(
    path.relative_to(ROOT).as_posix()
    for room in ("adacd_hil", "firmware_sim")
    for path in (ROOT / room).rglob("*")
    if path.is_file() and path.suffix != ".pyc"
)


def _build(folder: Path, **variables: str) -> Path:
    built = subprocess.run(
        [sys.executable, "-c", BUILD, str(folder)],
        cwd=ROOT, env={**os.environ, **variables}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return folder / built.stdout.strip()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of this source tree."""
    return _build(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which an installer would lay the wheel's packages."""
    folder = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def _run(installed: Path, code: str, **variables: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(installed), **variables}
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=installed, env=environment, capture_output=True, text=True, check=True
    )
    return ran.stdout


MEASURE_A_FRAME = "from adacd_hil.wire.frame_time import exact_frame; exact_frame(0x181, bytes(8))"


@pytest.mark.slow
@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"), reason="nothing is compiled")
def test_machine_code_of_a_wheel_is_used_where_it_is_installed_and_compiled_no_more(tmp_path: Path) -> None:
    compiled, own = tmp_path / "compiled", tmp_path / "own"
    _run(ROOT, MEASURE_A_FRAME, NUMBA_CACHE_DIR=str(compiled))
    assert list(compiled.rglob("*.nbc"))
    installed = tmp_path / "installed"
    with zipfile.ZipFile(_build(tmp_path, ADACD_HIL_MACHINE_CODE=str(compiled))) as archive:
        archive.extractall(installed)
    _run(installed, MEASURE_A_FRAME, NUMBA_CACHE_DIR=str(own))
    assert list(own.rglob("*.nbc")) == []
    changed = installed / "adacd_hil" / "wire" / "frame_time.py"
    changed.write_text(changed.read_text() + "\n# other code\n")
    _run(installed, MEASURE_A_FRAME, NUMBA_CACHE_DIR=str(own))
    assert list(own.rglob("*.nbc"))


def test_a_wheel_with_machine_code_is_for_this_python_and_this_architecture(tmp_path: Path) -> None:
    (tmp_path / "code").mkdir()
    tags = _build(tmp_path, ADACD_HIL_MACHINE_CODE=str(tmp_path / "code")).stem.split("-")[2:]
    assert tags[0] == f"cp{sys.version_info[0]}{sys.version_info[1]}"
    assert tags[2].endswith(platform.machine())


def test_a_wheel_without_machine_code_is_for_every_python(wheel: Path) -> None:
    assert wheel.stem.split("-")[2:] == ["py3", "none", "any"]


def test_the_wheel_holds_every_file_of_the_packages_contracts_data_sheets_and_licences(installed: Path) -> None:
    held = {path.relative_to(installed).as_posix() for path in installed.rglob("*") if path.is_file()}
    assert set(DATA) - held == set()
    contracts = {name.removeprefix("adacd_hil/dbc/") for name in held if name.startswith("adacd_hil/dbc/")}
    assert contracts == {path.name for path in (ROOT / "dbc").iterdir()}
    for name in ("LICENSE", "NOTICE", "adacd_hil/lab/report/assets/uplot-1.6.32.LICENSE"):
        [licence] = installed.glob(f"*.dist-info/licenses/{name}")
        assert licence.read_bytes() == (ROOT / name).read_bytes()


def test_whatever_is_shipped_of_others_stands_in_the_notice() -> None:
    shipped = {path.name for path in (ROOT / "adacd_hil").rglob("*") if path.suffix == ".LICENSE"}
    assert {name for name in shipped if name not in (ROOT / "NOTICE").read_text()} == set()


def test_every_configuration_and_its_contract_load_where_the_wheel_is_installed(installed: Path) -> None:
    code = (
        "from adacd_hil.device.contract import load_contract\n"
        "from adacd_hil.device.device_files import place_devices\n"
        "from adacd_hil.settings.configuration_files import load_settings\n"
        "from adacd_hil.settings.toml_files import builtin_names\n"
        "for name in builtin_names():\n"
        "    own = load_settings(name); load_contract(own, place_devices(own)); print(name)"
    )
    assert _run(installed, code).split() == sorted(path.stem for path in (ROOT / "adacd_hil" / "configs").iterdir())


def test_both_commands_are_entry_points(installed: Path) -> None:
    code = (
        "from importlib.metadata import distribution\n"
        "print(*sorted(each.name for each in distribution('adacd-hil').entry_points"
        " if each.group == 'console_scripts' and callable(each.load())))"
    )
    assert _run(installed, code).split() == ["adacd-hil", "firmware-sim"]


def test_systemd_knows_every_line_of_the_unit(tmp_path: Path) -> None:
    if not (systemd := shutil.which("systemd-analyze")):
        pytest.skip("systemd-analyze isn't installed")
    text = (ROOT / "tools/deploy/adacd-hil@.service").read_text()
    unit = tmp_path / "adacd-hil@can0.service"
    unit.write_text(text.replace("/opt/adacd-hil/bin/adacd-hil", "/bin/true"))
    verified = subprocess.run([systemd, "verify", str(unit)], capture_output=True, text=True, check=True)
    assert verified.stderr == ""


def test_no_arm_moves_because_a_computer_boots_or_a_run_has_failed() -> None:
    text = (ROOT / "tools/deploy/adacd-hil@.service").read_text()
    assert "\n[Install]" not in text
    assert "\nRestart=no\n" in text


def test_the_container_copies_what_the_wheel_is_built_from() -> None:
    lines = (ROOT / "tools/deploy/Containerfile").read_text().splitlines()
    copied = {word for line in lines if line.startswith("COPY ") for word in line.split()[1:-1]}
    assert {word for word in copied if not (ROOT / word).exists()} == set()
    assert {"pyproject.toml", "README.md", "LICENSE", "NOTICE", "dbc", "adacd_hil", "firmware_sim"} <= copied


@pytest.mark.slow
def test_pip_installs_the_example_of_a_detector_and_its_name_is_known(tmp_path: Path) -> None:
    """As docs/api.md types it, but into a folder of its own, and without an index."""
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-index"]
    subprocess.run(
        [*pip, "--no-deps", "--no-build-isolation", "--target", str(tmp_path), "docs/examples/detector"],
        cwd=ROOT,
        check=True,
        timeout=120,
    )
    code = (
        "from adacd_hil.api import check_detector; from lab_detectors import MeanOfTwenty;"
        "from importlib.metadata import entry_points;"
        "(point,) = entry_points(group='adacd_hil.detectors', name='mean of 20');"
        "assert point.load() is MeanOfTwenty; check_detector('mean of 20', MeanOfTwenty); print('kept')"
    )
    assert _run(tmp_path, code, PYTHONPATH=os.pathsep.join((str(tmp_path), str(ROOT)))) == "kept\n"
