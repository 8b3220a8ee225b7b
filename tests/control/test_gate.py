"""The last stage before the wire, densely around every bound."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adacd_hil.control.gate import Gate, GateFlag
from adacd_hil.settings.arm_settings import ArmSettings

PERIOD_S = 0.001
LIMIT_NM = (12.0, 6.0)
STEP_NM = (2.0, 1.0)
RATE_NM_S = (2000.0, 1000.0)
SETTINGS = ArmSettings(torque_limit_Nm=LIMIT_NM, torque_rate_limit_Nm_s=RATE_NM_S)
UNRATED = ArmSettings(torque_limit_Nm=LIMIT_NM, torque_rate_limit_Nm_s=(1e6, 1e6))
"""Rates that no torque within the limits can break: the torque limit alone."""

JOINTS_AND_SIGNS = list(itertools.product((0, 1), (1.0, -1.0)))
OFFSETS = [sign * 10.0**exponent for exponent in range(-12, 4) for sign in (1.0, -1.0)]


def limited(
    gate: Gate, tau_d: tuple[float, float], is_open: bool = True, age: int = 1
) -> tuple[tuple[float, float], GateFlag]:
    tau_c = np.full(2, np.nan)
    flags = gate.limit(np.array(tau_d), is_open, tau_c, age)
    return (float(tau_c[0]), float(tau_c[1])), flags


def gate_at(tau: tuple[float, float]) -> Gate:
    """Make a gate that has let `tau` through."""
    gate = Gate(SETTINGS, PERIOD_S)
    for _ in range(20):
        reached, _ = limited(gate, tau)
    assert reached == tau
    return gate


def at_joint(joint: int, value: float, other: float = 0.0) -> tuple[float, float]:
    return (value, other) if joint == 0 else (other, value)


def around(bound: float) -> list[float]:
    """Values about a positive bound, from 1e-12 to 1e3 off it, the neighbouring floats and the bound itself."""
    return [bound, math.nextafter(bound, -math.inf), math.nextafter(bound, math.inf), *(bound + d for d in OFFSETS)]


@pytest.mark.parametrize(("joint", "sign"), JOINTS_AND_SIGNS)
def test_torque_is_clipped_exactly_at_its_limit(joint: int, sign: float) -> None:
    for wanted in (sign * value for value in around(LIMIT_NM[joint])):
        reached, flags = limited(Gate(UNRATED, PERIOD_S), at_joint(joint, wanted))
        is_inside = -LIMIT_NM[joint] <= wanted <= LIMIT_NM[joint]
        expected = (wanted, GateFlag.NONE) if is_inside else (math.copysign(LIMIT_NM[joint], wanted), GateFlag.TORQUE)
        assert (reached, flags) == (at_joint(joint, expected[0]), expected[1])


@pytest.mark.parametrize("start", [0.0, 4.0, -4.0, 0.3, 11.999])
@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_the_change_from_anywhere_is_clipped_exactly_at_its_limit(joint: int, start: float, direction: float) -> None:
    start = start * LIMIT_NM[joint] / LIMIT_NM[0]
    for wanted in (start + direction * value for value in around(STEP_NM[joint])):
        reached, flags = limited(gate_at(at_joint(joint, start)), at_joint(joint, wanted))
        clipped = max(-LIMIT_NM[joint], min(LIMIT_NM[joint], wanted))
        lowest, highest = start - STEP_NM[joint], start + STEP_NM[joint]
        expected_flags = GateFlag.NONE
        if clipped != wanted:
            expected_flags |= GateFlag.TORQUE
        if not lowest <= clipped <= highest:
            expected_flags |= GateFlag.RATE
        assert (reached, flags) == (at_joint(joint, max(lowest, min(highest, clipped))), expected_flags)


ANY_TORQUE = st.one_of(
    st.floats(-30.0, 30.0),
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([s * b for b in (*LIMIT_NM, *STEP_NM) for s in (1.0, -1.0)]),
)
SEQUENCE = st.lists(st.tuples(ANY_TORQUE, ANY_TORQUE, st.sampled_from([True, True, True, False])), max_size=40)


@given(sequence=SEQUENCE)
def test_whatever_is_asked_limit_and_step_hold_and_a_closed_gate_gives_zero(
    sequence: list[tuple[float, float, bool]],
) -> None:
    gate = Gate(SETTINGS, PERIOD_S)
    last = (0.0, 0.0)
    for tau1, tau2, is_open in sequence:
        reached, flags = limited(gate, (tau1, tau2), is_open)
        is_finite = math.isfinite(tau1) and math.isfinite(tau2)
        if not (is_open and is_finite):
            assert reached == (0.0, 0.0)
            assert flags is (GateFlag.CLOSED if is_finite else GateFlag.NOT_A_NUMBER)
        else:
            for now, before, bound, step in zip(reached, last, LIMIT_NM, STEP_NM, strict=True):
                assert -bound <= now <= bound
                assert before - step <= now <= before + step
        last = reached


@given(tau=st.tuples(st.floats(-2.0, 2.0), st.floats(-1.0, 1.0)))
def test_what_is_inside_passes_bit_for_bit(tau: tuple[float, float]) -> None:
    assert limited(Gate(SETTINGS, PERIOD_S), tau) == (tau, GateFlag.NONE)


@pytest.mark.parametrize("is_open", [True, False])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("joint", [0, 1])
def test_a_torque_that_is_not_finite_zeroes_both_joints(joint: int, bad: float, is_open: bool) -> None:
    gate = gate_at((1.0, 0.5))
    wanted = at_joint(joint, bad, other=0.4)
    assert limited(gate, wanted, is_open) == ((0.0, 0.0), GateFlag.NOT_A_NUMBER)


def test_in_every_sequence_of_open_and_closed_torque_counts_the_cycles_since_the_gate_opened() -> None:
    for pattern in itertools.product((True, False), repeat=5):
        gate = Gate(SETTINGS, PERIOD_S)
        cycles = 0
        for is_open in pattern:
            cycles = cycles + 1 if is_open else 0
            reached, _ = limited(gate, (12.0, -6.0), is_open)
            assert reached == (cycles * STEP_NM[0], -cycles * STEP_NM[1])


@pytest.mark.parametrize("period_s", [0.0005, 0.001, 0.004])
def test_the_step_is_the_rate_times_the_period(period_s: float) -> None:
    reached, _ = limited(Gate(SETTINGS, period_s), (12.0, -6.0))
    assert reached == (RATE_NM_S[0] * period_s, -RATE_NM_S[1] * period_s)


def test_the_flags_have_the_numbers_that_logs_hold() -> None:
    numbers = {flag.name: int(flag) for flag in GateFlag}
    assert numbers == {"TORQUE": 1, "RATE": 2, "NOT_A_NUMBER": 4, "CLOSED": 8, "HELD": 16}
    assert GateFlag.NONE.value == 0


LAST_NM = 4.0
WANTED_NM = (
    -9.0,
    -4.0,
    -0.5,
    0.0,
    0.5,
    3.1,
    math.nextafter(3.2, 0.0),
    3.2,
    3.3,
    3.9,
    4.0,
    math.nextafter(4.0, 5.0),
    9.0,
)


@pytest.mark.parametrize(
    ("age", "most"), [(0, None), (1, None), (2, 4.0), (4, 4.0), (5, 4.0), (6, 3.2), (7, 3.2), (40, 3.2)]
)
def test_by_old_feedback_torque_falls_and_does_not_grow(age: int, most: float | None) -> None:
    for (joint, sign), wanted in itertools.product(JOINTS_AND_SIGNS, WANTED_NM):
        gate = Gate(UNRATED, PERIOD_S)
        limited(gate, at_joint(joint, sign * LAST_NM))
        allowed = min(max(wanted, -LIMIT_NM[joint]), LIMIT_NM[joint])
        expected = GateFlag.NONE if allowed == wanted else GateFlag.TORQUE
        if most is not None:
            allowed = 0.0 if wanted < 0.0 else min(wanted, most)
            expected = GateFlag.NONE if allowed == wanted else GateFlag.HELD
        reached, flags = limited(gate, at_joint(joint, sign * wanted), age=age)
        assert (reached, flags) == (at_joint(joint, sign * allowed), expected)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_torque_that_old_feedback_keeps_fades_to_nothing_within_twenty_cycles(sign: float) -> None:
    gate = Gate(UNRATED, PERIOD_S)
    limited(gate, (sign * LIMIT_NM[0], 0.0))
    kept = [limited(gate, (sign * LIMIT_NM[0], 0.0), age=age)[0][0] * sign for age in range(2, 26)]
    assert kept[:4] == [LIMIT_NM[0]] * 4
    assert kept[4:] == pytest.approx([LIMIT_NM[0] * 0.8**count for count in range(1, 21)])
    assert kept[-1] < 0.02 * LIMIT_NM[0]


def test_a_torque_held_by_old_feedback_grows_again_at_the_limited_rate() -> None:
    gate = gate_at((4.0, 0.0))
    limited(gate, (0.5, 0.0), age=2)
    low, _ = limited(gate, (0.5, 0.0), age=2)
    held, flags = limited(gate, (9.0, 0.0), age=2)
    assert (held, flags) == (low, GateFlag.HELD)
    assert limited(gate, (9.0, 0.0)) == ((low[0] + STEP_NM[0], 0.0), GateFlag.RATE)


def test_both_joints_say_what_was_changed() -> None:
    gate = Gate(UNRATED, PERIOD_S)
    limited(gate, (4.0, 4.0))
    assert limited(gate, (9.0, 3.0), age=2) == ((4.0, 3.0), GateFlag.HELD)
    assert limited(gate, (3.0, 9.0), age=2) == ((3.0, 3.0), GateFlag.HELD)
