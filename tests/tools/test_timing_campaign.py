"""timing_campaign.py: its contract is the same on the wire, and what it makes of the frames of a bus is right."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import timing_campaign
import timing_disk
import witness

from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.budget import describe_excess
from adacd_hil.wire.dbc_contract import load_codec

MS = 1_000_000


def seen(*rows: tuple[int, int, int]) -> witness.Seen:
    frames = np.zeros(len(rows), witness.RECORD)
    for place, (wall_ns, can_id, data) in enumerate(rows):
        frames[place] = (wall_ns, can_id, 8, data)
    return witness.Seen(frames)


def test_a_contract_that_is_not_judged_is_the_same_on_the_wire(tmp_path: Path) -> None:
    fast = load_settings()
    fast = dataclasses.replace(fast, bus=dataclasses.replace(fast.bus, period_us=500))
    assert describe_excess(load_codec(), fast).startswith("contract arm")
    unjudged = load_codec(timing_campaign.contract_without_budget(tmp_path))
    assert describe_excess(unjudged, fast) == ""
    assert unjudged.layout_digest == load_codec().layout_digest


def test_the_bus_says_how_the_cycle_went() -> None:
    offset_ns = 7 * MS + 123
    low, high = 0, 2**18  # a quarter of a turn
    frames = seen(
        (offset_ns + 1 * MS + 10_000, 0x080, 1),
        (offset_ns + 1 * MS + 300_000, 0x181, low),
        (offset_ns + 1 * MS + 500_000, 0x202, 0),
        (offset_ns + 2 * MS + 20_000, 0x080, 2),
        (offset_ns + 2 * MS + 300_000, 0x181, 2**32 - high),
        (offset_ns + 2 * MS + 820_000, 0x202, 0),
        (offset_ns + 9 * MS, 0x080, 3),
    )
    span = timing_disk.describe_span(frames, offset_ns, offset_ns + 4 * MS, 1000, offset_ns)
    assert (span["cycles"], span["overruns"]) == (2, 2)
    assert span["lateness_us"][0] == pytest.approx(15.0)
    assert span["command_us"][-1] == pytest.approx(800.0)
    assert span["command_us"][0] == pytest.approx(645.0)
    assert span["moved_deg"] == pytest.approx(90.0)


def test_a_cut_record_of_the_witness_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "witness.bin"
    whole = seen((1, 0x080, 5), (2, 0x201, 6)).frames.tobytes()
    path.write_bytes(whole + whole[:10])
    read = witness.read_witness(path)
    assert read.wall_ns.tolist() == [1, 2]
    assert read.of(0x201).data.tolist() == [6]
