"""A search whose result can't be written is not begun, or tells what it has found."""

import errno
import json
from pathlib import Path

import pytest
from called import called

from adacd_hil.cli.output import RESULT_HEAD, CommandError, writable_folder
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.run_settings import ExcitationSettings
from adacd_hil.settings.toml_files import parse_toml

PARTIAL, FAILURE = 3, 1
SMALL = """extends = 'certified'
[certified]
learn_every = 20
[excitation]
period_s = 2.4
cosine = [[-0.04, 0.01], [-0.04, 0.01]]
sine = [[0.0, 0.0], [0.0, 0.0]]
"""


def test_a_place_is_tried_and_left_as_it_was(tmp_path):
    (tmp_path / "old.toml").write_text(f"{RESULT_HEAD}kept")
    for out in (tmp_path / "old.toml", tmp_path / "new" / "newer" / "x.toml"):
        with writable_folder(out):
            assert not list(out.parent.glob(".*"))
    assert [path.name for path in tmp_path.iterdir()] == ["old.toml"]
    assert (tmp_path / "old.toml").read_text() == f"{RESULT_HEAD}kept"


@pytest.mark.parametrize(
    ("out", "reason"),
    [
        ("file/x.toml", ".*file is no folder"),
        ("", "it is a folder"),
        ("run.mcap", "it is a log"),
        ("mine.toml", "what is there is no result"),
        ("/proc/none/x.toml", "No such file or directory"),
    ],
)
def test_a_place_that_takes_no_file_is_said_before_the_search(out, reason, tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "mine.toml").write_text("extends = 'certified'\n")
    (tmp_path / "run.mcap").write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(CommandError, match=rf"can't be written: {reason}"), writable_folder(tmp_path / out):
        raise AssertionError("searched")


def fill(path: Path, content: str) -> None:
    """Stand for `replace_file` on a disk that has become full."""
    raise OSError(errno.ENOSPC, "No space left on device", f".{path.name}.part")


@pytest.mark.slow
@pytest.mark.parametrize("json_words", [(), ("--json",)], ids=["text", "json"])
def test_an_excitation_that_has_no_room_is_not_lost(json_words, tmp_path, monkeypatch):
    monkeypatch.setattr("adacd_hil.cli.output.replace_file", fill)
    monkeypatch.chdir(tmp_path)
    Path("small.toml").write_text(SMALL)
    words = ["excitation", "--config", "small.toml", "--seconds", "0", "--out", "found.toml", *json_words]
    done = called(*words)
    assert done.exit_code == PARTIAL, done.stderr
    assert "found.toml can't be written: No space left on device" in done.stderr.splitlines()[-1]
    if json_words:
        found = json.loads(done.stdout)["excitation"]
    else:
        found = parse_toml(done.stdout[done.stdout.index("extends = ") :])["excitation"]
    assert parse(ExcitationSettings, found).period_s > 0.0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["small.toml"]
