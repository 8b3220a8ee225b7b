"""The codec: written by hand, against cantools bit for bit, and what it refuses."""

import re
from pathlib import Path

import cantools
import pytest
from edited_contract import edited
from hypothesis import given, settings
from hypothesis import strategies as st
from loaded import encoded

from adacd_hil.wire.codec import CodecError
from adacd_hil.wire.dbc_contract import contract_folder, load_codec, parse_codec
from adacd_hil.wire.e2e import E2eStatus

CODEC = load_codec()
CONTRACTS = ("arm", "arm_fd", "arm_fd_500us")
CODECS = {name: load_codec(contract_folder() / f"{name}.dbc") for name in CONTRACTS}
PEERS = {name: cantools.database.load_file(contract_folder() / f"{name}.dbc") for name in CONTRACTS}
MESSAGES = [  # what isn't protected is the same in all contracts
    (contract, name)
    for contract in CONTRACTS
    for name, message in sorted(CODECS[contract].messages.items())
    if contract == "arm" or message.is_protected
]

# message, bytes on the wire, values after the end-to-end header; every field a different value
FRAMES = [
    ("Sync", "a5", (165.0,)),
    ("Nmt", "8203", (130.0, 3.0)),
    ("Drive1Feedback", "40420f0018fcffff", (1_000_000 * 5.9921124526782858e-06, -0.5)),
    ("Drive2Status", "37120a9cff1f86", (4663.0, 10.0, -100.0, 34335.0)),
    ("Sensor1Torque", "a7c960e31600", (1.5,)),
    ("Drive1Command", "31020f0085ff", (15.0, -123.0)),
    ("Sensor2Status", "0581", (5.0, 129.0)),
    ("Drive2Emcy", "50822107ddccbbaa", (33360.0, 33.0, 7.0, 2864434397.0)),
    ("Sensor2SdoRequest", "2317100501020304", (35.0, 4119.0, 5.0, 67305985.0)),
    ("HostHeartbeat", "05", (5.0,)),
]
POSITION_RAD = 1_000_000 * 5.9921124526782858e-06
FD_COMMAND = "ca1c07a5" + "0f00" + "85ff" + "0c00" + "e803", (15.0, -123.0, 12.0, 1000.0)
FD_FRAMES = [
    (
        "arm_fd",
        "Drive1Feedback",
        "ca1c07a5" + "40420f00" + "18fcffff" + "3712" + "0a" + "21" + "9cff" + "1f86" + "7d00" + "39a0",
        (POSITION_RAD, -0.5, 4663.0, 10.0, 33.0, -100.0, 34335.0, 125.0, 41017.0),
    ),
    ("arm_fd", "Drive2Command", *FD_COMMAND),
    (
        "arm_fd",
        "Sensor1Torque",
        "ca1c07a5" + "60e31600" + "c0bdf0ff" + "05" + "81" + "9308",
        (1.5, -1.0, 5.0, 129.0, 21.95),
    ),
    (
        "arm_fd_500us",
        "Drive2Feedback",
        "ca1c07a5" + "40420f00" + "18fcffff" + "3712" + "1f86",
        (POSITION_RAD, -0.5, 4663.0, 34335.0),
    ),
    ("arm_fd_500us", "Drive1Command", *FD_COMMAND),
    ("arm_fd_500us", "Sensor2Torque", "ca1c07a5" + "60e31600" + "05" + "81" + "9308", (1.5, 5.0, 129.0, 21.95)),
]


@pytest.mark.parametrize(("contract", "name", "wire", "values"), [*(("arm", *row) for row in FRAMES), *FD_FRAMES])
def test_a_frame_written_by_hand_decodes_to_its_values_and_they_encode_to_it(
    contract: str, name: str, wire: str, values: tuple[float, ...]
) -> None:
    message, frame = CODECS[contract].message(name), bytes.fromhex(wire)
    assert message.decode_values(frame) == pytest.approx(values, rel=1e-12)
    assert bytes(encoded(message, *values))[message.header_bytes :] == frame[message.header_bytes :]
    if contract != "arm":
        assert message.decode(frame)[:3] == (0x1CCA, 7.0, 165.0)


@pytest.mark.parametrize(("contract", "name"), MESSAGES)
@settings(max_examples=30)
@given(data=st.data())
def test_cantools_decodes_and_encodes_every_frame_to_the_same(contract: str, name: str, data: st.DataObject) -> None:
    message, peer = CODECS[contract].message(name), PEERS[contract].get_message_by_name(name)
    wire = data.draw(st.binary(min_size=message.length, max_size=message.length))
    theirs = peer.decode(wire, decode_choices=False)
    assert message.decode(wire) == tuple(theirs[signal.name] for signal in message.signals)
    assert message.decode_values(wire) == tuple(theirs[signal.name] for signal in message.values)
    ranges = {signal.name: st.integers(signal.raw_low, signal.raw_high) for signal in message.signals}
    raw = data.draw(st.fixed_dictionaries(ranges))
    physical = tuple(raw[signal.name] * signal.scale + signal.offset for signal in message.values)
    body = [raw[signal.name] for signal in message.values]
    sender, receiver = message.sender(), message.receiver()
    for _ in range(3):
        frame = sender.protect(message.encode_raw(*body))
        assert receiver.check(frame) is E2eStatus.OK
        assert message.decode_values(frame) == physical
    if message.is_protected:
        raw |= {"e2e_crc": 0, "e2e_counter": 0, "e2e_status": 0}
    assert bytes(message.encode_raw(*body)) == peer.encode(raw, scaling=False, strict=False)


def test_a_frame_of_the_wrong_length_is_refused() -> None:
    with pytest.raises(CodecError, match=r"Drive1Feedback has 7 bytes, 8 expected"):
        CODEC.message("Drive1Feedback").decode(bytes(7))


