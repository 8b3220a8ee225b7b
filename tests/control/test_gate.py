"""The last stage before the wire, densely around every bound."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adacd_hil.config import ArmSettings
from adacd_hil.control.gate import Gate, GateFlag

PERIOD_S = 0.001
LIMIT_NM = (12.0, 6.0)
STEP_NM = (2.0, 1.0)
SETTINGS = ArmSettings(torque_limit_Nm=LIMIT_NM, torque_rate_limit_Nm_s=(2000.0, 1000.0))


def limited(gate: Gate, tau_d: tuple[float, float], is_open: bool = True) -> tuple[tuple[float, float], GateFlag]:
    tau_c = np.full(2, np.nan)
    flags = gate.limit(np.array(tau_d), is_open, tau_c)
    return (float(tau_c[0]), float(tau_c[1])), flags


def gate_at(tau: tuple[float, float]) -> Gate:
    """Make a gate that has let `tau` through."""
    gate = Gate(SETTINGS, PERIOD_S)
    for _ in range(10):
        reached, _ = limited(gate, tau)
    assert reached == tau
    return gate


def around(bound: float) -> list[float]:
    return [math.nextafter(bound, 0.0), bound, math.nextafter(bound, math.inf), bound * 1.001, bound * 1.5]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("index", range(5))
def test_torque_is_clipped_exactly_at_its_limit(joint: int, index: int, sign: float) -> None:
    start = [0.0, 0.0]
    start[joint] = sign * (LIMIT_NM[joint] - 0.5 * STEP_NM[joint])
    wanted = list(start)
    wanted[joint] = sign * min(around(LIMIT_NM[joint])[index], LIMIT_NM[joint] + 0.4 * STEP_NM[joint])
    reached, flags = limited(gate_at((start[0], start[1])), (wanted[0], wanted[1]))
    is_inside = abs(wanted[joint]) <= LIMIT_NM[joint]
    expected = wanted[joint] if is_inside else sign * LIMIT_NM[joint]
    assert (reached[joint], bool(flags & GateFlag.TORQUE)) == (expected, not is_inside)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("index", range(5))
def test_the_change_is_clipped_exactly_at_its_limit(joint: int, index: int, sign: float) -> None:
    wanted = [0.0, 0.0]
    wanted[joint] = sign * around(STEP_NM[joint])[index]
    reached, flags = limited(Gate(SETTINGS, PERIOD_S), (wanted[0], wanted[1]))
    is_inside = abs(wanted[joint]) <= STEP_NM[joint]
    expected = wanted[joint] if is_inside else sign * STEP_NM[joint]
    assert (reached[joint], bool(flags & GateFlag.RATE)) == (expected, not is_inside)


@given(
    wanted=st.lists(
        st.tuples(st.floats(allow_nan=True, allow_infinity=True), st.floats(allow_nan=True, allow_infinity=True)),
        min_size=1,
        max_size=30,
    )
)
def test_nothing_that_leaves_the_gate_breaks_a_limit(wanted: list[tuple[float, float]]) -> None:
    gate = Gate(SETTINGS, PERIOD_S)
    for tau_d in wanted:
        reached, _ = limited(gate, tau_d)
        assert all(abs(tau) <= bound for tau, bound in zip(reached, LIMIT_NM, strict=True))


@given(wanted=st.lists(st.tuples(st.floats(-30, 30), st.floats(-30, 30)), min_size=2, max_size=30))
def test_no_step_breaks_the_rate(wanted: list[tuple[float, float]]) -> None:
    gate = Gate(SETTINGS, PERIOD_S)
    passed = [(0.0, 0.0)] + [limited(gate, tau_d)[0] for tau_d in wanted]
    steps = np.abs(np.diff(np.array(passed), axis=0))
    assert np.all(steps <= np.array(STEP_NM) * (1 + 1e-12))


@given(tau=st.tuples(st.floats(-1.9, 1.9), st.floats(-0.9, 0.9)))
def test_what_is_inside_passes_bit_for_bit(tau: tuple[float, float]) -> None:
    assert limited(Gate(SETTINGS, PERIOD_S), tau) == (tau, GateFlag.NONE)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("joint", [0, 1])
def test_a_torque_that_is_not_finite_zeroes_both_joints(joint: int, bad: float) -> None:
    wanted = [1.0, 0.5]
    wanted[joint] = bad
    assert limited(gate_at((1.0, 0.5)), (wanted[0], wanted[1])) == ((0.0, 0.0), GateFlag.NOT_A_NUMBER)


def test_a_closed_gate_zeroes_the_torque_at_once() -> None:
    assert limited(gate_at((12.0, 6.0)), (12.0, 6.0), is_open=False) == ((0.0, 0.0), GateFlag.CLOSED)


def test_torque_rises_from_zero_when_the_gate_opens_again() -> None:
    gate = gate_at((12.0, 6.0))
    limited(gate, (12.0, 6.0), is_open=False)
    assert limited(gate, (12.0, 6.0)) == (STEP_NM, GateFlag.RATE)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_fall_is_limited_as_a_rise_is(sign: float) -> None:
    reached, flags = limited(gate_at((sign * 11.0, 0.0)), (sign * 5.0, 0.0))
    assert (reached[0], flags) == (sign * (11.0 - STEP_NM[0]), GateFlag.RATE)
