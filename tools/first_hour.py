"""Plays the README's three ways to begin as a newcomer would: by its text alone, in a fresh clone, on a terminal.

    python tools/first_hour.py                # all three: clones, installs
    python tools/first_hour.py arm --json

Every command of a way's passage, and of the page that the passage leads to, is typed once, in the order in which it
stands. Questions are answered by Enter; a run that watches is told to `finish`. What a command reads must be there
before it, and it must end with exit status 0. The way with an arm is played with an emulated arm on `can0`, which
`tools/with-vcan` brings. There the host is in lockstep, by an environment variable: no machine is too slow for it.

The table has, by way: commands, questions, minutes of machine and of reader (200 words a minute, half a minute a
command and a question), and the terms of docs/glossary.md in the text before the first run of what is one's own.

Exit status: 0 a newcomer gets there, 1 one would give up, or the guest has not started; 2 wrong usage.
"""

import argparse
import contextlib
import json
import os
import pty
import re
import select
import shlex
import signal
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from documented_commands import command_complaints, split_commands  # noqa: E402
from documents import Piece, parse_document  # noqa: E402

from adacd_hil.table_layout import fit_table  # noqa: E402

SECTION = "Three ways to begin"
WAYS = {"see": "See it.", "recordings": "I have recordings", "arm": "I have an arm"}
"""Name of a way, and how its passage begins."""
FIRST_OWN_RUN = {
    "see": r"make demo",
    "recordings": r"\.venv/bin/adacd-hil identify mine\.csv",
    "arm": r"\.venv/bin/adacd-hil run [^\n]*--tare",
}
"""The command by which somebody is there, with what is theirs; up to it concepts are counted."""
MOST_CONCEPTS = 11
MOST_MINUTES = 60.0
WORDS_PER_MINUTE = 200.0
MINUTES_PER_ANSWER = 0.5
"""For a command to be typed, or a question to be answered."""
OUTSIDE = {
    r"ip link set ": "the interface is up already",
    r"tools/with-vcan .*can0": "",
}
"""Commands that are not typed, and why."""
BROUGHT = {
    "mine.csv": "recording.csv",
    "my-map.toml": "docs/examples/foreign/map.toml",
    "planar-arm.urdf": "docs/examples/foreign/planar-arm.urdf",
    "panda.urdf": "docs/examples/foreign/planar-arm.urdf",
}
"""Files that a newcomer comes with, and those that stand for them here, up to so many lines:"""
MOST_LINES = 4500
"""9 s of the recording, in which nobody touches the arm."""
BUS = "can0"
HANG_S = 900.0
"""Longest that a command may take."""
FAILED, OF_THIS_MACHINE = r"FAILED|not sufficient: ", r"FAILED +(rate\b|SYNC )|not sufficient: "
"""What `doctor` and `commtest` say of what failed, and of a host that isn't on time: a guest of user-mode Linux."""
MEANT = {r"--truth wrong-sign": 4}
"""Exit statuses that a command is meant to have in place of 0: the arm is not what the host was told."""
MOST_LETTERS = 2000
LAB = ("--scenario", "idle")
"""Nobody touches the arm on the bus."""
ENDS_AFTER = "watches for touches"
"""What a run says before somebody types `finish`."""


@dataclass(frozen=True)
class Step:
    """A command as it stands in a text; a piece of shell that is typed at once."""

    place: str
    text: str


COMPILED = Step("tools/first_hour.py", "make demo")
"""Typed before the guest begins, whose memory is too small to compile in."""


@dataclass
class Played:
    """How a step went. status: exit status; none: not typed, see `why`."""

    place: str
    text: str
    status: int | None = None
    seconds: float = 0.0
    questions: int = 0
    silence_s: float = 0.0
    why: str = ""
    is_good: bool = True


