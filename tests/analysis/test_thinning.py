"""Rows that stand for all of a series."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from adacd_hil.score.emulator_truth import extreme_rows


def values_of(seed, count):
    """Give values of which many are equal, not numbers or infinite."""
    random = np.random.default_rng(seed)
    return random.choice([-2.0, -1.0, 0.0, 0.5, 3.0, np.nan, np.inf, -np.inf], count)


VALUES = st.builds(values_of, st.integers(0, 2**32), st.integers(1, 80))


@settings(max_examples=60, deadline=None)
@given(VALUES, st.integers(1, 20))
def test_no_extreme_of_a_bucket_is_lost(values, width):
    starts = np.arange(0, values.size, width)
    rows = extreme_rows([values], starts)
    for start in starts.tolist():
        whole = values[start : start + width]
        kept = values[rows[(rows >= start) & (rows < start + width)]]
        assert kept.size <= 2
        if not np.isnan(whole).all():
            assert (np.nanmin(kept), np.nanmax(kept)) == (np.nanmin(whole), np.nanmax(whole))


def test_of_equal_extremes_the_first_is_kept():
    assert extreme_rows([np.array([1.0, 0.0, 1.0, 0.0])], np.array([0])).tolist() == [0, 1]


def test_several_series_keep_the_rows_of_each_once():
    series = [np.array([0.0, 5.0, 1.0, 2.0]), np.array([9.0, 8.0, 0.0, 8.5])]
    assert extreme_rows(series, np.array([0])).tolist() == [0, 1, 2]


def test_what_is_nowhere_a_number_is_nowhere_kept():
    assert extreme_rows([np.full(5, np.nan)], np.array([0, 2])).size == 0
