"""Every command line, TOML, path and Python example in README and docs/ is parsed, loaded, found or run.

Each block and each piece of inline code falls under one rule here. A block under none fails: give it a language.
Commands that need no bus are run, too.
`text` is for what is neither typed nor read by a program; indented blocks are equations.
Building the site finds broken links.
"""

import contextlib
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import documented_commands as check
import numpy as np
import pytest
from click.testing import CliRunner
from documents import PAGES, ROOT, Document, Piece, read_document
from foreign_arms import record, urdf_text

from adacd_hil.api import load
from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.cli.output import ExitCode
from adacd_hil.lab.detectors.detector_registry import detectors, unregister
from adacd_hil.lab.logs.python_can_files import McapReader
from firmware_sim.cli.emulator_main import EPILOG

PAGE_NAMES = [str(path.relative_to(ROOT)) for path in PAGES]
COMMAND = re.compile(r"(\$ )?(\.venv/bin/)?(adacd-hil|firmware-sim|make|tools/\S+|python|pip|can_\w+) \S")
"""How a line begins that somebody would type."""
EXPERIMENT = """
lasts_s = 0.6
start_deg = [-30.0, -60.0]
contacts = [{ at_s = 0.3, link = 2, point_m = 0.2, force_N = 20.0, duration_s = 0.1 }]
"""
"""One contact, which `log cut --contact 1` finds; certified, whose detection is on from the start."""


@pytest.fixture(scope="session")
def documents() -> dict[str, Document]:
    return {name: read_document(ROOT / name) for name in PAGE_NAMES}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, documents: dict[str, Document]) -> Iterator[Path]:
    """A folder in which the files lie that the documents name: a short run, what comes of it, TOML from the pages."""
    folder = tmp_path_factory.mktemp("documented")
    for name in ("adacd_hil", "firmware_sim", "dbc", "docs", "tools"):
        (folder / name).symlink_to(ROOT / name)
    (folder / "experiment.toml").write_text(EXPERIMENT)
    for name, block in named_toml(documents).items():
        (folder / name).write_text(block.text)
    run_embedded(resolve("certified", str(folder / "experiment.toml"), None, None), "lockstep", folder / "runs/demo")
    own = resolve(str(folder / "my-arm.toml"), str(folder / "experiment.toml"), None, None)
    run_embedded(own, "lockstep", folder / "runs/rehearsed")  # the arm that `runs` and `trend` choose
    for place in ("runs/run", "runs/vcan", "runs/today"):
        shutil.copytree(folder / "runs/demo", folder / place)
    shutil.copy(folder / "runs/demo/run.mcap", folder)
    (folder / "my").mkdir()
    shutil.copy(ROOT / "adacd_hil/device_profiles/stock-drive.toml", folder / "my/drive.toml")
    shutil.copy(ROOT / "dbc/arm.dbc", folder)
    for name, source in (("map.toml", "map.toml"), ("planar-arm.urdf",) * 2, ("arm.urdf", "planar-arm.urdf")):
        shutil.copy(ROOT / "docs/examples/foreign" / source, folder / name)
    shutil.copy(ROOT / "tests/scheme/seven_joint_arm.urdf", folder / "panda.urdf")
    for name in ("recording.csv", "mine.csv", "cyclic.log", "host.toml", "tare.toml", "ca.pem", "me.pem", "me-key.pem"):
        (folder / name).touch()
    with contextlib.chdir(folder):
        for name in ("bus.log", "bus.blf"):
            with McapReader("run.mcap") as reader, can.Logger(name) as converted:
                for message in reader:
                    converted(message)
        shutil.copy("bus.blf", "theirs.blf")
        yield folder


def named_toml(documents: dict[str, Document]) -> dict[str, Piece]:
    """Return the TOML blocks that begin with their file's name."""
    blocks = (block for page in documents.values() for block in page.blocks if block.language == "toml")
    found = {}
    for block in blocks:
        name = re.match(r"# (\S+\.toml)\b", block.text)
        if name:
            found[name[1]] = block
    return found


def failures(pieces: list[tuple[Piece, list[str]]]) -> str:
    return "\n".join(f"{piece.place}: {line}" for piece, lines in pieces for line in lines)


# -- blocks ----------------------------------------------------------------------------------------------------------


def block_complaints(block: Piece, folder: Path) -> list[str]:
    """Check a block by its language; a language that has no rule is a complaint."""
    if block.language.startswith(("{toctree}", "{include}")):
        return []  # building the site checks them
    rule = RULES.get(block.language)
    if rule is None:
        return [f"a block of language {block.language!r}; known: {', '.join(RULES)}"]
    return rule(block, folder)


