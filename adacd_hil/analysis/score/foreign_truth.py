"""Whether the emulator's log beside a run's log is of that run, as far as both say what was played."""

import hashlib
import json
from pathlib import Path

from adacd_hil.log.editing.log_info import attachment, run_metadata
from adacd_hil.log.log_files import CONFIG_DIGEST_KEY
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import parse_toml

_PLAYED = ("scenario", "seed")


def foreign_truth(log: Path, truth: Path) -> str:
    """Say in one line why a truth is of another run than a log; "" where nothing says so.

    Both name scenario and seed where one process played host and arm, and the truth has a digest of the host's
    configuration: in lockstep, the same three make the same run. On a bus the host doesn't know what is played.
    """
    ours, theirs = run_metadata(log), _played(truth)
    for key in _PLAYED:
        if key in ours and key in theirs and ours[key] != theirs[key]:
            return f"{truth} is of another run: its {key} is {theirs[key]}, the log's {ours[key]}"
    config = attachment(log, "config.toml")
    if CONFIG_DIGEST_KEY in theirs and config is not None and theirs[CONFIG_DIGEST_KEY] != _digest(config):
        return f"{truth} is of another run: its host had another configuration"
    return ""


def config_digest(config: str) -> str:
    """Give the digest by which a truth names its host's configuration. Raises ConfigError.

    Of `realtime` a session makes what the host grants, so that it doesn't count.
    """
    table = {key: value for key, value in parse_toml(config).items() if key != "realtime"}
    return hashlib.sha256(json.dumps(table, sort_keys=True, default=str).encode()).hexdigest()


def _digest(config: bytes) -> str | None:
    try:
        return config_digest(config.decode("utf-8", "replace"))
    except ConfigError:
        return None  # who reads the log says so


def _played(truth: Path) -> dict[str, str]:
    """Give what a truth says of itself: of old, the scenario was attached only."""
    said = run_metadata(truth)
    try:
        table = parse_toml(attachment(truth, "scenario.toml") or b"")
    except ConfigError:
        return said
    attached = {"scenario": table.get("name"), "seed": table.get("seed")}
    return {key: str(value) for key, value in attached.items() if value is not None} | said
