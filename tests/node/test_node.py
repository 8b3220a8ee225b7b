"""Our logs through MCAP's TypeScript reader, which checks every CRC, and the decoder of Foxglove and Lichtblick."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "log"))

from recorded_run import make_run, record  # noqa: E402

from adacd_hil.log.reader import read_log  # noqa: E402

pytestmark = pytest.mark.slow

FILES = ("package.json", "package-lock.json", "check.mjs")
UNREACHABLE = re.compile(r"\b(ENOTFOUND|EAI_AGAIN|ECONNREFUSED|ECONNRESET|ETIMEDOUT|ENETUNREACH)\b")


@pytest.fixture(scope="module")
def checker():
    """The check with its packages, installed once per version of it outside the source tree."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("node and npm are not installed")
    digest = hashlib.sha256(b"".join((HERE / name).read_bytes() for name in FILES)).hexdigest()[:16]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = cache / "adacd-hil" / f"node-check-{digest}"
    if not (folder / "installed").exists():
        folder.mkdir(parents=True, exist_ok=True)
        for name in FILES:
            shutil.copy(HERE / name, folder / name)
        command = [npm, "ci", "--no-audit", "--no-fund", "--ignore-scripts"]
        result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if result.returncode != 0 and UNREACHABLE.search(result.stderr):
            pytest.skip("npm can't reach its registry")
        assert result.returncode == 0, result.stderr
        (folder / "installed").touch()
    return [node, str(folder / "check.mjs")]


@pytest.fixture(scope="module")
def log_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("node") / "run.mcap"
    record(path, make_run(400, has_fd=True))
    return path


@pytest.fixture(scope="module")
def report(checker, log_path):
    result = subprocess.run([*checker, str(log_path)], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_every_message_is_there_with_every_crc_right(report, log_path):
    log = read_log(log_path)
    counts = {topic: int(entry["count"]) for topic, entry in report["topics"].items()}
    assert sum(counts.values()) == int(log.summary["messages"])
    assert int(report["indexed"]) == int(log.summary["messages"])
    assert {topic: counts[topic] for topic in ("/scheme", "/control", "/cycle", "/joint_states")} == dict.fromkeys(
        ("/scheme", "/control", "/cycle", "/joint_states"), 400
    )
    assert sum(counts[f"/{way}_can_bus{kind}"] for way in ("to", "from") for kind in ("", "_fd")) == len(log.frames)
    for topic, series in log.topics.items():
        assert "/decoded/" not in topic or counts[topic] == len(series)


def test_numbers_decode_to_the_same_values(report, log_path):
    log = read_log(log_path)
    own = {f"/{name}": getattr(log, name) for name in ("scheme", "control", "cycle")}
    compared = 0
    for topic, series in (
        own | {topic: s for topic, s in log.topics.items() if "/decoded/" in topic and len(s)}
    ).items():
        last = report["topics"][topic]["last"]
        for name in series.fields:
            theirs = np.array(last[name.lower()], dtype=float)
            np.testing.assert_array_equal(theirs, series[name][-1].astype(float), err_msg=name)
            compared += 1
    assert compared > 40
