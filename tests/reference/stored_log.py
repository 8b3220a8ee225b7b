"""A log of November 2026 (0.1.0, log format 1), and the ways in which users give it to `replay`.

Users have such logs, so `logs/recovery.mcap` is never renewed; a log of a later format stands beside it. It is a run of
`certified` in lockstep at 5 ms, 3.7 s, with fit and test far too short: a push in MONITOR, a drive that faults in the
reaction, an acknowledgement, a second attempt, and torque frames that get lost.
"""

from collections.abc import Callable
from pathlib import Path

import can
from mcap.reader import make_reader

LOG = Path(__file__).parent / "logs" / "recovery.mcap"
AS_IT_IS = "as it is"
VARIED = "with other settings"
ALONE = "its frames without the log"


def _frames(folder: Path, suffix: str) -> Path:
    """Convert its frames as another program records them."""
    recording = folder / f"bus.{suffix}"
    with can.LogReader(LOG) as reader, can.Logger(recording) as writer:
        for message in reader:
            writer(message)
    return recording


def _configuration(folder: Path) -> Path:
    """Copy its configuration, without the settings that are gone."""
    with LOG.open("rb") as file:
        (stored,) = (each for each in make_reader(file).iter_attachments() if each.name == "config.toml")
    config = folder / stored.name
    lines = stored.data.decode().splitlines()
    config.write_text("\n".join(line for line in lines if not line.startswith("live")), encoding="utf-8")
    return config


WAYS: dict[str, Callable[[Path], list[object]]] = {
    AS_IT_IS: lambda _: [LOG],
    "its frames in candump's form": lambda folder: [_frames(folder, "log"), "--against", LOG],
    "its frames in BLF": lambda folder: [_frames(folder, "blf"), "--against", LOG],
    "its frames in ASC": lambda folder: [_frames(folder, "asc"), "--against", LOG],
    ALONE: lambda folder: [_frames(folder, "blf"), "--config", _configuration(folder)],
    VARIED: lambda _: [LOG, "--vary", "certified.noise_sigmas=12,13"],
}
"""By name, what stands behind `adacd-hil replay`; the folder is for files that it needs."""
