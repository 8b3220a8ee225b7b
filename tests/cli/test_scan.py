"""What `scan` prints, for people and machines."""

from rig import CODEC, Rig

from adacd_hil.lab.cli.scan_command import as_text, describe
from adacd_hil.lab.commission.survey import compare, survey
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.dbc_contract import parse_codec


def scanned(rig: Rig, codec: Codec = CODEC) -> dict:
    found = survey(rig.bus, rig.clock, contract_ids={1, 2, 3, 4})
    return describe(found, compare(found, rig.master.slaves, codec), codec)


def test_the_table_shows_nodes_what_they_send_and_whether_they_fit():
    rig = Rig(is_wall=True)
    rig.start()
    rig.add_host()
    rig.bus.deliver(0x055, b"\x01")
    lines = as_text(scanned(rig)).splitlines()
    assert (
        "   1  CiA 402 drive             adacd-hil torque drive         0x41444143  0x402    0x10001   1  " in lines[1]
    )
    assert lines[1].endswith("operational  0x00   as expected")
    cells = [line.split() for line in lines]
    heard = {row[2]: (*row[:2], row[3], row[5]) for row in cells if len(row) == 6}
    assert heard["Drive1Feedback"] == ("1", "0x181", "8", "1000.0")
    assert heard["Drive1Status"] == ("1", "0x281", "7", "10.0")
    assert heard["Drive1Heartbeat"] == ("1", "0x701", "1", "10.0")
    assert any(row[:3] == ["0x080", "Sync", "1"] and row[4] == "1000.0" for row in cells)
    assert ["0x055", "unknown", "1", "1", "-"] in cells
    assert lines[-1] == "nodes: 4 as expected"


def test_nodes_that_only_answer_are_not_taken_for_silence():
    rig = Rig(is_wall=True)
    rig.forget()
    text = as_text(scanned(rig))
    assert "nothing was heard" not in text
    assert text.splitlines()[-4:] == [
        "the nodes answered, and sent nothing by themselves in 1.5 s",
        "",
        "arm.dbc: wire version 1, layout digest 0xF80FDAE0; same in node 1, 2, 3, 4",
        "nodes: 4 as expected",
    ]


def test_nodes_with_another_layout_are_told_apart():
    """The nodes have arm.dbc; the host has it with another scale of the torque."""
    text = CODEC.text.replace(b"@1- (1e-06,0)", b"@1- (2e-06,0)")
    other = parse_codec(text, CODEC.path)
    assert other.layout_digest != CODEC.layout_digest
    described = scanned(Rig(is_wall=True), other)
    digest = f"0x{other.layout_digest:08X}"
    assert [node["verdict"] for node in described["nodes"]] == [
        f"{name} expected; layout digest 0xF80FDAE0, the contract has {digest}"
        for name in ("Drive1", "Drive2", "Sensor1", "Sensor2")
    ]
    lines = as_text(described).splitlines()
    assert lines[-2].startswith(f"arm.dbc: wire version 1, layout digest {digest}; node 1: 0xF80FDAE0; node 2: ")
    assert lines[-1] == "nodes: 0 as expected, 4 different"


def test_a_node_that_tells_no_digest_is_different():
    rig = Rig(is_wall=True)
    rig.tamper = lambda cycle, can_id, data: None if can_id == 0x583 and data[1:4] == bytes.fromhex("002002") else data
    described = scanned(rig)
    verdicts = {node["node"]: node["verdict"] for node in described["nodes"]}
    assert verdicts[3] == "Sensor1 expected; does not answer SDO"
    assert (verdicts[1], verdicts[4]) == ("", "")
