"""tools/yardstick.c and .py: it compiles without a warning, checks its arguments, and gets frames that devices take."""

from pathlib import Path

import pytest
import yardstick

from adacd_hil.wire.dbc_contract import contract_folder, load_codec
from adacd_hil.wire.e2e import E2eStatus

GOOD = ["-i", "none0", "-s", "080", "-r", "181", "-c", "201#0011"]


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    built, reason = yardstick.build(tmp_path_factory.mktemp("yardstick"))
    if built is None:
        pytest.skip(reason)
    return built


@pytest.mark.parametrize(("contract", "count"), [("arm", 16), ("arm_fd", 256), ("arm_fd_500us", 256)])
def test_a_drive_takes_its_commands_one_after_the_other_and_over_again(contract: str, count: int) -> None:
    codec = load_codec(contract_folder() / f"{contract}.dbc")
    for name in yardstick.COMMANDS:
        frames = yardstick.command_frames(codec, name)
        assert len(set(frames)) == count
        receiver = codec.message(name).receiver()
        assert {receiver.check(frame) for frame in frames * 2} == {E2eStatus.OK}


def test_its_arguments_name_the_four_answers_and_what_else_the_host_hears(tmp_path: Path) -> None:
    arguments = yardstick.arguments(load_codec(), "vcan0", 500, 4.0, 0.5, tmp_path / "samples")
    pairs = list(zip(arguments[::2], arguments[1::2], strict=True))
    assert [value for option, value in pairs if option == "-r"] == ["181", "182", "183", "184"]
    assert [value for option, value in pairs if option == "-n"] == ["000#8200", "000#0100"]
    assert ("-e", "200:77F#05") in pairs
    assert {"080", "081", "201", "202", "701", "77F"} < {value for option, value in pairs if option == "-x"}
