"""What a certificate says that detection can see, and what is said when it sees less."""

import re

import numpy as np
import pytest
from excited_arm import PERIOD_S, SETTINGS, TouchedLoop, kernel_of

from adacd_hil.records import Request, SchemeState
from adacd_hil.scheme.detect import sensitivity, sight
from adacd_hil.scheme.model import filter_bank

FILTERS = SETTINGS.filter_count


def pushes(y, h):
    """The definition, by numpy, of samples (k, channels, 2)."""
    shown = np.array([filter_bank.step_response(0.1, *channel) for channel in filter_bank.channels_of(SETTINGS)])[
        :, None
    ]
    found = (h + np.abs(y)) / shown
    agreed = (sensitivity.AGREES * h + np.abs(y)) / shown
    bare = np.maximum(found[:, FILTERS:], agreed[:, 1:FILTERS])
    return np.concatenate((found[:, :FILTERS], bare), axis=1).min(axis=1)


@pytest.fixture(scope="module")
def tested():
    """A loop that has just been certified, and y, h (k, channels, 2) of the cycles of its test."""
    loop = TouchedLoop(SETTINGS)
    loop.run_until(SchemeState.CERTIFY)
    y, h = [], []
    while loop.pipeline.state is SchemeState.CERTIFY:
        loop.step()
        y.append(loop.m.filters.y.copy())
        h.append(loop.m.sensitivity.h.copy())
    return loop, np.array(y), np.array(h)


def test_a_certificate_states_the_smallest_push_and_the_thresholds_of_its_test(tested):
    loop, y, h = tested
    (text,) = loop.said("certificate")
    said = [tuple(map(float, pair)) for pair in re.findall(r"([\d.]+) / ([\d.]+)", text)]
    in_force = h.min(axis=1)
    assert len(y) == round(SETTINGS.certified.test_s[0] / SETTINGS.bus.period_s)
    assert said[0] == pytest.approx(pushes(y, h).max(axis=0), abs=5.1e-4)
    assert said[1] == pytest.approx(np.median(in_force, axis=0), rel=sight.WIDTH + 0.01, abs=1e-3)
    assert said[2] == pytest.approx(np.percentile(in_force, 99.0, axis=0), rel=sight.WIDTH + 0.01, abs=1e-3)
    assert said[3] == pytest.approx(in_force.max(axis=0), abs=5.1e-4)
    assert said[1] < said[2] <= said[3]


@pytest.mark.parametrize("value_Nm", [1e-5, 0.0123, 0.4, 100.0])
def test_a_threshold_that_is_always_the_same_is_said_as_it_is(value_Nm):
    k, m = kernel_of()
    m.sensitivity.wide_threshold, m.sensitivity.h = value_Nm, value_Nm
    for _ in range(10):
        sight.follow_test(k, m)
    pair = f"{value_Nm:.3f} / {value_Nm:.3f}"
    assert f"thresholds {pair} Nm in the middle, {pair} in 99 %, {pair} at worst" in sight.describe_sight(m)


def test_the_next_test_begins_with_nothing_seen(tested):
    m = tested[0].pipeline.numbers.memory.copy()[0]
    sight.follow_sight(kernel_of()[0], m)
    for name in ("seen", "seen_push_Nm", "sum_cycles"):
        assert m.sight[name].any()
    sight.begin_sight(m)
    for name in ("seen", "seen_push_Nm", "seen_worst_Nm", "sum_push_Nm", "sum_cycles"):
        assert not m.sight[name].any()


def test_a_monitor_that_sees_less_than_was_certified_says_so_once_each_time_and_with_each_certificate():
    loop = TouchedLoop(SETTINGS)
    loop.run_until(SchemeState.MONITOR)
    loop.run(3000)
    assert loop.said("sight") == []

    def see(roughness, cycles):
        """Let the torque sensor of joint 2 have noise of so many times the variance."""
        loop.m.sensitivity.roughness[1] = roughness
        loop.run(cycles)

    see(400.0, 2500)
    (text,) = loop.said("sight")
    found = re.match(r"joint 2 .* pushes from ([\d.]+) Nm on within 100 ms, in the test from ([\d.]+) Nm", text)
    assert float(found[1]) > sight.LESS * float(found[2])
    assert float(found[2]) == pytest.approx(loop.m.sight.seen_push_Nm[1], abs=0.005)
    see(1.0, 3000)
    see(400.0, 2500)
    assert len(loop.said("sight")) == 2
    loop.request = Request.PAYLOAD
    loop.run_until(SchemeState.PAYLOAD)
    see(1.0, 0)
    loop.request = Request.PAYLOAD_CHANGED
    loop.run_until(SchemeState.MONITOR)
    assert len(loop.said("sight")) == 2
    see(400.0, 2500)
    assert len(loop.said("sight")) == 3


def test_a_joint_that_sees_less_for_some_seconds_takes_the_certificate_back():
    loop = TouchedLoop(SETTINGS)
    loop.run_until(SchemeState.MONITOR)
    m = loop.m
    loop.run(1000)
    m.sensitivity.roughness[1] = 400.0
    outputs = loop.run_until(SchemeState.STOPPED, 6000)
    blind = [output.state for output in outputs].index(SchemeState.REACT)
    assert sight.BLIND_S - 1.0 <= blind * PERIOD_S <= sight.BLIND_S + 1.0
    (revoked,) = loop.said("revoked")
    assert revoked.startswith("joint 2 sees less than was certified")
    assert len(loop.pipeline.certificates) == 0
    m.sensitivity.roughness[1] = 1.0
    loop.request = Request.RELEARN
    loop.run_until(SchemeState.MONITOR)


def test_a_joint_that_rests_is_not_asked_what_it_sees():
    """There friction holds what it can."""
    k, m = kernel_of()
    m.sensitivity.h, m.sight.seen_push_Nm = 1.0, 0.1
    m.sensitivity.still[:, 0] = 1.0
    for _ in range(int(k.sight.mean_cycles) - 1):  # too little motion to tell
        assert not sight.follow_sight(k, m)
    assert sight.describe_dim(m) == []
    assert not sight.follow_sight(k, m)
    (line,) = sight.describe_dim(m)
    assert line.startswith("joint 2 sees less")
    for _ in range(2 * int(k.sight.mean_cycles) - 1):
        assert not sight.follow_sight(k, m)
    assert sight.follow_sight(k, m)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"strain": 3.0}, "right after going on"),
        ({"velocity_roughness": 9.0}, "3.0 times the noise"),
        ({"lost_Nm2": 0.1}, "samples are missing"),
        ({"tail_Nm": 2.0}, "both signs"),
        ({"unit": 4.0}, "2.0 times"),
    ],
)
def test_what_has_raised_the_thresholds_is_named(change, cause):
    _, m = kernel_of()
    m.sensitivity.h_model[:] = 1.0
    m.sight.dim_s[0] = 1.0
    for name, value in change.items():
        (record,) = (record for record in (m.sensitivity, m.lost, m.tail) if name in record.dtype.names)
        record[name][:] = value
    (line,) = sight.describe_dim(m)
    assert cause in line
