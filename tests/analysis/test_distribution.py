"""Percentiles of values that come piece by piece."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from adacd_hil.score.distribution import EXACT, LOW_PERCENTILE_NAMES, PERCENTILE_NAMES, PERCENTILES, Distribution

FINEST = 2.0**-12


def distribution_of(values, pieces=7):
    found = Distribution()
    for part in np.array_split(values, pieces):
        found.add_values(part)
    return found


def percentiles(values):
    """Give numpy's percentiles by name."""
    return dict(zip(PERCENTILE_NAMES, np.percentile(values, PERCENTILES, method="higher"), strict=True))


def low_percentiles(values):
    return dict(zip(LOW_PERCENTILE_NAMES, -np.percentile(-values, PERCENTILES, method="higher"), strict=True))


def values_of(seed, count):
    """Give values of all sizes and both signs, whole ones too."""
    random = np.random.default_rng(seed)
    sizes = 10.0 ** random.uniform(-6.0, 9.0, count) * random.choice([-1.0, 1.0], count)
    return np.where(random.random(count) < 0.5, sizes, random.integers(-4096, 4097, count))


VALUES = st.builds(values_of, st.integers(0, 2**32), st.integers(1, 300))


@settings(max_examples=60, deadline=None)
@given(VALUES)
def test_few_values_have_the_percentiles_that_they_would_have_together(values):
    found = distribution_of(values)
    assert found.percentiles() == percentiles(values)
    assert found.low_percentiles() == low_percentiles(values)
    assert found.median() == np.median(values)


@settings(max_examples=5, deadline=None)
@given(VALUES)
def test_many_values_have_theirs_within_a_bin_toward_zero_and_the_extremes_exactly(few):
    values = np.resize(few, EXACT + 1)
    found = distribution_of(values)
    for ours, true in (
        (found.percentiles(), percentiles(values)),
        (found.low_percentiles(), low_percentiles(values)),
    ):
        for name, value in true.items():
            low, high = sorted((value, value * (1.0 - FINEST)))
            assert low <= ours[name] <= high
    assert (found.percentiles()["max"], found.low_percentiles()["min"]) == (values.max(), values.min())
    middle = np.sort(np.abs(values))
    assert abs(found.median() - np.median(values)) <= FINEST * float(middle[-1])


def test_whole_numbers_stay_whole():
    found = distribution_of(np.resize([7.0, 4095.0, -3.0], EXACT + 1))
    assert (found.median(), found.low_percentiles()["p1"], found.percentiles()["p99"]) == (7.0, -3.0, 4095.0)


def test_values_next_to_zero_count_as_zero_and_huge_ones_as_infinite():
    found = distribution_of(np.resize([-1e-12, 1e-12, 1e300, 1e301, np.inf], EXACT + 1))
    assert (found.low_percentiles()["p1"], found.median()) == (0.0, np.inf)


def test_what_is_not_a_number_is_left_out():
    found = distribution_of(np.array([1.0, np.nan, 3.0]))
    assert (found.count, found.median()) == (2, 2.0)


def test_no_value_has_no_percentile():
    found = Distribution()
    found.add_values(np.empty(0))
    assert (found.percentiles(), found.low_percentiles(), np.isnan(found.median())) == ({}, {}, True)
