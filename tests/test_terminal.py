"""What reaches a terminal, a pipe or a full disk, and who may leave, block or fail without harm."""

import fcntl
import io
import os
import pty
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from experiment_runs import BIN, PAPER
from hang import HANG_S
from long_cases import long_but

from adacd_hil.lab.cli.monitor_command import Screen
from adacd_hil.log.reader import read_log
from adacd_hil.printable import in_line, one_line, plain
from adacd_hil.progress_lines import Progress
from adacd_hil.records import Event
from adacd_hil.table_layout import fit_table
from adacd_hil.terminal import Terminal, for_people, has_colour, terminal_columns
from firmware_sim.bench.bench_time import TruthLog

OK, USAGE, PARTIAL, INTERRUPTED = 0, 2, 3, 130
LONG = ([BIN / "adacd-hil", "budget", "--json"], [BIN / "firmware-sim", "list", "--json"])
"""They print more than a small pipe takes, and need no bus."""
EVIL = "x\x1b]0;owned\x07\udc80"
WRITE_AND_EXIT = """
import sys
from adacd_hil.terminal import open_terminals
open_terminals()
for number in range(3000):
    print("line", number)
    print("progress", number, file=sys.stderr)
"""


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain text, ünïcödé θ̂ ±0.1 Nm\tok\n", "plain text, ünïcödé θ̂ ±0.1 Nm\tok\n"),
        ("\x1b]0;title\x07\x1b[2J", "\\u001b]0;title\\u0007\\u001b[2J"),
        ("done\rFAILED", "done\\u000dFAILED"),
        ("\x9b31m\x7f\x00\x08", "\\u009b31m\\u007f\\u0000\\u0008"),
        ("left\u202eright\u2066\u2028", "left\\u202eright\\u2066\\u2028"),
    ],
)
def test_control_characters_are_escaped_and_nothing_else(text: str, shown: str) -> None:
    assert plain(text) == shown


def test_an_error_is_one_line_that_can_be_read() -> None:
    assert one_line("a\n  b\x1b\r\n") == "a b\\u001b"
    assert one_line("9" * 10**6) == "9" * 2000 + " …"


def test_what_is_within_a_line_ends_none() -> None:
    assert in_line("good\nerror: forged\r\n\tx\x1b[2J") == ("good\\u000aerror: forged\\u000d\\u000a\\u0009x\\u001b[2J")
    assert fit_table([("name", "text"), ("a\nb", "c"), ("d", "\x1b[2Je\tf")]) == [
        "name      text",
        "a\\u000ab  c",
        "d         \\u001b[2Je\\u0009f",
    ]


def test_progress_is_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress() as progress:
        progress("arm \n0.000 s  forged")
    assert capsys.readouterr().err == "arm \\u000a0.000 s  forged\n"


def test_a_table_that_is_redrawn_moves_the_cursor_by_its_own_sequences_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    written: list[str] = []
    screen = Screen(True, written.append)
    screen.draw_table("name\x1b[2J\nother\x0c")
    screen.end("name\x1b[2J")
    assert "".join(written) == "\x1b[H\x1b[Kname\\u001b[2J\n\x1b[Kother\\u000c\n\x1b[J\x1b[H\x1b[Jname\\u001b[2J\n"


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "status", "line"),
    [
        (("adacd-hil", "log", "info", "EVIL.mcap"), 1, "SHOWN.mcap can't be read: No such file"),
        (("adacd-hil", "log", "info", "EVIL/truth.mcap"), 0, "SHOWN/truth.mcap: "),
        (("firmware-sim", "show", "EVIL.toml"), 2, "SHOWN.toml does not exist"),
        (("firmware-sim", "check", "EVIL.toml"), 2, "SHOWN.toml"),
    ],
)
def test_a_name_reaches_a_terminal_as_plain_text(
    words: tuple[str, ...], status: int, line: str, tmp_path: Path
) -> None:
    (tmp_path / EVIL).mkdir()
    with TruthLog(tmp_path / EVIL / "truth.mcap", blocking=True) as log:
        log.event(0, Event("info", "run", "begun"))
    ours, theirs = os.openpty()
    program, *rest = (word.replace("EVIL", EVIL) for word in words)
    environment = {**os.environ, "NO_COLOR": "1"}  # else our own colours are escape sequences, too
    done = subprocess.run(
        [BIN / program, *rest], stdout=theirs, stderr=theirs, check=False, cwd=tmp_path, env=environment
    )
    os.close(theirs)
    shown = os.read(ours, 65536).decode()
    os.close(ours)
    assert done.returncode == status
    assert line.replace("SHOWN", "x\\u001b]0;owned\\u0007\\udc80") in shown
    assert "\x1b" not in shown
    assert "\x07" not in shown


@pytest.fixture
def small_pipe() -> Iterator[tuple[int, int]]:
    """Both ends of a pipe that takes a page."""
    left, right = os.pipe()
    fcntl.fcntl(right, fcntl.F_SETPIPE_SZ, 4096)
    yield left, right
    for descriptor in (left, right):
        os.close(descriptor)


