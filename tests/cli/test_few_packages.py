"""What runs on an arm needs none of the lab's packages, and a command that needs one names it."""

import subprocess
import sys
from pathlib import Path

import pytest

LABS = ("matplotlib", "jinja2", "rosbags", "pyarrow", "websockets", "dask", "distributed", "pandas", "polars")
"""Packages that only commands of the lab import, and readers of others' recordings."""
WITHOUT = f"""
import sys
from pathlib import Path
class Absent:
    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] in {LABS}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
from adacd_hil.cli.main import main
"""
PLAY = """
from adacd_hil.cli.embedded_run import resolve, run_embedded
run_embedded(resolve("paper", "short.toml", None, None), "lockstep", Path("run"))
"""


def python(folder: Path, program: str, *words: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-c", program, *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=300)


@pytest.mark.slow
def test_without_the_labs_packages_an_arm_is_run_and_its_log_replayed(tmp_path):
    (tmp_path / "short.toml").write_text("lasts_s = 0.3\nstart_deg = [-30.0, -60.0]\n")
    played = python(tmp_path, WITHOUT + PLAY + "main(['replay', 'run', '--frames'])")
    assert (played.returncode, "identical, bit for bit" in played.stdout) == (0, True), played.stderr
    reported = python(tmp_path, WITHOUT + "main(['report', 'run'])")
    assert (reported.returncode, reported.stdout) == (2, "")
    assert "package jinja2 is not installed" in reported.stderr.splitlines()[-1]


@pytest.mark.slow
def test_a_scan_does_not_wait_for_the_compiler(tmp_path):
    program = (
        "import sys\nfrom adacd_hil.cli.main import main\n"
        "try:\n    main(['scan', '-i', 'virtual', '-c', 'x', '--seconds', '0.1'])\n"
        "finally:\n    print('numba' in sys.modules, file=sys.stderr)"
    )
    scanned = python(tmp_path, program)
    assert (scanned.returncode, scanned.stderr.splitlines()[-1]) == (5, "False")