def typed(block: Piece) -> str:
    """Give what is typed of a block: in a console's, what stands behind `$ `."""
    if block.language == "sh":
        return block.text
    return "\n".join(line.removeprefix("$ ") for line in block.text.splitlines() if line.startswith("$ "))


def shell_complaints(block: Piece, folder: Path) -> list[str]:
    commands = check.split_commands(typed(block))
    if not commands:
        return ["nothing is typed in it: a line of a console begins with `$ `"]
    bare = [
        f"{words[0]}: the system's Python lacks its packages; say python" for words in commands if _is_bare(words[0])
    ]
    return bare + [line for words in commands for line in check.command_complaints(words)]


def _is_bare(program: str) -> bool:
    return re.fullmatch(r"(tools|tests)/\S+\.py", program) is not None


def toml_complaints(block: Piece, folder: Path) -> list[str]:
    path = folder / f"{block.page.stem}-{block.line}.toml"
    path.write_text(block.text)
    return check.toml_complaints(block.text, path)


def plain_complaints(block: Piece, folder: Path) -> list[str]:
    """Plain text has nothing that somebody would type or a program would read."""
    lines = [line for line in block.text.splitlines() if COMMAND.match(line)]
    lines += re.findall(r"^\[\[?[\w.]+\]\]?\s*(?:#.*)?$|^(?:import|from) .+", block.text, re.MULTILINE)
    return [f"{line!r} in a block that says it is plain text: fence it as sh, toml or python" for line in lines]


def python_complaints(block: Piece, folder: Path) -> list[str]:
    """Python is run by `test_a_python_example_runs`; here it need only be listed there."""
    known = block.page.name in EXAMPLES
    return [] if known else [f"a Python block on a page without names to run it with: see EXAMPLES in {__file__}"]


RULES = {
    "sh": shell_complaints,
    "console": shell_complaints,
    "toml": toml_complaints,
    "python": python_complaints,
    "text": plain_complaints,
    "indented": plain_complaints,
}


@pytest.mark.parametrize("page", PAGE_NAMES)
def test_every_block_is_right(page, documents, folder):
    found = [(block, block_complaints(block, folder)) for block in documents[page].blocks]
    assert failures(found) == ""


# -- inline code -----------------------------------------------------------------------------------------------------

ASSIGNMENT = re.compile(r"(\[\w+\] )?(?!extends)[a-z][\w.]*(?<!value) = [^=]*")
OUTPUTS = re.compile(r"[\w*-]+\.(mcap|html|pdf|json|csv|png|svg|txt|toml|parquet|urdf|part|blf|log|dbc)(/\S*)?")
"""Files that the commands write, or that a reader has; their names stand for themselves."""
NOT_OURS = {"can_id", "can_channel", "can_msgs"}


def span_complaints(span: Piece) -> list[str]:
    """Check a piece of inline code. What is no command, path, key, option or TOML is a word, and free."""
    text = span.text.strip()
    first = text.split(" ")[0].removeprefix(".venv/bin/")
    if first in check.PROGRAMS or (first in ("python", "make", "pip") and " " in text) or check.TOOL.fullmatch(first):
        return [line for words in check.split_commands(text) for line in check.command_complaints(words, False)]
    if first.startswith("can_") and first not in NOT_OURS and re.fullmatch(r"can_[a-z]+", first):
        return check.command_complaints([first])
    if re.match(r"\w+ --\w", text):
        return subcommand_complaints(text)
    if re.match(r"--?[a-z]", text):
        return check.option_complaints(text, span.head)
    if re.match(r"(ADACD_HIL|FIRMWARE_SIM)_\w+$", text):
        return [] if text in check.environment_names() else [f"nothing reads {text}"]
    if re.match(r"adacd_hil(\.\w+)+|firmware_sim(\.\w+)+", text):
        return check.name_complaints(text.partition("(")[0])
    if re.fullmatch(r"(adacd_hil|firmware_sim|tests|tools|docs|dbc|[\w./]+)/[\w./-]*\.(py|md|c|sh|dbc|eds)", text):
        return check.path_complaints(text, span.page)
    if re.fullmatch(r"(adacd_hil|firmware_sim|tests|tools|docs|dbc)/[\w./-]*|\w+\.(py|eds|c)", text):
        return check.path_complaints(text, span.page)
    if re.fullmatch(r"[a-z]+\.\w+", text) and text.split(".")[0] in check.SETTING_SECTIONS:
        return [] if OUTPUTS.fullmatch(text) else check.key_complaints(text)
    if ASSIGNMENT.fullmatch(text) and "(" not in text:
        return check.assignment_complaints(text)
    return []


