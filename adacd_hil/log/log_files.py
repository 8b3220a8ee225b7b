"""The files of a log: their names, the words in their headers and summaries, and their errors."""

import platform
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class LogError(Exception):
    """A log that can't be written or read; the message is one line: file, reason."""


class LogExistsError(LogError):
    """A log that would have to take the place of another; the message is one line."""


@contextmanager
def failing_as(what: str) -> Iterator[None]:
    """Turn an OSError in the block into a LogError of one line.

    what: the failed operation, with which the line begins.
    """
    try:
        yield
    except OSError as error:
        raise LogError(f"{what}: {error.strerror or error}") from None


PRODUCT = "adacd-hil"
ROBOT_NAME, LAYOUT_NAME = "robot.urdf", "viewer-layout.json"
"""The viewers' files, in a log and beside it: the arm's URDF, and the layout of the panels."""
RUN_METADATA = "run"
SUMMARY_METADATA = "summary"
EPOCH_KEY = "epoch_ns"
"""Of the metadata `run`: offset of the times in the file from t_ns."""
PART_KEY = "part"
"""Of the metadata `run`: number of the part, from 0."""
ENDING_KEY = "ending"
"""Of the summary: why the part ended."""
CLOSED, CONTINUED = "closed", "continued"
"""The endings of a log that was ended as asked, and of a part that another follows."""
ROS_PROFILE = "ros2"
"""Of the header: every channel is CDR with a schema of ROS 2, so rosbags and rosbag2 take the file."""
QOS_KEY = "offered_qos_profiles"
"""Channel metadata that the profile requires; there was no offer."""
FIELDS_KEY = "fields"
"""Channel metadata: our names of the fields, which ROS would have in lower case."""
CONFIG_NAME, DBC_NAME, TARE_NAME, HISTORY_NAME = "config.toml", "arm.dbc", "tare.toml", "history.toml"
"""Attachments of a run's log: the resolved configuration, the DBC; tare and history, if they are used."""
SCENARIO_NAME = "scenario.toml"
"""Attachment of the emulator's log: the resolved scenario."""
SUFFIX = ".mcap"
LOG_NAME = f"run{SUFFIX}"
"""The host's log."""
TRUTH_NAME = f"truth{SUFFIX}"
"""The emulator's."""
EMBEDDED = "embedded"
"""The interface that a log names where the arm is emulated in the host's own process."""
SCRIPTED = "script"
"""The metadata `operator` of a run whose user the configuration scripts and can't type."""
CONFIG_DIGEST_KEY = "host_config_sha256"
"""Metadata of the emulator's log where the host is in the same process: of its configuration."""
MOST_VIEWERS = 8
"""Viewers of a run's live view at a time, unless --live-viewers says otherwise."""
SHOWN = 20
"""Mismatches, gaps and notes that are listed, of mismatches unless --shown says otherwise; all are counted."""
_DIGITS, _MOST_DIGITS = 3, 5


def part_path(path: Path, number: int) -> Path:
    """Return the path of part `number` of the log `path`, such as run_001.mcap; part 0 is `path` itself."""
    return path.with_name(f"{path.stem}_{number:0{_DIGITS}d}{path.suffix}") if number else path


def is_part_name(path: Path) -> bool:
    """Return whether a path is named as a further part, such as run_001.mcap, of a log in the same folder."""
    match = re.fullmatch(rf"(.+)_\d{{{_DIGITS},{_MOST_DIGITS}}}", path.stem)
    return match is not None and path.with_name(f"{match[1]}{path.suffix}").exists()


def find_parts(path: Path) -> dict[int, Path]:
    """Return the paths of the existing parts of the log `path`, by number in ascending order; {} without any.

    Raises OSError if the folder can't be listed.
    """
    pattern = re.compile(rf"{re.escape(path.stem)}_(\d{{{_DIGITS},{_MOST_DIGITS}}}){re.escape(path.suffix)}")
    matches = (pattern.fullmatch(entry.name) for entry in path.parent.iterdir())
    numbers = {int(match[1]) for match in matches if match}
    if path.exists():
        numbers.add(0)
    named = {number: part_path(path, number) for number in sorted(numbers)}
    return {number: part for number, part in named.items() if part.exists()}


def arithmetic() -> dict[str, str]:
    """Return machine, Python and library versions by name, for a log's metadata.

    Two machines with the same ones compute the same bits if their processors have AVX2 and FMA.
    """
    from importlib.metadata import version  # costs 20 ms, and most importers don't need it

    return {
        "machine": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "numba": version("numba"),
    }
