"""The CAN FD contracts: their protection, and what a contract may not say."""

from pathlib import Path

import pytest
from cantools.autosar.end_to_end import compute_profile2_crc, compute_profile5_crc

from adacd_hil.wire.codec import Codec, CodecError
from adacd_hil.wire.dbc_contract import contract_folder, load_codec
from adacd_hil.wire.e2e import E2eReceiver, E2eSender, Protection

FD = load_codec(contract_folder() / "arm_fd.dbc")
HALF_MS = load_codec(contract_folder() / "arm_fd_500us.dbc")
CLASSIC = load_codec()
PROTECTED = ("Drive1Feedback", "Drive2Feedback", "Sensor1Torque", "Sensor2Torque", "Drive1Command", "Drive2Command")


@pytest.mark.parametrize("codec", [FD, HALF_MS], ids=["arm_fd", "arm_fd_500us"])
def test_an_fd_contract_is_the_classic_one_without_status_frames(codec: Codec) -> None:
    statuses = {"Drive1Status", "Drive2Status", "Sensor1Status", "Sensor2Status"}
    assert set(codec.messages) == set(CLASSIC.messages) - statuses
    for name, message in codec.messages.items():
        assert message.can_id == CLASSIC.message(name).can_id
        if name not in PROTECTED:
            assert message.signals == CLASSIC.message(name).signals


@pytest.mark.parametrize("name", ["Drive1Feedback", "Drive1Status", "Sensor1Torque", "Sensor1Status", "Drive1Command"])
def test_every_classic_signal_is_found_under_its_name_and_scale_in_the_fd_contract(name: str) -> None:
    frame = {"Drive1Status": "Drive1Feedback", "Sensor1Status": "Sensor1Torque"}.get(name, name)
    there = {signal.name: signal for signal in FD.message(frame).values}
    for signal in CLASSIC.message(name).values:
        fd = there[signal.name]
        assert (fd.unit, fd.scale, fd.offset, fd.raw_low) == (signal.unit, signal.scale, signal.offset, signal.raw_low)


@pytest.mark.parametrize(
    ("codec", "protection", "header_bytes", "is_fd"),
    [(CLASSIC, Protection.PROFILE_2, 2, False), (FD, Protection.PROFILE_5, 4, True)],
    ids=["arm", "arm_fd"],
)
def test_a_message_says_how_it_is_protected(
    codec: Codec, protection: Protection, header_bytes: int, is_fd: bool
) -> None:
    command, sync = codec.message("Drive1Command"), codec.message("Sync")
    assert (command.protection, command.header_bytes, command.is_fd) == (protection, header_bytes, is_fd)
    assert (sync.protection, sync.header_bytes, sync.is_fd) == (Protection.NONE, 0, False)
    assert codec.is_fd is is_fd
    assert type(sync.sender()) is E2eSender
    assert type(sync.receiver()) is E2eReceiver


@pytest.mark.parametrize("codec", [FD, HALF_MS], ids=["arm_fd", "arm_fd_500us"])
def test_cantools_finds_the_crc_of_a_sent_frame_right(codec: Codec) -> None:
    frame = CLASSIC.message("Drive1Command").sender().protect(CLASSIC.message("Drive1Command").encode_raw(15, -123))
    assert frame[0] == compute_profile2_crc(frame, CLASSIC.message("Drive1Command").data_ids[0])
    for name in PROTECTED:
        message = codec.message(name)
        frame = message.sender().protect(message.encode_raw(*range(1, 1 + len(message.values))))
        crc = compute_profile5_crc(frame, int.from_bytes(message.data_ids, "little"))
        assert frame[0] | frame[1] << 8 == crc


@pytest.mark.parametrize("codec", [CLASSIC, FD, HALF_MS], ids=["arm", "arm_fd", "arm_fd_500us"])
def test_no_receiver_takes_the_frame_of_another_message(codec: Codec) -> None:
    protected = [message for message in codec.messages.values() if message.is_protected]
    for mine in protected:
        for other in protected:
            frame = other.sender().protect(bytearray(other.length))
            assert mine.receiver().check(frame).is_valid is (mine is other)


