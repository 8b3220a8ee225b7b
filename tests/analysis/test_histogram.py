"""Histograms and percentiles: values by hand."""

import numpy as np

from adacd_hil.analysis.histogram import bar_chart, doubling_bins, percentiles

INF = float("inf")


def test_percentiles_are_values_that_occurred() -> None:
    assert percentiles(np.arange(1, 1001)) == {"p50": 501.0, "p99": 991.0, "p99.9": 1000.0, "max": 1000.0}


def test_no_values_have_no_percentiles() -> None:
    assert percentiles(np.array([], dtype=np.int64)) == {}


def test_a_value_on_a_bound_belongs_to_the_upper_bin() -> None:
    assert doubling_bins(np.array([0, 9, 10, 19, 20, 1000]), 10.0, 4) == [(10.0, 2), (20.0, 2), (40.0, 1), (INF, 1)]


def test_trailing_empty_bins_are_left_out() -> None:
    assert doubling_bins(np.array([1, 15]), 10.0, 4) == [(10.0, 1), (20.0, 1)]


def test_a_bin_that_is_not_empty_always_has_a_bar() -> None:
    first, second, third = bar_chart(["a", "bb", "c"], [10_000, 1, 0])
    assert (first.count("#"), second.count("#"), third.count("#")) == (40, 1, 0)
    assert second.endswith("0.01 %")