@dataclass
class Way:
    """A way through the texts: what is read and typed, and how it went."""

    name: str
    steps: list[Step]
    words: int
    concepts: list[str]
    played: list[Played] = field(default_factory=list)

    @property
    def minutes(self) -> float:
        """Of machine and reader."""
        answers = sum(1 + step.questions for step in self.played if step.status is not None)
        machine_s = sum(step.seconds for step in self.played)
        return self.words / WORDS_PER_MINUTE + MINUTES_PER_ANSWER * answers + machine_s / 60.0

    @property
    def complaints(self) -> list[str]:
        """What would make a newcomer give up."""
        lines = [f"{step.place}: `{step.text}`: {step.why}" for step in self.played if not step.is_good]
        if len(self.concepts) > MOST_CONCEPTS:
            lines.append(f"{self.name}: {len(self.concepts)} concepts, {MOST_CONCEPTS} at most")
        if self.minutes > MOST_MINUTES:
            lines.append(f"{self.name}: {self.minutes:.0f} min, {MOST_MINUTES:.0f} at most")
        return lines


# -- texts -----------------------------------------------------------------------------------------------------------


def read_way(name: str) -> Way:
    """Read the README down to a way's passage, and the page that the passage leads to."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    before, _, section = readme.partition(f"## {SECTION}\n")
    section = section.partition("\n## ")[0]
    passages = re.split(r"^(?=\*\*)", section, flags=re.MULTILINE)
    shared = passages[0]
    (own,) = [each for each in passages[1:] if each.startswith(f"**{WAYS[name]}")]
    (page,) = re.findall(r"\]\((docs/[\w-]+\.md)\)", own)[-1:]
    steps = [*_steps("README.md", own), *_steps(page, (ROOT / page).read_text(encoding="utf-8"))]
    if not steps[0].text.startswith("make "):
        steps = [*_steps("README.md", shared), *steps]
    typed = list({step.text: step for step in steps}.values())
    pages = f"{before}{shared}{own}\n{(ROOT / page).read_text(encoding='utf-8')}"
    met = re.split(FIRST_OWN_RUN[name], pages, maxsplit=1)[0]
    return Way(name, typed, len(prose(met).split()), concepts(met))


def _steps(page: str, text: str) -> list[Step]:
    """Take the commands out of a text: of its blocks, and what stands in a line of prose as `make ...`."""
    document = parse_document(ROOT / page, text)
    pieces = [piece for piece in (*document.blocks, *document.spans) if _is_typed(piece)]
    pieces.sort(key=lambda piece: piece.line)
    return [Step(page, line) for piece in pieces for line in logical_lines(piece.text)]


def _is_typed(piece: Piece) -> bool:
    if piece.language:
        return piece.language == "sh"
    return not piece.head and re.match(r"make \w|\.venv/bin/[\w-]+ \w", piece.text) is not None


def logical_lines(block: str) -> list[str]:
    """Part a block of shell into what is typed at once: a line, or several where a quote or a backslash goes on."""
    lines, open_line = [], ""
    for line in block.splitlines():
        if not open_line and not line.partition("#")[0].strip():
            continue
        open_line = f"{open_line}\n{line}" if open_line else line
        with contextlib.suppress(ValueError):
            if not open_line.endswith("\\") and shlex.split(open_line, comments=True):
                lines.append(_uncommented(open_line))
                open_line = ""
    return lines


def _uncommented(line: str) -> str:
    """Cut the comment off: what stands behind the first # at which the words before it are whole."""
    for found in re.finditer(r"\s+#", line):
        with contextlib.suppress(ValueError):
            shlex.split(line[: found.start()])
            return line[: found.start()]
    return line


def prose(text: str) -> str:
    """Leave out of a page what is not read word by word: links' targets, tables' rules, comments."""
    text = re.sub(r"\]\([^)]*\)", "]", text)
    return re.sub(r"^```.*$|^\|[-|: ]+$|[*`|#\[\]]", " ", text, flags=re.MULTILINE)


def glossary() -> dict[str, str]:
    """Return the terms of docs/glossary.md with their meaning."""
    text = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    return dict(re.findall(r"^- \*\*(.+?)\*\*: (.+)$", text, re.MULTILINE))


def concepts(text: str) -> list[str]:
    """List the terms of the glossary that a text holds, in the order of the glossary; a row is one."""
    words = prose(text)
    return [row for row in glossary() if any(re.search(_pattern(term), words) for term in row.split(", "))]


