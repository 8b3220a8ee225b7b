"""The CAN FD contracts: their protection, and what a contract may not say."""

from pathlib import Path

import pytest
from cantools.autosar.end_to_end import compute_profile2_crc, compute_profile5_crc

from adacd_hil.wire.codec import Codec, CodecError
from adacd_hil.wire.dbc_contract import contract_folder, load_codec

FD = load_codec(contract_folder() / "arm_fd.dbc")
HALF_MS = load_codec(contract_folder() / "arm_fd_500us.dbc")
CLASSIC = load_codec()
PROTECTED = ("Drive1Feedback", "Drive2Feedback", "Sensor1Torque", "Sensor2Torque", "Drive1Command", "Drive2Command")


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
