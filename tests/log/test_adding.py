"""A topic is added by declaring it: writer, reader, check and export follow."""

import csv
from enum import IntEnum

import numpy as np
from recorded_run import payloads

from adacd_hil.lab.logs.check.log_check import check_log
from adacd_hil.lab.logs.signal_tables import export_tables
from adacd_hil.log.reader import LogStream, read_log
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.log.types import topics
from adacd_hil.log.types.message_types import Member
from adacd_hil.log.types.topics import OwnTopic
from adacd_hil.records import Field, Layout
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


def test_a_topic_is_added_by_its_declaration(tmp_path, monkeypatch):
    monkeypatch.setattr(topics, "RUN_TOPICS", (*topics.RUN_TOPICS, BATTERY))
    path = tmp_path / "run.mcap"
    with Recorder(path, messages=(), blocking=True) as recorder:
        for number in range(CYCLES):
            cells, heat = (3.0 + number, 2.0, 1.0), np.array([0.5, float(number)])
            recorder.cycle(PERIOD_NS * number, [(BATTERY.id, BATTERY.pack(number, Charge.FULL, cells, block=heat))])
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