def wait_until_full(pipe: int, process: "subprocess.Popen[bytes]") -> None:
    """Wait until a pipe takes nothing more; the test's time limit ends it."""
    poll = select.poll()
    poll.register(pipe, select.POLLOUT)
    while poll.poll(0):
        assert process.poll() is None
        os.sched_yield()


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("is_both", [False, True], ids=["stdout", "both"])
@pytest.mark.parametrize("command", LONG, ids=lambda command: command[0].name)
def test_an_output_that_blocks_ends_with_ctrl_c(command: list[str], is_both: bool, small_pipe: tuple[int, int]) -> None:
    _, right = small_pipe
    said = right if is_both else subprocess.PIPE
    with subprocess.Popen(command, stdout=right, stderr=said) as process:
        wait_until_full(right, process)
        process.send_signal(signal.SIGINT)
        complaint = process.communicate(timeout=HANG_S)[1]
    expected = {"adacd-hil": (INTERRUPTED, b"adacd-hil: interrupted\n"), "firmware-sim": (OK, b"")}[command[0].name]
    assert process.returncode == expected[0]
    assert is_both or complaint.lstrip() == expected[1]


@pytest.mark.parametrize("blocked", ["the output", "another thread"])
def test_a_write_waits_for_half_a_second_after_the_request_to_end(blocked: str, small_pipe, monkeypatch) -> None:
    waits_ms: list[float] = []
    stream = Terminal(small_pipe[1], "output", is_needed=True)
    stream.hurry()
    if blocked == "the output":
        poll = SimpleNamespace(register=lambda *_: None, poll=waits_ms.append)
        monkeypatch.setattr(select, "poll", lambda: poll)
    else:
        lock = SimpleNamespace(acquire=lambda timeout: waits_ms.append(1e3 * timeout))
        monkeypatch.setattr(stream, "_lock", lock)
    stream.write("x")
    assert sum(waits_ms) == 500.0


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    long_but(
        1, [*LONG, *([BIN / name, *words] for name in ("adacd-hil", "firmware-sim") for words in (("--help",), ("x",)))]
    ),
    ids=lambda command: " ".join(map(str, command[1:])),
)
def test_a_reader_that_goes_away_is_no_error(command: list[str], small_pipe: tuple[int, int]) -> None:
    usual = subprocess.run(command, capture_output=True, check=False)
    left, right = os.pipe()
    os.close(left)
    assert subprocess.run(command, stdout=right, stderr=right, check=False).returncode == usual.returncode
    gone = subprocess.run(command, stdout=right, stderr=subprocess.PIPE, check=False)
    os.close(right)
    assert (gone.returncode, gone.stderr) == (usual.returncode, usual.stderr)


def test_nothing_is_written_twice_or_lost_before_the_reader_goes() -> None:
    done = subprocess.run([sys.executable, "-c", WRITE_AND_EXIT], capture_output=True, check=True)
    assert done.stdout == b"".join(b"line %d\n" % number for number in range(3000))
    assert done.stderr == b"".join(b"progress %d\n" % number for number in range(3000))


@pytest.mark.slow
@pytest.mark.parametrize("words", [("budget",), ("--help",), ("log", "--help")])
def test_results_on_a_full_disk_are_partial(words: tuple[str, ...]) -> None:
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run([BIN / "adacd-hil", *words], stdout=full, stderr=subprocess.PIPE, check=False)
    assert done.returncode == PARTIAL
    assert done.stderr == b"adacd-hil: standard output can't be written: No space left on device\n"


