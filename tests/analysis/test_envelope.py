"""Decimation for figures: what a reader would look for is still there."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from adacd_hil.lab.drawing import envelope

SERIES = arrays(np.float64, st.integers(1, 400), elements=st.floats(-10.0, 10.0))


@given(SERIES, st.integers(1, 50))
def test_the_envelope_keeps_both_extremes_of_every_part_in_the_order_of_time_and_both_ends(y, bins):
    width = -(-len(y) // bins)
    kept = envelope(y, bins)
    for start in range(0, len(y), width):
        part, seen = y[start : start + width], y[kept[(kept >= start) & (kept < start + width)]]
        assert (seen.min(), seen.max()) == (part.min(), part.max())
    assert np.all(np.diff(kept) > 0)
    assert kept[[0, -1]].tolist() == [0, len(y) - 1]


def test_a_short_series_is_kept_whole():
    assert envelope(np.zeros(100), 50).tolist() == list(range(100))
