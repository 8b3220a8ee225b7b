"""How exactly values have to agree, and when the tolerance between machines applies."""

import numpy as np
import pytest

from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.log.log_files import arithmetic
from adacd_hil.log.mcap.record_layout import record_dtype
from adacd_hil.log.reader import LoggedEvent, Series
from adacd_hil.log.types.topics import run_channels
from adacd_hil.records import Event, scheme_layout
from adacd_hil.replay.scheme_comparison import SchemeComparison, different_arithmetic
from adacd_hil.scheme.pipeline.pipeline import SchemeBatch
from adacd_hil.settings.configuration_files import load_settings

SETTINGS = load_settings("paper")
LAYOUT = scheme_layout(7)
DTYPE = next(record_dtype(channel.type.dtype) for channel in run_channels(7) if channel.topic == "/scheme")
TICKS = Ticks(np.arange(3), np.arange(3) * 1_000_000, np.ones(3, np.int64))
THETA = LAYOUT.slices["theta_hat"]


def batch(**changes) -> SchemeBatch:
    block = np.ones((3, LAYOUT.size))
    columns = {name: np.zeros(3, np.uint8) for name in ("state", "previous_state", "fault", "reaction")}
    plain = SchemeBatch(
        cycle=TICKS.cycle,
        **columns,
        contact_joints=np.zeros(3, np.int64),
        is_model_valid=np.zeros(3, bool),
        block=block,
        contacts=[],
        contact_places=np.zeros(0, np.int64),
    )
    return plain._replace(**changes)


def records(decided: SchemeBatch) -> Series:
    logged = np.zeros(3, DTYPE)
    for name in ("cycle", "state", "previous_state", "fault", "contact_joints", "is_model_valid"):
        logged[name] = getattr(decided, name)
    for name, place in LAYOUT.slices.items():
        logged[name] = decided.block[:, place].reshape(logged[name].shape)
    logged["nanosec"] = TICKS.t_ns
    return Series(logged, 0)


def off_by(value: float, scale: float = 1.0) -> SchemeBatch:
    block = np.ones((3, LAYOUT.size))
    block[:, THETA] = scale
    block[1, THETA.start + 2] += value
    return batch(block=block)


def count(logged: SchemeBatch, replayed: SchemeBatch, tolerance: float) -> int:
    comparison = SchemeComparison(SETTINGS, tolerance)
    comparison.compare(records(logged), TICKS, replayed)
    return comparison.count


@pytest.mark.parametrize(
    ("value", "scale", "tolerance", "expected"),
    [
        (0.0, 1.0, 0.0, 0),
        (1e-15, 1.0, 0.0, 1),
        (0.9e-9, 1.0, 1e-9, 0),
        (1.1e-9, 1.0, 1e-9, 1),
        (0.9e-6, 1000.0, 1e-9, 0),
        (1.1e-6, 1000.0, 1e-9, 1),
        (0.9e-9, 0.001, 1e-9, 0),  # of one unit where the field is smaller
        (np.inf, 1.0, 1e-9, 1),
        (np.nan, 1.0, 1e-9, 1),
    ],
)
def test_a_real_value_may_be_off_by_the_tolerance_of_its_fields_scale(value, scale, tolerance, expected):
    assert count(off_by(0.0, scale), off_by(value, scale), tolerance) == expected


def test_the_sign_of_zero_counts_bit_for_bit_and_neither_it_nor_not_a_number_between_machines():
    zeros, minus = off_by(-1.0), off_by(-1.0)
    minus.block[1, THETA.start + 2] = -0.0
    assert [count(zeros, minus, tolerance) for tolerance in (0.0, 1e-9)] == [1, 0]
    assert count(off_by(np.nan), off_by(np.nan), 1e-9) == 0


def test_a_decision_has_to_be_the_same_between_machines_too():
    assert count(batch(), batch(state=np.array([0, 1, 0], np.uint8)), 1e-9) == 1


def test_all_mismatches_are_counted_and_the_earliest_are_kept():
    comparison = SchemeComparison(SETTINGS, shown=4)
    comparison.compare(records(batch()), TICKS, batch(block=np.full((3, LAYOUT.size), 2.0)))
    assert comparison.count == 3 * LAYOUT.size
    assert [mismatch.cycle for mismatch in comparison.first()] == [0] * 4
    assert comparison.fields["/scheme.theta_hat"] == 21


def test_the_schemes_events_are_compared_in_order():
    comparison = SchemeComparison(SETTINGS)
    half, third = Event("warning", "margin", "half"), Event("info", "certificate", "third")
    first, later = LoggedEvent(5, half), LoggedEvent(int(TICKS.t_ns[2]) + 9, third)
    comparison.compare_events([first], [half], TICKS)
    assert comparison.count == 0
    comparison.compare_events([first, later], [half], TICKS)
    comparison.compare_events([first], [half, third], TICKS)
    comparison.compare_events([first], [Event("info", "margin", "half")], TICKS)
    assert [(one.field, one.cycle, one.t_ns, one.logged, one.replayed) for one in comparison.first()] == [
        ("certificate", 0, 0, "'no event'", "'info: third'"),
        ("margin", 0, 0, "'warning: half'", "'info: half'"),
        ("certificate", 2, TICKS.t_ns[2], "'info: third'", "'no event'"),
    ]


def test_only_another_arithmetic_asks_for_a_tolerance():
    here = arithmetic()
    assert different_arithmetic(here) == []
    assert different_arithmetic({}) == []
    assert different_arithmetic({**here, "machine": "Linux 1.2.3 " + here["machine"].split()[-1]}) == []
    assert different_arithmetic({**here, "machine": "Linux 6.1 riscv64"}) != []
    assert "numba 0.1" in different_arithmetic({**here, "numba": "0.1"})[0]
