"""Everything that a cycle calls is compiled, or loaded, before the drives are enabled."""

import subprocess
import sys

import pytest

PLAYED = """
import sys
from pathlib import Path
from numba import config
from numba.core.dispatcher import Dispatcher
from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.control.cycle import Cycle

def versions():
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("adacd_hil.")]
    found = [each for module in modules for each in vars(module).values() if isinstance(each, Dispatcher)]
    return {each: len(each.overloads) for each in found}

run_cycles = Cycle.run

def run(self, recorder):
    before = versions()
    result = run_cycles(self, recorder)
    for each, count in versions().items():
        if count > before.get(each, 0):
            print(each.py_func.__module__, each.py_func.__name__)
    print("played", len(before) > 20 or bool(config.DISABLE_JIT))
    return result

Cycle.run = run
run_embedded(resolve(sys.argv[1], sys.argv[2], None, None), "lockstep", Path(sys.argv[3]))
"""
SCENARIO = """
lasts_s = 3.6
start_deg = [-30.0, -60.0]
contacts = [
  { at_s = 2.4, link = 1, point_m = 0.2, force_N = 20.0, duration_s = 0.1 },
  { at_s = 3.2, link = 2, point_m = 0.2, force_N = 15.0, duration_s = 0.2 },
]
"""


@pytest.mark.parametrize("config", ["certified", "paper"])
def test_a_contact_compiles_nothing(config, tmp_path):
    (tmp_path / "contacts.toml").write_text(SCENARIO)
    words = [config, str(tmp_path / "contacts.toml"), str(tmp_path / "run")]
    played = subprocess.run([sys.executable, "-c", PLAYED, *words], capture_output=True, text=True, check=True)
    assert played.stdout == "played True\n"