@pytest.mark.long
@pytest.mark.slow
def test_words_on_a_full_disk_or_to_nobody_cost_a_run_nothing(tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text("lasts_s = 0.3\n")
    command = [BIN / "adacd-hil", "demo", *PAPER, "--scenario", "short.toml", "--out", "run", "--json"]
    left, right = os.pipe()
    os.close(left)
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(command, stdout=right, stderr=full, check=False, cwd=tmp_path)
    os.close(right)
    assert done.returncode == OK
    assert read_log(tmp_path / "run").is_complete
    assert (tmp_path / "run" / "report.html").is_file()


WRITE_BESIDE = """
import sys
from adacd_hil.terminal import open_terminals
open_terminals()
file = open(sys.argv[1], "w")
print("not for that file")
sys.exit(file.fileno() < 3)
"""


@pytest.mark.slow
def test_closed_streams_lend_their_numbers_to_no_file(tmp_path: Path) -> None:
    checked = ["sh", "-c", '"$0" check "$1" <&- >&- 2>&-', BIN / "firmware-sim", tmp_path / "none.toml"]
    assert subprocess.run(checked, check=False).returncode == USAGE
    written = ["sh", "-c", '"$0" -c "$1" "$2" >&-', sys.executable, WRITE_BESIDE, tmp_path / "x"]
    assert subprocess.run(written, check=False).returncode == OK
    assert (tmp_path / "x").read_text() == ""


LOSE_INTERRUPT = """
import ctypes, signal
from adacd_hil.terminal import open_terminals
open_terminals()
lost = []
def interrupt():
    lost.append(1)
    signal.raise_signal(signal.SIGINT)
    lost.append(2)
try:
    ctypes.CFUNCTYPE(None)(interrupt)()
    assert lost == [1]
    for _ in range(10**8):  # some seconds
        pass
except KeyboardInterrupt:
    print("ended")
"""


def test_ctrl_c_in_what_raises_nothing_is_not_lost_and_no_traceback() -> None:
    command = [sys.executable, "-c", LOSE_INTERRUPT]
    done = subprocess.run(command, capture_output=True, check=False, timeout=HANG_S)
    assert (done.returncode, done.stdout, done.stderr) == (OK, b"ended\n", b"")


@pytest.mark.parametrize(
    ("told", "columns"),
    [("97", 97), (None, None), ("0", None), ("-5", None), ("x", None), ("", None), ("9" * 400, None)],
    ids=lambda value: str(value)[:4],
)
def test_columns_are_those_of_the_environment_where_there_is_no_terminal(told, columns, monkeypatch) -> None:
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    monkeypatch.delenv("COLUMNS", raising=False)
    if told is not None:
        monkeypatch.setenv("COLUMNS", told)
    assert terminal_columns() == columns
    assert terminal_columns(io.StringIO()) is None  # errors are lines for programs


@pytest.mark.parametrize(
    ("environment", "is_terminal", "has_them"),
    [
        ({"TERM": "xterm"}, True, True),
        ({"TERM": "xterm"}, False, False),
        ({"TERM": "dumb"}, True, False),
        ({}, True, False),
        ({"TERM": "xterm", "NO_COLOR": "1"}, True, False),
        ({"TERM": "xterm", "NO_COLOR": ""}, True, True),
        ({"FORCE_COLOR": "1"}, False, True),
        ({"CLICOLOR_FORCE": "1", "TERM": "dumb"}, False, True),
        ({"FORCE_COLOR": "0", "CLICOLOR_FORCE": "0"}, False, False),
        ({"FORCE_COLOR": "1", "NO_COLOR": "1"}, True, False),
    ],
)
def test_colours_are_as_the_environment_says(environment, is_terminal, has_them, monkeypatch) -> None:
    for name in ("TERM", "NO_COLOR", "FORCE_COLOR", "CLICOLOR_FORCE"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    stream = io.StringIO()
    monkeypatch.setattr(stream, "isatty", lambda: is_terminal)
    assert has_colour(stream) is has_them


def test_no_text_of_others_has_a_colour_of_its_own(monkeypatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.delenv("NO_COLOR", raising=False)
    text = "ok \x1b[31mowned\nokay\n     2.00 s  fault: it\nwarning: no\n a FAILED b"
    assert for_people(text, io.StringIO()) == (
        "\x1b[32mok\x1b[0m \\u001b[31mowned\nokay\n     2.00 s  \x1b[31mfault:\x1b[0m it\n"
        "\x1b[33mwarning:\x1b[0m no\n a FAILED b"
    )


def test_a_terminal_that_hangs_up_while_it_is_asked_for_its_width_is_no_error(monkeypatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    stream = io.StringIO()  # without a descriptor: asking raises OSError
    monkeypatch.setattr(stream, "isatty", lambda: True)
    assert terminal_columns(stream) == 80


def test_a_screen_says_how_much_of_a_table_it_has_no_room_for(monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("LINES", "5")
    written: list[str] = []
    Screen(True, written.append).draw_table("\n".join(f"line {number}" for number in range(9)))
    shown = "".join(written).replace("\x1b[K", "").removeprefix("\x1b[H").removesuffix("\x1b[J")
    assert shown == "line 0\nline 1\nline 2\n… 6 lines more: a higher terminal shows them\n"


@pytest.mark.long
@pytest.mark.slow
def test_a_terminal_that_dies_costs_a_run_that_outlives_it_nothing(tmp_path: Path) -> None:
    """`nohup` ignores SIGHUP: the run goes on to its end, though each of its words fails with EIO."""
    (tmp_path / "short.toml").write_text("lasts_s = 0.5\n")
    command = [BIN / "adacd-hil", "demo", *PAPER, "--scenario", "short.toml", "--out", "run"]
    process, terminal = pty.fork()
    if not process:
        os.chdir(tmp_path)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        os.execv(command[0], command)
    os.read(terminal, 1)  # it has begun to speak
    os.close(terminal)
    _, status = os.waitpid(process, 0)
    assert os.waitstatus_to_exitcode(status) == OK
    assert read_log(tmp_path / "run").is_complete
    assert (tmp_path / "run" / "report.html").is_file()
