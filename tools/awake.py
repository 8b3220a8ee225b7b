"""How long a process is awake, from outside: builds the library to be preloaded and reads what it counts."""

import struct
from dataclasses import dataclass
from pathlib import Path

import yardstick

SOURCE = Path(__file__).resolve().parent / "awake.c"
_NUMBERS = struct.Struct("=6Q")
"""Ticks and ns at the start; ticks waited; waits; ticks and ns at some wait, every 1024 of them."""


@dataclass(frozen=True)
class Awake:
    """Looks at one process, and not at its children."""

    library: Path
    file: Path

    def environment(self) -> dict[str, str]:
        """Return what the process is to be started with; forgets the process before it."""
        self.file.unlink(missing_ok=True)
        return {"LD_PRELOAD": str(self.library), "AWAKE_FILE": str(self.file)}

    def waited_ns(self) -> float:
        """Return how long the process has waited so far, ns; NaN before it has for 1024 times."""
        try:
            numbers = _NUMBERS.unpack(self.file.read_bytes())
        except (OSError, struct.error):
            return float("nan")
        start_ticks, start_ns, waited_ticks, _, now_ticks, now_ns = numbers
        if now_ticks <= start_ticks:
            return float("nan")
        return waited_ticks * (now_ns - start_ns) / (now_ticks - start_ticks)


def build(folder: Path) -> Awake | None:
    """Compile the library into a folder; None without a C compiler. Raises CalledProcessError."""
    library, _ = yardstick.build(folder, SOURCE, "-shared", "-fPIC")
    return None if library is None else Awake(library, folder / "awake.numbers")
