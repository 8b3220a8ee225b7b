"""What the report says of the smallest push is tried on the kernel: pushes on a motion that nobody touched."""

import numpy as np
import pytest
from excited_arm import PERIOD_S, SETTINGS, Record, kernel_of, play, record
from planar_arm import THETA

from adacd_hil.records import SchemeState
from adacd_hil.scheme.detect.sight import WITHIN_S, smallest_push
from adacd_hil.scheme.supervisor import findings
from adacd_hil.score.smallest_push import PushGatherer

SECONDS = 9.0


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["P", "M"])
def test_a_push_as_large_as_at_the_worst_moment_is_found_where_it_is_hardest_and_a_smaller_one_not_always(profile):
    measured = record(THETA[profile], SECONDS)
    untouched = play(measured)
    armed = np.flatnonzero(untouched.state == SchemeState.MONITOR)
    pushes = PushGatherer(SETTINGS)
    pushes.add_residuals(untouched.y[armed], untouched.h[armed])
    within = round(WITHIN_S / PERIOD_S)
    shown, early = kernel_of()[0].sight.shown, armed[:-within]
    for joint, figures in enumerate(pushes.smallest_push().push_Nm):
        assert 0.02 < figures["p50"] < figures["p99"] < figures["max"] < 1.0
        own = np.array([smallest_push(untouched.y[k], untouched.h[k], shown, joint) for k in early])
        hard = armed[np.argsort(own)[:: -max(own.size // 2000, 1)][:8]]

        def is_found(at, torque_Nm, joint=joint):
            q, dq, tau_J = (each[: at + within + 1].copy() for each in (measured.q, measured.dq, measured.tau_J))
            tau_J[at:, joint] += torque_Nm
            seen = play(Record(q, dq, tau_J)).observation[at:]
            return bool((seen.astype(int) & findings.CONTACT).any())

        assert all(is_found(at, sign * figures["max"]) for at in hard for sign in (-1.0, 1.0))
        assert not all(is_found(at, sign * 0.4 * figures["max"]) for at in hard for sign in (-1.0, 1.0))
