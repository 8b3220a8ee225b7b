"""A topic, and a field of a topic, are added by declaring them: writer, reader, check and export follow."""

import csv
from dataclasses import replace
from enum import IntEnum

import numpy as np
import pytest
from recorded_run import payloads

from adacd_hil.lab.logs.check.log_check import check_log
from adacd_hil.lab.logs.signal_tables import export_tables
from adacd_hil.log.reader import LogStream, read_log
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.log.types import topics
from adacd_hil.log.types.message_types import Member
from adacd_hil.log.types.topics import SCHEME, OwnTopic
from adacd_hil.records import Field, Layout, Request, SchemeState, scheme_layout
from adacd_hil.wire.dbc_decoder import load_decoder

CYCLES = 40
PERIOD_NS = 1_000_000


class Charge(IntEnum):
    EMPTY = 0
    FULL = 3


BATTERY = OwnTopic(
    15,
    "/battery",
    "Battery",
    head=(
        Member("cycle", "uint64", meaning="number of the cycle"),
        Member("charge", "uint8", meaning="Charge", values=Charge),
        Member("cell_V", "float64", 3, "V", "voltage of each cell"),
    ),
    block=lambda *_: Layout((Field("heat", 2, "K", "of both ends"),)),
)
WIDER_SCHEME = replace(
    SCHEME,
    head=(*SCHEME.head, Member("mood", "int32", meaning="of the operator")),
    block=lambda parameters, *_: Layout(
        (Field("first", 1, "", ""), *scheme_layout(parameters).fields, Field("warmth", 2, "K", ""))
    ),
)


def battery(number: int) -> bytes:
    return BATTERY.pack(number, Charge.FULL, (3.0 + number, 2.0, 1.0), block=np.array([0.5, float(number)]))


def scheme(number: int) -> bytes:
    block = np.arange(WIDER_SCHEME.block(7).size) + 100.0 * number
    return WIDER_SCHEME.pack(number, SchemeState.ADAPT, 0, 0, Request.NONE, 0, True, -7, block=block)


def record(path, topic, pack):
    """Write a log of one topic."""
    with Recorder(path, messages=(), blocking=True) as recorder:
        for number in range(CYCLES):
            recorder.cycle((number + 1) * PERIOD_NS, [(topic.id, pack(number))])
        assert recorder.close().is_complete


@pytest.fixture
def path(tmp_path, monkeypatch):
    """Where a log is put that has both."""
    others = tuple(topic for topic in topics.RUN_TOPICS if topic is not SCHEME)
    monkeypatch.setattr(topics, "RUN_TOPICS", (*others, WIDER_SCHEME, BATTERY))
    return tmp_path / "run.mcap"


def test_a_topic_is_added_by_its_declaration(path, tmp_path):
    record(path, BATTERY, battery)
    series = read_log(path).topics["/battery"]
    assert series.fields == ("cycle", "charge", "cell_V", "heat")
    assert series["cycle"].tolist() == list(range(CYCLES))
    assert series["charge"].tolist() == [Charge.FULL] * CYCLES
    assert series["cell_V"].tolist() == [[3.0 + number, 2.0, 1.0] for number in range(CYCLES)]
    assert series["heat"].tolist() == [[0.5, float(number)] for number in range(CYCLES)]
    (piece,) = LogStream(path)
    assert payloads(piece.series["/battery"]) == payloads(series)
    assert check_log(path).findings == []
    export_tables(path, tmp_path / "out", "csv", ("battery",), load_decoder())
    with (tmp_path / "out" / "battery.csv").open(newline="") as file:
        assert [row["cell_V_1"] for row in csv.DictReader(file)] == [str(3.0 + number) for number in range(CYCLES)]
    assert "uint8 CHARGE_FULL=3\nuint8 charge  # charge: Charge\n" in BATTERY.channel().type.text


def test_a_message_of_a_topic_that_was_added_is_as_long_as_it_says(path):
    record(path, BATTERY, lambda number: battery(number) + bytes(8 * (number == 3)))
    assert [finding.rule for finding in check_log(path).findings] == ["cdr"]


def test_fields_of_scheme_are_added_by_their_declaration(path):
    record(path, WIDER_SCHEME, scheme)
    log = read_log(path)
    place = WIDER_SCHEME.block(7).slices
    assert log.scheme["mood"].tolist() == [-7] * CYCLES
    assert log.scheme["first"].tolist() == [100.0 * number for number in range(CYCLES)]
    assert log.scheme["warmth"][1].tolist() == [100.0 + place["warmth"].start, 101.0 + place["warmth"].start]
    for name in ("q", "dq", "tau_J"):
        assert log.topics["/joint_states"][name].tolist() == log.scheme[name].tolist()
    assert check_log(path).findings == []
