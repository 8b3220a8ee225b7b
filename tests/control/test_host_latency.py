"""How long a modelled host takes."""

import numpy as np
import pytest

from adacd_hil.control.pacing import HostLatency
from adacd_hil.settings.arm_settings import LockstepSettings
from adacd_hil.settings.schema import ConfigError


def draws_us(count: int, **settings: object) -> np.ndarray:
    latency = HostLatency(LockstepSettings(**settings), 1e-3)
    return np.array([latency.draw_ns() for _ in range(count)]) * 1e-3


def test_a_constant_latency_is_always_the_same() -> None:
    assert set(draws_us(2000, latency_us=75.0)) == {75.0}


def test_a_uniform_latency_stays_within_its_ends_and_fills_them() -> None:
    drawn_us = draws_us(20_000, latency="uniform", latency_us=50.0, latency_high_us=250.0)
    assert (drawn_us.min(), drawn_us.max()) == pytest.approx((50.0, 250.0), abs=0.2)


def test_one_in_a_thousand_lognormal_latencies_is_beyond_the_high_one() -> None:
    drawn_us = draws_us(200_000, latency="lognormal", latency_us=60.0, latency_high_us=200.0)
    assert np.median(drawn_us) == pytest.approx(60.0, rel=0.01)
    assert np.count_nonzero(drawn_us > 200.0) == pytest.approx(200, abs=45)  # 3 sigma of a binomial


def test_stalls_come_as_often_as_they_should() -> None:
    drawn_us = draws_us(100_000, latency_us=60.0, stall_us=5000.0, stall_every_s=0.5)
    assert np.count_nonzero(drawn_us == 5060.0) == pytest.approx(200, abs=45)


def test_a_seed_draws_the_same_latencies_and_another_one_others() -> None:
    first, again, other = (draws_us(3000, latency="lognormal", seed=seed) for seed in (5, 5, 6))
    assert np.array_equal(first, again)
    assert not np.any(first == other)


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        (
            {"latency": "uniform", "latency_us": 300.0},
            "latency_high_us` = 200 us is below `lockstep.latency_us` = 300 us",
        ),
        ({"latency": "lognormal", "latency_us": 0.0}, "can't be the median of a lognormal"),
    ],
)
def test_a_distribution_that_cant_be_is_refused(settings: dict[str, object], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        LockstepSettings(**settings)
