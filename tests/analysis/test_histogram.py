"""Histograms and percentiles: values by hand."""

import numpy as np
import pytest

from adacd_hil.lab.score.histogram import bar_chart, doubling_bins, histogram_by_key, log_counts
from adacd_hil.plain_values import plain_values

INF = float("inf")


def test_a_logarithmic_histogram_counts_every_value_once_an_edge_in_the_upper_bin():
    values = np.array([-5.0, 0.0, 0.99, 1.0, 1.1, 10.0, 100.0, 999_999.0, 1e6, 3e7])
    below, *inside, above = log_counts(values).tolist()
    assert (below, sum(inside), above) == (3, 5, 2)
    assert np.flatnonzero(inside).tolist() == [0, 20, 40, 119]


def test_a_histogram_in_plain_values_leaves_out_empty_ends():
    plain = plain_values(histogram_by_key(log_counts(np.array([10.0, 12.0, 0.5]))))
    assert (plain["counts"], plain["below"], plain["above"]) == ([1, 1], 1, 0)
    assert plain["edges"] == pytest.approx([10.0, 11.220185, 12.589254])


def test_a_value_on_a_bound_belongs_to_the_upper_bin_and_trailing_empty_bins_are_left_out():
    assert doubling_bins(np.array([0, 9, 10, 19, 20, 1000]), 10.0, 4) == [(10.0, 2), (20.0, 2), (40.0, 1), (INF, 1)]
    assert doubling_bins(np.array([1, 15]), 10.0, 4) == [(10.0, 1), (20.0, 1)]


def test_a_bin_that_is_not_empty_always_has_a_bar():
    first, second, third = bar_chart(["a", "bb", "c"], [10_000, 1, 0])
    assert (first.count("#"), second.count("#"), third.count("#")) == (40, 1, 0)
    assert second.endswith("0.01 %")
