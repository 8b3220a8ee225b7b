"""Writes a run of the emulated arm as somebody else's CSV: degrees, mNm, 500 Hz, no velocity, the elbow's sign turned.

    adacd-hil demo --out runs/demo
    python tools/foreign_csv.py runs/demo recording.csv
    adacd-hil identify recording.csv --map docs/examples/foreign/map.toml

The last column says when somebody touched the arm, by the emulator's truth.
"""

import argparse
from pathlib import Path

import numpy as np

from adacd_hil.log.log_files import LOG_NAME, TRUTH_NAME
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.topics import SCHEME
from adacd_hil.log.types.truth_topic import TRUTH
from adacd_hil.records import SchemeState

EVERY = 2  # cycles of 1 ms
MOVING = (SchemeState.ADAPT, SchemeState.CERTIFY, SchemeState.MONITOR, SchemeState.REACT)
TURNED = np.array([1.0, -1.0])


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder with run.mcap and truth.mcap")
    parser.add_argument("csv", type=Path)
    parser.add_argument("--from", dest="start_s", type=float, default=0.0, help="since the arm first moved, s")
    parser.add_argument("--until", dest="end_s", type=float, default=np.inf, help="since the arm first moved, s")
    arguments = parser.parse_args()
    scheme = read_log(arguments.run / LOG_NAME, (SCHEME.name,)).scheme
    truth = read_log(arguments.run / TRUTH_NAME, (TRUTH.name,)).truth
    moving = np.isin(scheme["state"], [int(state) for state in MOVING])
    time_s = (scheme.t_ns - scheme.t_ns[int(np.argmax(moving))]) * 1e-9
    rows = np.flatnonzero((time_s >= arguments.start_s) & (time_s < arguments.end_s))
    rows = rows[(moving[rows]) & (scheme["cycle"][rows] % EVERY == 0)]
    touched = np.interp(scheme["cycle"][rows], truth["cycle"], truth["contact_force"]) > 0.0
    columns = [
        time_s[rows] * 1e3,
        np.degrees(scheme["q"][rows]) * TURNED,
        scheme["tau_J"][rows] * 1e3 * TURNED,
        touched,
    ]
    np.savetxt(
        arguments.csv,
        np.column_stack(columns),
        fmt=("%.3f", "%.5f", "%.5f", "%.2f", "%.2f", "%d"),
        delimiter=",",
        header="time_ms,j1_deg,j2_deg,j1_mNm,j2_mNm,touched",
        comments="",
    )


if __name__ == "__main__":
    main()
