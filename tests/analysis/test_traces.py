"""The traces of a page: what is written down comes back, and what each panel shows."""

import base64
import json
import re
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hand_made_run import evaluated, make_certified_run, make_run, react, touch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from adacd_hil.lab.report.page import render
from adacd_hil.lab.report.timeline import traces_of
from adacd_hil.lab.report.traces import pack, panels_of, step_of
from adacd_hil.log.reader import LoggedEvent
from adacd_hil.records import Event

VALUES = st.floats(-1e3, 1e3) | st.just(np.nan) | st.just(np.inf)


def unpack(packed, count):
    """Read a series as the page's script does."""
    text, form = packed
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(form["planes"], count)
    zigzag = sum(plane.astype(np.uint64) << np.uint64(8 * place) for place, plane in enumerate(planes))
    codes = (zigzag >> np.uint64(1)).astype(np.int64) ^ -(zigzag & np.uint64(1)).astype(np.int64)
    for _ in range(form["order"]):
        codes = np.cumsum(codes).astype(np.int32).astype(np.int64)  # 32 bits, they wrap
    return np.where(codes == 0, np.nan, form["low"] + (codes - 1) * form["step"])


@settings(max_examples=40)
@given(arrays(np.float64, st.integers(1, 60), elements=VALUES), st.floats(1e-5, 1.0))
def test_a_series_comes_back_within_half_a_step(values, step):
    packed = pack(values, step)
    assert packed[1]["step"] == step
    expected = np.where(np.isfinite(values), values, np.nan)
    np.testing.assert_allclose(unpack(packed, values.size), expected, rtol=0, atol=0.501 * packed[1]["step"])


def test_a_range_of_more_than_2_to_the_30_steps_is_written_more_coarsely():
    assert pack(np.array([0.0, 2.0**31]), 1.0)[1]["step"] == 2.0


def test_a_series_whose_differences_wrap_comes_back():
    values = np.array([0.0, 2.0**30, 0.0, 2.0**30, 0.0])
    assert unpack(pack(values, 1.0), 5).tolist() == values.tolist()


def test_a_step_is_half_the_noise_and_no_finer_than_asked_for():
    noise = np.random.default_rng(7).normal(0.0, 0.02, 20_000)
    assert step_of(noise + np.sin(np.arange(20_000) / 300.0), 1e-4) == pytest.approx(0.01, rel=0.03)  # it moves, too
    assert step_of(np.zeros(100), 1e-3) == 1e-3
    gaps = np.where(np.arange(1000) % 3 == 0, np.nan, 1.0)
    assert step_of(gaps, 1e-3) == 1e-3


def test_a_run_has_a_panel_for_what_it_measured():
    measured, parameters = ["residual1", "residual2", "q", "dq", "tau_J"], ["theta-a1", "theta-F_v1", "theta-F_c1"]
    for run, channels in ((make_run(), []), (make_certified_run(), ["channels1", "channels2", "share"])):
        assert [panel.name for panel in panels_of(run)] == [*measured, *channels, *parameters]


def test_every_channel_of_the_bank_is_a_trace_of_its_joint():
    run = make_certified_run()
    run.certified.tau_ext[:] = np.arange(10.0).reshape(5, 2)
    assert [trace.values[0] for trace in panel_of(run, "channels2").traces] == [9.0, 7.0, 5.0, 3.0, 1.0]


def test_the_share_of_the_threshold_is_that_of_the_channel_nearest_to_an_alarm():
    run = make_certified_run()
    run.certified.tau_ext[50, 3, 1] = -0.08
    run.certified.tau_ext[50, 4, 1] = 0.09
    run.certified.threshold[50, 4, 1] = 0.3
    assert panel_of(run, "share").traces[1].values[50] == pytest.approx(0.8)


def test_a_threshold_that_is_off_or_far_above_is_not_drawn():
    run = make_run()
    run.tau_ext_hat[2000, 0] = 5.0
    run.threshold[3000] = 5.1
    values = curves_of(run, "residual1")["threshold"]
    assert [np.isnan(values[row]) for row in (0, 2999, 3000, 3001)] == [True, False, True, False]
    assert panel_of(run, "residual1").near == pytest.approx(0.45)  # three thresholds


def panel_of(run, name):
    return next(panel for panel in panels_of(run) if panel.name == name)


def curves_of(run, name):
    return {trace.label: trace.values for trace in panel_of(run, name).traces}


def test_the_true_torque_of_a_contact_is_drawn_where_the_truth_has_it():
    run = make_run()
    touch(run, 2000, 250, (5.0, -1.0))
    true = curves_of(run, "residual2")["true"]
    assert (true[1999], true[2000], true[2249], true[2250]) == (0.0, -1.0, -1.0, 0.0)
    assert "true" not in curves_of(make_run(has_truth=False), "residual2")


def test_a_true_parameter_is_drawn_as_it_was_in_each_cycle():
    run = make_run()
    run.truth.theta[3000:, 0] = 0.5
    true = curves_of(run, "theta-a1")["true a1"]
    assert (true[2999], true[3000], true[-1]) == (0.2, 0.5, 0.5)


def plan_of(html):
    return json.loads(re.search(r'id="trace-plan">(.*?)</script>', html)[1])


@pytest.fixture(scope="module")
def shown():
    """Give a run with a contact and a fault, and its section of traces."""
    run = make_run()
    touch(run, 2000, 250, (5.0, 0.0))
    run = react(run, 2005)
    run.state[9300:] = 8
    run = replace(run, events=(LoggedEvent(int(run.t_ns[100]), Event("warning", "bus", "slow")),))
    traces = traces_of(run, evaluated(run))
    return run, render("trace_data.html.j2", traces=traces)


def test_every_series_of_the_plan_is_in_the_page_at_its_full_rate(shown):
    run, html = shown
    scheme, timing = plan_of(html)["tracks"]
    curves = [curve for track in (scheme, timing) for panel in track["panels"] for curve in panel["curves"]]
    series = [scheme["time"], timing["time"], *curves]
    blocks = dict(re.findall(r'<script type="text/plain" id="([^"]*)">([^<]*)</script>', html))
    sizes = {len(zlib.decompress(base64.b64decode(blocks.pop(one["id"])))) / one["planes"] for one in series}
    assert (sizes, blocks) == ({len(run.cycle)}, {})


def test_the_plan_shades_what_happened(shown):
    plan = plan_of(shown[1])
    assert [band for band in plan["bands"] if band[2] in ("react", "fault")] == [
        [1.955, 2.055, "react"],
        [9.25, 9.299, "fault"],
    ]
    assert (plan["contacts"], plan["faults"]) == ([[1.95, 2.2, 1]], [9.25])


def test_a_run_of_one_cycle_has_no_traces():
    run = make_run((3, 1))
    assert traces_of(run, evaluated(run)) is None