def subcommand_complaints(text: str) -> list[str]:
    """Check `name --option ...` of a command of adacd-hil, else of a tool."""
    name, *rest = text.split(" ")
    if name in check.PROGRAMS["adacd-hil"].commands:
        return check.command_complaints(["adacd-hil", name, *rest], False)
    owners = [str(tool.relative_to(ROOT)) for tool in check.tools() if name in check.flags(tool)]
    complaints = [check.command_complaints([owner, name, *rest]) for owner in owners]
    return min(complaints, key=len, default=[f"`{text}`: neither a command of adacd-hil nor of a tool"])


@pytest.mark.parametrize("page", PAGE_NAMES)
def test_every_piece_of_inline_code_is_right(page, documents, folder):
    assert failures([(span, span_complaints(span)) for span in documents[page].spans]) == ""


# -- what can be run without a bus -----------------------------------------------------------------------------------

RUN = re.compile(
    r"(\.venv/bin/)?(adacd-hil (replay|compare|budget|runs|log (info|check|recover|cut|export)|report run.mcap --out "
    r"|init (as-it-ran|geared).toml )|firmware-sim (list|show|check|truths))"
)
"""Commands that need no bus, no terminal, and a second or two at most: they are run here as they stand."""


def test_what_needs_no_bus_runs(documents, folder):
    blocks = [block for page in documents.values() for block in page.blocks if block.language in ("sh", "console")]
    lines = {" ".join(words): (block, words) for block in blocks for words in check.split_commands(typed(block))}
    played = {line: entry for line, entry in lines.items() if RUN.match(line)}
    found = []
    for line, (block, (program, *words)) in played.items():
        done = CliRunner().invoke(check.PROGRAMS[program.removeprefix(".venv/bin/")], words)
        if done.exit_code != 0:
            found.append((block, [f"`{line}` ended with {done.exit_code}: {done.stderr}"]))
    assert failures(found) == ""
    assert len(played) >= 25


def free_and_pushed_motion() -> dict[str, Any]:
    """What docs/scheme-any-arm.md has at hand: free motion of a planar arm, then motion in which it is pushed."""
    moved = record((ROOT / "docs/examples/foreign/planar-arm.urdf").read_text(), 14.0, 1e-3, noise_Nm=0.03)
    moved.tau[13_000:13_300] -= 3.0, 2.0
    arrays = {"q": moved.q, "dq": moved.dq, "tau_J": moved.tau}
    return {name: values[:12_000] for name, values in arrays.items()} | {
        f"{name}_later": values[12_000:] for name, values in arrays.items()
    }


def a_joint_that_is_pushed() -> dict[str, Any]:
    """Give the arrays of one joint, which somebody pushes at 9 s."""
    moved = record(urdf := urdf_text(1))
    moved.tau[(moved.t >= 9.0) & (moved.t < 9.3)] -= 3.0
    return {"urdf": urdf, "t": moved.t, "q": moved.q, "dq": moved.dq, "tau_J": moved.tau}


EXAMPLES: dict[str, Callable[[], dict[str, Any]]] = {
    "api.md": a_joint_that_is_pushed,
    "detectors.md": dict,
    "scheme-any-arm.md": free_and_pushed_motion,
}
"""What a page's Python takes as given."""


@pytest.mark.parametrize("page", EXAMPLES)
def test_a_python_example_runs(page, documents, folder, capsys):
    names = EXAMPLES[page]()
    blocks = [block for block in documents[f"docs/{page}"].blocks if block.language == "python"]
    for block in blocks:
        exec(compile(block.text, block.place, "exec"), names)
    assert len(blocks) == (2 if page == "api.md" else 1)
    if page == "scheme-any-arm.md":  # the contact that it prints
        assert re.fullmatch(r"10\d\d link2 \S.*\n", capsys.readouterr().out)
    elif page == "api.md":
        assert capsys.readouterr().out.splitlines()[1:] == ["9.0 s link 1 (1,)"]
        run = load("run.mcap")
        assert {name: values.shape for name, values in names["arrays"].items()} == {
            name: run[name].shape if name != "t" else run.t_s.shape for name in ("t", "q", "dq", "tau_J")
        }
        assert np.array_equal(names["arrays"]["tau_J"], run["tau_J"])
    elif page == "detectors.md":
        assert "magnitude" in detectors()
        unregister("magnitude")


def test_the_page_of_commands_lists_the_exit_statuses_of_both_programs() -> None:
    section = (ROOT / "docs" / "commands.md").read_text().partition("## Exit statuses")[2].partition("## ")[0]
    listed, emulator = section.split("`firmware-sim`")
    assert [int(status) for status in re.findall(r"^- (\d+):", listed, re.MULTILINE)] == list(ExitCode)
    assert [int(status) for status in re.findall(r"\d+", emulator)] == [
        int(status) for status in re.findall(r"\d+", EPILOG)
    ]
