"""Decimation for figures: what a reader would look for is still there."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from adacd_hil.lab.drawing import ENVELOPE_BINS, envelope


def series_of(seed, count):
    """Give values of which some are equal."""
    return np.random.default_rng(seed).normal(0.0, 3.0, count).round(1)


@given(st.builds(series_of, st.integers(0, 2**32), st.integers(1, 5 * ENVELOPE_BINS)))
def test_the_envelope_keeps_both_extremes_of_every_part_in_the_order_of_time_and_both_ends(y):
    width = -(-len(y) // ENVELOPE_BINS)
    kept = envelope(y)
    for start in range(0, len(y), width):
        part, seen = y[start : start + width], y[kept[(kept >= start) & (kept < start + width)]]
        assert (seen.min(), seen.max()) == (part.min(), part.max())
    assert np.all(np.diff(kept) > 0)
    assert kept[[0, -1]].tolist() == [0, len(y) - 1]


def test_a_short_series_is_kept_whole():
    count = 2 * ENVELOPE_BINS
    assert envelope(np.zeros(count)).tolist() == list(range(count))