def _pattern(term: str) -> str:
    is_name = any(letter.isupper() for letter in term)
    return rf"{'' if is_name else '(?i)'}\b{re.escape(term.removesuffix('y').removesuffix('e'))}(y|e|es|s|ies|d|ed)?\b"


# -- playing ---------------------------------------------------------------------------------------------------------


def play(way: Way, folder: Path, environment: dict[str, str], skipped: Callable[[str], str]) -> None:
    """Type the steps of a way that are not played yet, in `folder`. skipped: why one is not typed; "" it is."""
    for step in way.steps[len(way.played) :]:
        done = Played(step.place, step.text)
        way.played.append(done)
        if next(iter(BROUGHT)) in step.text:
            for name, source in BROUGHT.items():
                lines = (folder / source).read_text(encoding="utf-8").splitlines(keepends=True)
                (folder / name).write_text("".join(lines[:MOST_LINES]), encoding="utf-8")
        with contextlib.chdir(folder):
            lines = [line for words in split_commands(step.text) for line in command_complaints(words)]
        if lines:
            done.why, done.is_good = "; ".join(lines), False
            continue
        done.why = skipped(step.text)
        if not done.why:
            type_in(done, folder, environment)
        print(f"{way.name:11}{told(done)}", file=sys.stderr, flush=True)


def told(step: Played) -> str:
    """Say in a line how a step went."""
    text = " ".join(step.text.split())
    went = f"exit status {step.status}, {step.seconds:.0f} s" if step.status is not None else "not typed"
    return f"{went:24} {text}" + (f"  ({step.why})" if step.why else "")


def type_in(done: Played, folder: Path, environment: dict[str, str]) -> None:
    """Type a command on a terminal of its own, and answer what it asks."""
    master, slave = pty.openpty()
    termios.tcsetwinsize(master, (24, 80))
    begin = heard = time.monotonic()
    with subprocess.Popen(
        ["sh", "-c", done.text], cwd=folder, env=environment, stdin=slave, stdout=slave, stderr=slave,
        start_new_session=True,
    ) as process:  # fmt: skip
        os.close(slave)
        said, unanswered = "", 0
        is_run = " run " in done.text and " sh -c" not in done.text
        while True:
            ready, _, _ = select.select([master], [], [], 0.3)
            now = time.monotonic()
            if ready:
                try:
                    piece = os.read(master, 65536)
                except OSError:  # nobody has the terminal any more
                    break
                done.silence_s, heard = max(done.silence_s, now - heard), now
                said += piece.decode(errors="replace")
            elif re.search(r"(:|\?|Enter[^\n]*) ?$", said[unanswered:]):
                unanswered = len(said)
                done.questions += 1
                os.write(master, b"\n")
            if is_run and ENDS_AFTER in said:
                os.write(master, b"finish\n")
                is_run = False
            if now - begin > HANG_S:
                os.killpg(process.pid, signal.SIGKILL)
        done.status = process.wait()
    os.close(master)
    done.seconds = time.monotonic() - begin
    judge(done, said)


def judge(done: Played, said: str) -> None:
    """Say whether a newcomer goes on: exit status 0, or nothing has failed but the speed of this machine."""
    if done.status == next((status for pattern, status in MEANT.items() if re.search(pattern, done.text)), 0):
        return
    said = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", said)
    failed = [line.strip() for line in said.splitlines() if re.match(FAILED, line)]
    done.is_good = done.status == 1 and bool(failed) and all(re.match(OF_THIS_MACHINE, line) for line in failed)
    done.why = "; ".join(failed) if done.is_good else " ".join(said.split())[-MOST_LETTERS:]


@contextlib.contextmanager
def arm_on_bus(folder: Path, environment: dict[str, str]) -> Iterator[None]:
    """Have an emulated arm on the bus, which knows nothing of what the newcomer writes."""
    command = [".venv/bin/firmware-sim", "run", "-i", "socketcan", "-c", BUS, *LAB]
    with subprocess.Popen(command, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if line.strip() == "ready":
                break
        try:
            yield
        finally:
            process.terminate()
            process.communicate()


def not_typed(text: str) -> str:
    """Say why a command is not typed here."""
    return next((why for pattern, why in OUTSIDE.items() if re.match(pattern, text)), "")


def clone(folder: Path) -> None:
    """Clone the repository as it is committed."""
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)


