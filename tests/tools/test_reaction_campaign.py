"""tools/campaigns/reaction_campaign.py: what it makes of forces, and what it calls worse."""

from typing import Any

import numpy as np
import pytest
import reaction_campaign
from reaction_campaign import Harm

from adacd_hil.records import Reaction, SchemeState


class Sample:
    """A cycle with a force."""

    def __init__(self, force_N: float, state: SchemeState = SchemeState.REACT) -> None:
        self.force_N = force_N
        self.output: Any = self
        self.state = state

    def true(self, name: str) -> np.ndarray:
        assert name == "contact_force"
        return np.array([self.force_N])


def test_peak_impulse_and_contacts_are_read_off_the_force() -> None:
    force = [0.0] * 5 + [10.0] * 10 + [0.0] * 10 + [20.0] * 5 + [0.0] * 40 + [5.0] * 10
    harm = reaction_campaign.harm_of([Sample(value) for value in force], 1e-3)  # type: ignore[misc]
    assert harm == Harm(20.0, pytest.approx(0.25), 2, False)


def harms(withdrawal: Harm) -> reaction_campaign.Harms:
    stop = Harm(100.0, 1.0, 1, False)
    return {("chest", True): {reaction: [stop] for reaction in Reaction} | {Reaction.WITHDRAW: [withdrawal]}}


@pytest.mark.parametrize(("peak_N", "impulse_N_s", "count"), [(101.9, 1.019, 0), (103.0, 0.5, 1), (50.0, 1.03, 1)])
def test_a_withdrawal_is_worse_by_its_peak_or_its_impulse(peak_N: float, impulse_N_s: float, count: int) -> None:
    assert len(reaction_campaign.worse(harms(Harm(peak_N, impulse_N_s, 1, False)))) == count
