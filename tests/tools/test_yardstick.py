"""tools/yardstick.py: what is in C compiles, devices take its frames, its arguments name all that the host hears."""

from pathlib import Path

import pytest
import side_by_side
import witness
import yardstick

from adacd_hil.wire.dbc_contract import contract_folder, load_codec
from adacd_hil.wire.e2e import E2eStatus


@pytest.mark.parametrize(
    ("source", "flags"),
    [(yardstick.SOURCE, ()), (witness.SOURCE, ()), (side_by_side.WAITS, ("-shared", "-fPIC", "-ldl"))],
)
def test_what_is_in_c_compiles_without_a_warning(source: Path, flags: tuple[str, ...], tmp_path: Path) -> None:
    program, reason = yardstick.build(tmp_path, source, *flags)
    if program is None:
        pytest.skip(reason)
    assert program.is_file()


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
