"""The DBC files as tools that are not ours see them: cantools lists, dumps and converts each without a warning."""

import json
import subprocess
import sys
from pathlib import Path

import cantools
import pytest
from hang import HANG_S

from adacd_hil.wire.contract_attributes import read_bitrates
from adacd_hil.wire.dbc_contract import contract_folder, load_codec, parse_codec

FILES = sorted(contract_folder().glob("*.dbc"))
EVERY_FILE = pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)

RUN_IN_TURN = """
import json, runpy, sys
for arguments in json.loads(sys.argv[1]):
    sys.argv = ["cantools", *arguments]
    runpy.run_module("cantools", run_name="__main__")
    print("-- done")
"""
"""As `python -m cantools …` for each row of arguments, with one start of the interpreter."""


def run_cantools(*commands: tuple[str, ...]) -> list[str]:
    """Run commands of the tool with warnings as errors; nothing may appear on the error output."""
    command = [sys.executable, "-W", "error", "-c", RUN_IN_TURN, json.dumps(commands)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=HANG_S, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.split("-- done\n")[: len(commands)]


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, tuple[str, str, list[Path]]]:
    """What it lists and dumps of each file, and what it has converted it to."""
    folder, commands, converted = tmp_path_factory.mktemp("converted"), [], {}
    for path in FILES:
        converted[path] = [folder / f"{path.stem}.{form}" for form in ("dbc", "kcd", "sym")]
        commands += [("list", str(path)), ("dump", str(path))]
        commands += [("convert", str(path), str(target)) for target in converted[path]]
    said = run_cantools(*commands)
    return {path: (said[5 * n], said[5 * n + 1], converted[path]) for n, path in enumerate(FILES)}


@pytest.mark.slow
@EVERY_FILE
def test_cantools_lists_dumps_and_converts_the_file(path: Path, seen: dict[Path, tuple[str, str, list[Path]]]) -> None:
    ours = load_codec(path)
    listed, dumped, converted = seen[path]
    assert sorted(listed.split()) == sorted(ours.messages)
    for message in ours.messages.values():
        assert message.name in dumped
        assert [signal.name for signal in message.signals if signal.name not in dumped] == []
    for target in converted:
        theirs = cantools.database.load_file(target)
        assert {m.name: (m.frame_id, m.length) for m in theirs.messages} == {
            m.name: (m.can_id, m.length) for m in ours.messages.values()
        }
    again = load_codec(converted[0])
    assert (again.layout_digest, again.wire_version) == (ours.layout_digest, ours.wire_version)


FD_FILES = pytest.mark.parametrize(
    ("name", "data_rate", "period_us"), [("arm_fd", 5_000_000, 1000), ("arm_fd_500us", 8_000_000, 500)]
)


@FD_FILES
def test_bit_rates_of_a_contract_are_those_it_states_else_its_defaults(
    name: str, data_rate: int, period_us: int
) -> None:
    codec = load_codec(contract_folder() / f"{name}.dbc")
    attributes = cantools.database.load_file(codec.path).dbc.attributes
    found = [attributes[key].value for key in ("Baudrate", "BaudrateCANFD", "BusPeriod_us")]
    assert found == [1_000_000, data_rate, period_us]
    assert read_bitrates(codec) == (1_000_000, data_rate)
    text = codec.text.decode()
    unsaid = text.replace(f'BA_ "BaudrateCANFD" {data_rate};', "").replace('BA_ "Baudrate" 1000000;', "")
    unsaid = unsaid.replace('BA_DEF_DEF_ "Baudrate" 1000000', 'BA_DEF_DEF_ "Baudrate" 500000')
    assert read_bitrates(parse_codec(unsaid.encode(), codec.path)) == (500_000, 0)


@FD_FILES
def test_every_message_of_the_fd_contracts_says_when_it_is_sent(name: str, data_rate: int, period_us: int) -> None:
    triggers: dict[str, set[str]] = {}
    for message in cantools.database.load_file(contract_folder() / f"{name}.dbc").messages:
        attributes = message.dbc.attributes
        trigger = attributes["Trigger"]
        triggers.setdefault(trigger.definition.choices[trigger.value], set()).add(message.name)
        interval = [attributes[key].value if key in attributes else 0 for key in ("GenMsgCycleTime", "GenMsgDelayTime")]
        if message.name.endswith("Heartbeat"):
            assert interval == [100, 100]
        elif message.name.endswith("Emcy"):
            assert interval == [0, 10]
        else:
            assert interval == [0, 0]
    nodes = ("Drive1", "Drive2", "Sensor1", "Sensor2")
    assert triggers == {
        "sync": {"Sync", "Drive1Feedback", "Drive2Feedback", "Sensor1Torque", "Sensor2Torque"},
        "command": {"Drive1Command", "Drive2Command"},
        "event": {f"{node}{what}" for node in nodes for what in ("Emcy", "Heartbeat")} | {"HostHeartbeat"},
        "request": {"Nmt"} | {f"{node}Sdo{what}" for node in nodes for what in ("Request", "Response")},
    }