def test_a_signed_bit_field_keeps_its_sign() -> None:
    whole = ' SG_ counter : 0|8@1+ (1,0) [1|240] ""'
    halves = ' SG_ counter : 0|4@1+ (1,0) [0|15] "" HOST\n SG_ turn : 4|4@1- (1,0) [-8|7] ""'
    message = edited((whole, halves)).message("Sync")
    assert message.decode(b"\x83") == (3.0, -8.0)
    assert message.decode_values(b"\xf5") == (5.0, -1.0)
    with pytest.raises(CodecError, match="Sync has bit fields, which no raw integers are packed into"):
        message.encode_raw(3, -8)


REFUSED = {
    "version in words": (
        'BA_DEF_ "WireVersion" INT 1 65535;\nBA_DEF_',
        'BA_DEF_ "WireVersion" STRING;\nBA_DEF_',
        r"attribute WireVersion is '1', not a number",
    ),
    "big endian": (
        "controlword : 16|16@1+",
        "controlword : 23|16@0+",
        r"Drive1Command.controlword: only plain little",
    ),
    "a float, which could be NaN": (
        "VAL_ 641",
        "SIG_VALTYPE_ 387 torque : 1;\nVAL_ 641",
        r"Sensor1Torque.torque: only plain little-endian integers can be cyclic",
    ),
    "31 bits": ("SG_ velocity : 32|32@1-", "SG_ velocity : 32|31@1-", r"Drive1Feedback.velocity: bits 32\+31 overlap"),
    "a gap": (' SG_ error_register : 8|8@1+ (1,0) [0|255] "" HOST\n', "", r"Sensor1Status: signals cover 8 of 16 bits"),
    "no header": (
        "SG_ e2e_crc : 0|8@1+",
        "SG_ other : 0|8@1+",
        r"Sensor1Torque: a message protected by P02 begins with unsigned e2e_crc \(8 bits\), e2e_counter \(4",
    ),
    "17 data ids": ('BO_ 387 "', 'BO_ 387 "00', r"Sensor1Torque: E2EDataIdList has 17 bytes, 16 expected"),
    "no hex": ("728145e7", "zz8145e7", r"E2EDataIdList = 'zz8145e7.*' is not hexadecimal"),
    "signed header": ("e2e_status : 12|4@1+", "e2e_status : 12|4@1-", r"protected by P02 begins with unsigned"),
}
FD_FORMAT, PROFILE, DATA_ID = 'BA_ "VFrameFormat" BO_ 385 14;', 'BA_ "E2EProfile" BO_ 385 "P05";', '"E2EDataId" BO_ 385'
REFUSED_FD = {
    "FD not said": (FD_FORMAT, "", r"Drive1Feedback: 24 bytes need VFrameFormat StandardCAN_FD"),
    "FD of 1 byte": (
        FD_FORMAT,
        f"{FD_FORMAT}\n{FD_FORMAT.replace('385', '128')}",
        r"Sync: 1 bytes go in a classic frame; VFrameFormat says CAN FD",
    ),
    "P04": (PROFILE, PROFILE.replace("P05", "P04"), r"Drive1Feedback: E2EProfile = 'P04' is none of '', 'P02', 'P05'"),
    "P02 without list": (
        PROFILE,
        PROFILE.replace("P05", "P02"),
        r"Drive1Feedback: E2EDataIdList has 0 bytes, 16 ",
    ),
    "no data id": (f"BA_ {DATA_ID} 36486;", "", r"Drive1Feedback: E2EProfile P05 without E2EDataId"),
    "no profile": (PROFILE, "", r"Drive1Feedback: E2EDataId without E2EProfile"),
    "65536": (f"{DATA_ID} 36486", f"{DATA_ID} 65536", r"Drive1Feedback: E2EDataId = 65536 is no integer of 0..65535"),
    "no header of 4 bytes": (
        "Drive1Feedback: 24 DRIVE1\n SG_ e2e_crc : 0|16@1+",
        "Drive1Feedback: 24 DRIVE1\n SG_ crc : 0|16@1+",
        r"protected by P05 begins with unsigned e2e_crc \(16 bits\), e2e_counter \(8 bits\), e2e_status \(8 bits\)",
    ),
}


@pytest.mark.parametrize("kind", [*REFUSED, *REFUSED_FD])
def test_a_dbc_that_cant_be_a_contract_is_refused_by_name_in_one_line(kind: str) -> None:
    old, new, reason = (REFUSED | REFUSED_FD)[kind]
    with pytest.raises(CodecError, match=reason) as caught:
        edited((old, new), name="arm" if kind in REFUSED else "arm_fd")
    assert "\n" not in str(caught.value)


def test_a_dbc_without_a_needed_message_is_refused_by_name() -> None:
    with pytest.raises(CodecError, match="message Drive3Feedback is missing in the DBC"):
        CODEC.message("Drive3Feedback")


def test_a_file_that_is_not_a_dbc_or_not_there_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "not.dbc"
    for reason in ("none.dbc: No such file", "not.dbc can't be read"):
        with pytest.raises(CodecError, match=reason) as caught:
            load_codec(tmp_path / reason.partition(":")[0].partition(" ")[0])
        assert "\n" not in str(caught.value)
        path.write_text("hello\nworld")


def test_a_signal_of_gigabits_is_refused_before_it_is_laid_out() -> None:
    text = (contract_folder() / "arm.dbc").read_bytes()
    for bits in (b"2147483648", b"0513", b"9" * 5000):
        hostile = re.sub(rb"\|32@1-", b"|" + bits + b"@1-", text, count=1)
        with pytest.raises(CodecError, match=r"a signal has [0-9]{3,20} bits, more than 512$"):
            parse_codec(hostile, Path("x.dbc"))
