"""Plays reference runs anew and stores what they come to; prints every difference from what was stored.

    python tests/reference/renew.py             all of them
    python tests/reference/renew.py NAME...     some
    python tests/reference/renew.py --dry       prints only

Commit the result by itself, with the print in the commit's body. Exit status: 0 nothing differs, 1 something does,
2 no such run.
"""

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from reference_runs import RUNS, Reference, bit_differences, decision_differences, names, play


def main() -> int:
    """Play, compare, store."""
    parser = argparse.ArgumentParser(description="Renews the stored reference runs and prints what differs.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"default: all; there are {', '.join(names())}")
    parser.add_argument("--dry", action="store_true", help="store nothing")
    options = parser.parse_args()
    unknown = [name for name in options.names if name not in names()]
    if unknown:
        print(f"renew: no reference run {unknown[0]!r}; there are {', '.join(names())}", file=sys.stderr)
        return 2
    differing = 0
    for name in options.names or names():
        with tempfile.TemporaryDirectory() as folder:
            now = Reference.of(play(name, Path(folder)))
        if not (RUNS / f"{name}.json").exists():
            lines = ["new"]
        else:
            stored = Reference.stored(name)
            lines = decision_differences(stored, now) + bit_differences(stored, now)
            if stored.arithmetic != now.arithmetic:
                lines.append(f"arithmetic: {stored.arithmetic} -> {now.arithmetic}")
        differing += bool(lines)
        print(f"{name}: {'; '.join(t[1] for t in now.decisions['transitions'])}", file=sys.stderr)
        for line in lines or ["as stored"]:
            print(f"{name}: {line}", flush=True)
        if not options.dry:
            now.store(name)
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
