"""Contacts and parameters of the offline scheme on the arrays of a run, beside those of the run itself.

python docs/examples/api/compare_offline.py runs/latest
"""

import sys

import numpy as np

from adacd_hil.api import Arm, LoadedRun, detect, load

VELOCITY_LAG_S = 1.25e-3  # of the emulated drives' tracking loops


def main(folder: str) -> None:
    """Print both lists of contacts, up to the first payload change."""
    run: LoadedRun = load(folder)
    changes = [event.t_s for event in run.events if event.message.endswith("-> PAYLOAD")]
    is_first = (run.t_s >= 0.0) & (run.t_s < min(changes, default=np.inf))
    arrays = {name: values[is_first] for name, values in run.motion.items()}
    first_s = min((contact.t_s for contact in run.contacts), default=float(arrays["t"][-1]))

    arm = Arm.from_config("certified")
    found = detect(arrays, arm, fit_s=(0.0, first_s - 0.1), velocity_lag_s=VELOCITY_LAG_S, detection_cutoff_rad_s=20.0)
    print(f"margin {found.model.margin:.2f}")
    print("run:    ", [f"{each.t_s:.3f} s link {each.report.link}" for each in run.contacts])
    print("offline:", [f"{each.t_s:.3f} s link {each.link}" for each in found.contacts])


if __name__ == "__main__":
    main(sys.argv[1])
