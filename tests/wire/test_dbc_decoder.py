"""DBCs of others, which only decode: all that cantools reads; the rules of a contract hold for a contract alone."""

import math
import struct

import numpy as np
import pytest

from adacd_hil.cli.connection import Connection
from adacd_hil.lab.commission.survey import BusView
from adacd_hil.lab.logs.signal_tables import frame_columns
from adacd_hil.log.types.record_arrays import RECORDED_FRAME_DTYPE
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.codec import Codec, CodecError
from adacd_hil.wire.contract_attributes import read_bitrates
from adacd_hil.wire.dbc_contract import contract_folder, load_codec
from adacd_hil.wire.dbc_decoder import DbcDecoder, load_decoder

FOREIGN = """VERSION ""

BU_: Master Motor

BO_ 512 Status: 8 Motor
 SG_ speed : 7|16@0- (0.5,-10) [0|0] "1/min" Master
 SG_ temperature : 20|9@1+ (0.1,-40) [0|0] "°C" Master
 SG_ is_hot : 63|1@1+ (1,0) [0|0] "" Master

BO_ 2566849024 Extended: 4 Motor
 SG_ force : 0|32@1- (1,0) [0|0] "N" Master

BO_ 528 Paged: 8 Motor
 SG_ page M : 0|8@1+ (1,0) [0|0] "" Master
 SG_ current m0 : 8|16@1- (0.01,0) [0|0] "A" Master
 SG_ voltage m1 : 8|16@1+ (0.1,0) [0|0] "V" Master

BO_ 768 Long: 64 Motor
 SG_ last : 480|32@1+ (1,0) [0|0] "" Master

BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","StandardCAN_FD";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "VFrameFormat" BO_ 768 1;
SIG_VALTYPE_ 2566849024 force : 1;
"""


def decoder(text=FOREIGN, code="utf-8", tmp_path=None):
    path = tmp_path / "bus.dbc"
    path.write_bytes(text.encode(code))
    return load_decoder(path)


@pytest.mark.parametrize("code", ["utf-8", "utf-8-sig", "cp1252", "latin-1"])
def test_a_dbc_is_read_in_the_code_that_its_maker_wrote(code, tmp_path):
    assert decoder(code=code, tmp_path=tmp_path).messages["Status"].units["temperature"] == "°C"


def row(can_id, data, is_extended=False, t_ns=0):
    padded = list(data.ljust(64, b"\0"))
    return (t_ns, t_ns, can_id, False, False, len(data), padded, 0, is_extended, False, len(data) > 8, False, False)


def table(frames, read):
    return dict(frame_columns(np.array(frames, RECORDED_FRAME_DTYPE), read))


def test_signals_are_big_endian_cross_bytes_leave_gaps_and_are_floats(tmp_path):
    status = bytes.fromhex("FFEE 50 19 00 00 00 80")
    frames = [row(512, status), row(0x18FF0200, struct.pack("<f", 2.5), is_extended=True, t_ns=7)]
    columns = table(frames, decoder(tmp_path=tmp_path))
    assert columns["Status"]["speed"].tolist() == [-18 * 0.5 - 10]
    assert columns["Status"]["temperature"].tolist() == pytest.approx([0x195 * 0.1 - 40])
    assert columns["Status"]["is_hot"].tolist() == [1.0]
    assert (columns["Extended"]["t_ns"].tolist(), columns["Extended"]["force"].tolist()) == ([7], [2.5])


def test_a_signal_that_a_frame_lacks_is_no_number(tmp_path):
    pages = [row(528, bytes([page, 0xE8, 3, 0, 0, 0, 0, 0])) for page in (0, 1, 9)]
    columns = table([*pages, row(512, b"\xff\xee"), row(512, b"")], decoder(tmp_path=tmp_path))
    assert columns["Paged"]["page"].tolist() == [0.0, 1.0, 9.0]
    assert [math.isnan(value) for value in columns["Paged"]["current"]] == [False, True, True]
    assert columns["Paged"]["voltage"][1] == 100.0
    assert columns["Status"]["speed"].tolist()[0] == -19.0
    assert np.isnan(columns["Status"]["is_hot"]).tolist() == [True, True]


def test_an_identifier_of_29_bits_is_not_one_of_11(tmp_path):
    assert table([row(512, bytes(8), is_extended=True)], decoder(tmp_path=tmp_path)) == {}


def test_the_same_dbc_is_no_contract(tmp_path):
    read = decoder(tmp_path=tmp_path)
    assert read.is_fd
    assert not read.is_contract
    with pytest.raises(CodecError, match=r"Status\.speed: only plain little-endian"):
        load_codec(tmp_path / "bus.dbc")


def test_of_a_contract_a_short_frame_decodes_to_nothing():
    read = load_decoder(contract_folder() / "arm.dbc")
    assert read.is_contract
    can_id, length = read.messages["Drive1Feedback"].can_id, load_codec().message("Drive1Feedback").length
    assert list(
        table([row(can_id, bytes(length)), row(can_id, bytes(length - 1))], read)["Drive1Feedback"]["t_ns"]
    ) == [0]


def test_a_monitor_shows_the_values_of_any_dbc(tmp_path):
    decoder(tmp_path=tmp_path)
    read = Connection("virtual", "x", None, "certified", None, tmp_path / "bus.dbc").load_decoder()
    assert isinstance(read, DbcDecoder)
    view = BusView(read, *read_bitrates(read), 0)
    view.accept(Frame(512, bytes.fromhex("FFEE501900000080"), 1))
    view.accept(Frame(528, b"\x09\0", 2))
    status, paged = view.describe(1_000_000_000)["messages"]
    assert (status["message"], status["errors"]) == ("Status", 0)
    assert (status["values"]["speed"], status["units"]["speed"]) == (-19.0, "1/min")
    assert (paged["message"], paged["values"]) == ("Paged", {"page": 9.0})


def test_a_monitor_with_a_contract_checks_its_frames():
    path = contract_folder() / "arm.dbc"
    read = Connection("virtual", "x", None, "certified", None, path).load_decoder()
    assert not read.message("Drive1Feedback").takes(9)
    assert isinstance(read, Codec)


def test_a_thousand_messages_and_two_of_one_identifier_are_no_matter(tmp_path):
    rows = "".join(
        f'BO_ {number} Row{number}: 1 Motor\n SG_ a : 0|8@1+ (1,0) [0|0] "" Master\n\n' for number in range(1500)
    )
    twin = 'BO_ 1499 Twin: 1 Motor\n SG_ b : 0|4@1+ (1,0) [0|0] "" Master\n\n'
    read = decoder('VERSION ""\n\nBU_: Master Motor\n\n' + rows + twin, tmp_path=tmp_path)
    columns = table([row(1499, b"\x21")], read)
    assert (columns["Row1499"]["a"].tolist(), columns["Twin"]["b"].tolist()) == ([33.0], [1.0])


@pytest.mark.parametrize("text", ["hello", "BO_ 1 A: 8 X\n SG_ s : 0|65 (1\n", 'VERSION "\x00'])
def test_what_is_no_dbc_is_one_line(text, tmp_path):
    with pytest.raises(CodecError, match=f"^DBC {tmp_path / 'bus.dbc'} can't be read: .+$"):
        decoder(text, tmp_path=tmp_path)