def play_in_clone(way: Way) -> None:
    """Play a way in a clone of its own; what needs a bus, in the guest of `tools/with-vcan` where there is no other."""
    with tempfile.TemporaryDirectory(prefix="first-hour-") as parent:
        folder = Path(parent) / "adacd-hil"
        clone(folder)
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        if way.name != "arm":
            play(way, folder, environment, not_typed)
            return
        installs = next(number for number, step in enumerate(way.steps) if step.text.startswith("make ")) + 1
        rest = way.steps[installs:]
        way.steps = [*way.steps[:installs], COMPILED]
        play(way, folder, environment, not_typed)
        guest = [sys.executable, str(Path(__file__)), "arm", "--in", str(folder), "--json"]
        done = subprocess.run(
            [str(ROOT / "tools" / "with-vcan"), "--can", BUS, "--mem", "3G", "--", *guest],
            stdout=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
        if not done.stdout:
            raise SystemExit(f"the guest ended with {done.returncode}")
        way.steps += rest
        way.played += [Played(**step) for step in json.loads(done.stdout)["arm"]["played"]]


def play_in_guest(way: Way, folder: Path) -> None:
    """Play all but the installation, beside an arm."""
    way.steps = [step for step in way.steps if not step.text.startswith("make ")]
    environment = {**os.environ, "ADACD_HIL_RUN_CLOCK": "lockstep"}
    environment.pop("PYTHONPATH", None)
    with arm_on_bus(folder, environment):
        play(way, folder, environment, not_typed)


# -- results ---------------------------------------------------------------------------------------------------------


def as_json(ways: list[Way]) -> dict[str, Any]:
    """Return what was measured, by way."""
    return {
        way.name: {
            "commands": sum(step.status is not None for step in way.played),
            "questions": sum(step.questions for step in way.played),
            "machine_s": sum(step.seconds for step in way.played),
            "minutes": way.minutes,
            "words": way.words,
            "concepts": way.concepts,
            "complaints": way.complaints,
            "played": [asdict(step) for step in way.played],
        }
        for way in ways
    }


def as_table(ways: list[Way]) -> str:
    """Write the table."""
    rows = [("way", "commands", "questions", "machine min", "all min", "longest silence s", "concepts")]
    for way in ways:
        typed = [step for step in way.played if step.status is not None]
        numbers = (
            len(typed), sum(step.questions for step in typed), f"{sum(step.seconds for step in typed) / 60.0:.1f}",
            f"{way.minutes:.0f}", f"{max((step.silence_s for step in typed), default=0.0):.0f}", len(way.concepts),
        )  # fmt: skip
        rows.append((way.name, *map(str, numbers)))
    lines = [f"{way.name}: {', '.join(way.concepts)}" for way in ways]
    return "\n".join([*fit_table(rows), *lines, *(line for way in ways for line in way.complaints)])


def main() -> int:
    """Play the ways that are asked for; exit status 1 where a newcomer would give up."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ways", nargs="*", metavar="WAY", help=f"of {', '.join(WAYS)}; default: all")
    parser.add_argument("--read", action="store_true", help="read and count, type nothing")
    parser.add_argument("--in", dest="folder", type=Path, help="a clone that is installed, with an arm to be on can0")
    parser.add_argument("--json", action="store_true", help="print all as JSON")
    arguments = parser.parse_args()
    if unknown := [name for name in arguments.ways if name not in WAYS]:
        parser.error(f"{unknown[0]} is none of {', '.join(WAYS)}")
    ways = [read_way(name) for name in arguments.ways or WAYS]
    for way in ways:
        if arguments.folder is not None:
            play_in_guest(way, arguments.folder)
        elif not arguments.read:
            play_in_clone(way)
    print(json.dumps(as_json(ways), indent=2) if arguments.json else as_table(ways))
    return 1 if any(way.complaints for way in ways) else 0


if __name__ == "__main__":
    sys.exit(main())