def test_the_data_ids_of_all_fd_contracts_differ() -> None:
    ids = [codec.message(name).data_ids for codec in (FD, HALF_MS) for name in PROTECTED]
    assert len(set(ids)) == len(ids)


def edited(tmp_path: Path, *changes: tuple[str, str]) -> Path:
    text = (contract_folder() / "arm_fd.dbc").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "edited.dbc"
    path.write_text(text)
    return path


def test_the_layout_digest_of_the_classic_contract_is_that_of_wire_version_1() -> None:
    assert (CLASSIC.wire_version, CLASSIC.layout_digest) == (1, 0xF80FDAE0)


@pytest.mark.parametrize("length", [0, 8, 9, 12, 13, 63, 64])
def test_only_lengths_with_a_data_length_code_are_taken(tmp_path: Path, length: int) -> None:
    signals = "".join(f' SG_ b{index} : {8 * index}|8@1+ (1,0) [0|255] "" HOST\n' for index in range(length))
    fd = 'BA_DEF_ BO_ "VFrameFormat" ENUM ' + ",".join(f'"f{index}"' for index in range(14)) + ',"StandardCAN_FD";\n'
    path = tmp_path / "lengths.dbc"
    path.write_text(
        f'VERSION ""\n\nBU_: HOST\n\nBO_ 5 Probe: {length} HOST\n{signals}\nBA_DEF_ "WireVersion" INT 1 9;\n{fd}'
        f'BA_ "WireVersion" 1;\n' + ('BA_ "VFrameFormat" BO_ 5 14;\n' if length > 8 else "")
    )
    if length <= 8 or length in (12, 16, 20, 24, 32, 48, 64):
        assert load_codec(path).message("Probe").is_fd is (length > 8)
    else:
        with pytest.raises(CodecError, match=rf"Probe: no CAN frame has {length} bytes; beyond 8 there are 12, 16, 20"):
            load_codec(path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (('BA_ "VFrameFormat" BO_ 385 14;\n', ""), r"Drive1Feedback: 24 bytes need VFrameFormat StandardCAN_FD"),
        (
            ('BA_ "VFrameFormat" BO_ 385 14;', 'BA_ "VFrameFormat" BO_ 385 14;\nBA_ "VFrameFormat" BO_ 128 14;'),
            r"Sync: 1 bytes go in a classic frame; VFrameFormat says CAN FD",
        ),
        (
            ('BA_ "E2EProfile" BO_ 385 "P05";', 'BA_ "E2EProfile" BO_ 385 "P04";'),
            r"Drive1Feedback: E2EProfile = 'P04' is none of '', 'P02', 'P05'",
        ),
        (
            ('BA_ "E2EProfile" BO_ 385 "P05";', 'BA_ "E2EProfile" BO_ 385 "P02";'),
            r"Drive1Feedback: E2EDataIdList has 0 bytes, 16 expected",
        ),
        (('BA_ "E2EDataId" BO_ 385 36486;\n', ""), r"Drive1Feedback: E2EProfile P05 without E2EDataId"),
        (('BA_ "E2EProfile" BO_ 385 "P05";\n', ""), r"Drive1Feedback: E2EDataId without E2EProfile"),
        (
            ('BA_ "E2EDataId" BO_ 385 36486;', 'BA_ "E2EDataId" BO_ 385 65536;'),
            r"Drive1Feedback: E2EDataId = 65536 is no integer of 0..65535",
        ),
        (
            (
                "BO_ 385 Drive1Feedback: 24 DRIVE1\n SG_ e2e_crc : 0|16@1+",
                "BO_ 385 Drive1Feedback: 24 DRIVE1\n SG_ crc : 0|16@1+",
            ),
            r"protected by P05 begins with unsigned e2e_crc \(16 bits\), e2e_counter \(8 bits\), e2e_status \(8 bits\)",
        ),
    ],
    ids=["FD not said", "FD of 1 byte", "P04", "P02 without list", "no data id", "no profile", "65536", "no header"],
)
def test_an_fd_contract_that_cant_work_is_refused_by_name(tmp_path: Path, change: tuple[str, str], reason: str) -> None:
    with pytest.raises(CodecError, match=reason) as caught:
        load_codec(edited(tmp_path, change))
    assert "\n" not in str(caught.value)
