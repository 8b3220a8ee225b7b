"""What `scan` prints, for people and machines."""

import json

from bench_bus import CODEC, BenchBus

from adacd_hil.cli.scan import as_text, describe
from adacd_hil.device.survey import compare, expected_nodes, survey


def scanned(rig: BenchBus) -> dict:
    found = survey(rig.bus, rig.clock)
    return describe(found, compare(found, expected_nodes(rig.master.slaves)), CODEC)


def test_the_table_shows_nodes_what_they_send_and_whether_they_fit() -> None:
    rig = BenchBus()
    rig.start()
    rig.add_host()
    rig.bus.deliver(0x055, b"\x01")
    lines = as_text(scanned(rig)).splitlines()
    assert (
        "   1  CiA 402 drive             adacd-hil torque drive         0x41444143  0x402    0x10001   1  " in lines[1]
    )
    assert lines[1].endswith("operational  0x00   as expected")
    cells = [line.split() for line in lines]
    (feedback,) = [row for row in cells if "Drive1Feedback" in row]
    assert (feedback[:4], feedback[5]) == (["1", "0x181", "Drive1Feedback", "8"], "1000.0")
    assert ["0x055", "unknown", "1", "1", "-"] in cells
    assert lines[-1] == "nodes: 4 as expected"


def test_the_table_names_who_is_missing() -> None:
    rig = BenchBus()
    rig.silence(4)
    lines = as_text(scanned(rig)).splitlines()
    assert lines[4].endswith("missing: Sensor2 expected")
    assert lines[-1] == "nodes: 3 as expected, 1 missing"


def test_nodes_that_only_answer_are_not_taken_for_silence() -> None:
    rig = BenchBus()
    rig.forget()
    text = as_text(scanned(rig))
    assert "nothing was heard" not in text
    assert text.splitlines()[-3:] == [
        "the nodes answered, and sent nothing by themselves in 1.5 s",
        "",
        "nodes: 4 as expected",
    ]


def test_an_empty_bus_is_said_to_be() -> None:
    rig = BenchBus()
    rig.tamper = lambda can_id, data: None
    rig.forget()
    text = as_text(scanned(rig))
    assert "nothing was heard in 1.5 s" in text
    assert text.splitlines()[-1] == "nodes: 0 as expected, 4 missing"


def test_the_result_is_json() -> None:
    described = scanned(BenchBus())
    assert json.loads(json.dumps(described)) == described
