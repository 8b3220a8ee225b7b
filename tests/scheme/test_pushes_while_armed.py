"""What the report says of the smallest push is tried on the kernel: pushes on a motion that nobody touched."""

import numpy as np
import pytest
from excited_arm import PERIOD_S, SETTINGS, Record, play, record
from planar_arm import THETA

from adacd_hil.analysis.smallest_push import WITHIN_S, PushGatherer
from adacd_hil.records import SchemeState
from adacd_hil.scheme.observation import Observation

SECONDS = 9.0


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["P", "M"])
def test_a_push_as_large_as_at_the_worst_moment_is_found_at_every_moment(profile):
    measured = record(THETA[profile], SECONDS)
    untouched = play(measured)
    armed = np.flatnonzero(untouched.state == SchemeState.MONITOR)
    pushes = PushGatherer(SETTINGS)
    pushes.add(untouched.y[armed], untouched.h[armed])
    random = np.random.default_rng(1)
    within = round(WITHIN_S / PERIOD_S)
    for joint, figures in enumerate(pushes.smallest_push().push_Nm):
        assert 0.02 < figures["p50"] < figures["p99"] < figures["max"] < 1.0
        for at in random.choice(armed[:-within], 15):
            tau_J = measured.tau_J.copy()
            tau_J[at:, joint] += random.choice([-1.0, 1.0]) * figures["max"]
            pushed = play(Record(measured.q, measured.dq, tau_J))
            found = np.flatnonzero(pushed.observation[at : at + within + 1].astype(int) & Observation.CONTACT)
            assert found.size
