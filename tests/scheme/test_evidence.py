"""One row of what is known of an arm, weighed against a fit."""

import numpy as np
import pytest
from excited_arm import NAMES, kernel_of

from adacd_hil.records import FRICTION_AT, FRICTION_AT_RAD_S, FRICTION_SPEEDS_RAD_S, JOINTS
from adacd_hil.scheme.identify import evidence
from adacd_hil.scheme.identify.evidence import FRICTIONS, KEPT, LAST, OFFSETS, QUANTITIES, REFUSED, VISCOUS

ANCHOR, INERTIA, OFFSET, DRAG = 0, FRICTIONS, OFFSETS, 0


class Table:
    """A table in which one source says of one quantity that it is 1, to a variance, and the fit says otherwise."""

    def __init__(self, s, q, variance=0.0, floor=0.0, slack=0.0, fitted_variance=0.0):
        self.k, self.m = kernel_of()
        self.s, self.q, self.fitted_variance = s, q, fitted_variance
        evidence.set_row(self.m, s, q, 1.0, variance, floor, slack)

    def excess(self, fitted):
        evidence.put_fitted(self.m, self.q, fitted, self.fitted_variance)
        return evidence.weigh(self.k, self.m, self.s, self.q)


@pytest.mark.parametrize(("s", "sigmas"), [(ANCHOR, 4.0), (LAST, 4.0), (REFUSED, 3.5), (KEPT, 3.5)])
def test_a_difference_counts_from_so_many_deviations_of_source_and_fit_on(s, sigmas):
    table = Table(s, DRAG, variance=0.03**2, fitted_variance=0.04**2)
    assert table.excess(1.0 + sigmas * 0.05) == pytest.approx(1.0)
    assert table.m.evidence.limit[s, DRAG] == pytest.approx(sigmas * 0.05)
    assert table.m.evidence.difference[s, DRAG] == pytest.approx(sigmas * 0.05)


def test_a_floor_is_the_least_limit_and_slack_is_added_to_it():
    assert Table(KEPT, DRAG, variance=0.01**2, floor=0.2).excess(1.2) == pytest.approx(1.0)
    assert Table(KEPT, DRAG, variance=0.1**2, floor=0.2).excess(1.35) == pytest.approx(1.0)
    assert Table(KEPT, DRAG, variance=0.1**2, floor=0.2, slack=0.15).excess(1.5) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("s", "q", "counts"),
    [
        (ANCHOR, OFFSET, True), (KEPT, DRAG, True), (KEPT, OFFSET, True), (KEPT, INERTIA, False),
        (REFUSED, INERTIA, True), (LAST, DRAG, False), (LAST, VISCOUS, False),
    ],
)  # fmt: skip
def test_less_counts_of_anchors_of_friction_before_a_touch_and_not_of_what_less_is_the_arms(s, q, counts):
    table = Table(s, q, floor=0.1)
    assert table.excess(1.2) == pytest.approx(2.0)
    assert table.excess(0.8) == pytest.approx(-2.0 if counts else 0.0)


def test_a_source_that_says_nothing_contradicts_nothing_but_what_is_not_a_number():
    table = Table(KEPT, DRAG, variance=np.inf)
    assert table.excess(99.0) == 0.0
    assert not abs(table.excess(np.nan)) <= 1.0
    evidence.set_row(table.m, KEPT, DRAG, 1.0, 0.0, 0.1, 0.0)
    assert table.excess(99.0) > 1.0
    evidence.empty_source(table.m, KEPT)
    assert evidence.excess(table.m, KEPT, DRAG) == 0.0
    assert table.excess(99.0) == 0.0


def test_of_several_sources_the_one_that_contradicts_most_is_named():
    table = Table(KEPT, DRAG, floor=0.2)
    for s, floor in ((KEPT + 1, 0.1), (KEPT + 2, 0.4)):
        evidence.set_row(table.m, s, DRAG, 1.0, 0.0, floor, 0.0)
    evidence.put_fitted(table.m, DRAG, 1.3, 0.0)
    for s in range(KEPT, KEPT + 3):
        evidence.weigh(table.k, table.m, s, DRAG)
    assert evidence.largest_excess(table.m, KEPT, KEPT + 3, DRAG) == KEPT + 1


def test_each_quantity_is_a_column_of_the_parameters():
    k, _ = kernel_of()
    theta = np.arange(1.0, len(NAMES) + 1.0)
    of = dict(zip(NAMES, theta, strict=True))
    friction = [of[f"F_c{i}"] + v * of[f"F_v{i}"] for i in (1, 2) for v in FRICTION_SPEEDS_RAD_S]
    others = ("a1", "a2", "a3", "offset1", "offset2", "F_v1", "F_v2")
    np.testing.assert_allclose(k.evidence.columns @ theta, [*friction, *(of[name] for name in others)])
    assert k.evidence.columns.shape[0] == QUANTITIES


def test_the_prior_s_part_of_a_variance_is_not_scaled():
    assert evidence.split(0.25, 0.25, 0.1) == pytest.approx(0.25)
    assert evidence.split(0.01, 1e9, 0.1) == pytest.approx(0.001)
    assert 0.001 < evidence.split(0.01, 0.02, 0.1) < 0.01


def test_the_friction_that_people_are_shown_is_that_at_the_named_speed():
    assert FRICTION_AT_RAD_S in FRICTION_SPEEDS_RAD_S
    assert (FRICTION_SPEEDS_RAD_S * JOINTS)[FRICTION_AT] == (FRICTION_AT_RAD_S,) * JOINTS
