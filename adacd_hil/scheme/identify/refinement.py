"""Refinement of a certified model while it detects: a candidate, its own test, and its promotion.

The belief goes on learning while the arm is free of contact. At intervals its mean is frozen as a candidate and runs
beside the model in use on motion that neither was fitted to. It replaces that model if it explains the motion better
and would have raised no alarm. So the model follows friction that warms up, and improves if it was armed early, but
does not follow a touch: a contact pauses the test, and a torque below the thresholds can't move a candidate by more
than itself. An offset that has left its anchor (`anchor`) takes the certificate back: a person leans lightly, or a
sensor moves.
"""

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.scheme.detect import sensitivity
from adacd_hil.scheme.identify import anchor, belief
from adacd_hil.scheme.memory import Constants, Memory
from adacd_hil.scheme.model import filter_bank
from adacd_hil.scheme.model.regressor import is_positive_definite


@compiled
def begin(m: Memory) -> None:
    """Freeze the present belief as the candidate, and begin its test: set its count, squares and worst share to 0."""
    own = m.candidate
    own.cycles = 0.0
    own.square = 0.0
    own.frozen_square = 0.0
    own.worst = 0.0
    own.theta[:] = m.models.belief
    own.P[:] = m.models.P_belief


@compiled
def test(k: Constants, m: Memory) -> bool:
    """Add one sample to the candidate's test; after `refine_cycles` samples certify the candidate if it is better.

    Better: smaller squared residuals of the slow filter in moving joints, no residual over a threshold, a positive
    definite mass matrix, and torque offsets within the anchors' bounds. It then becomes the model in use, too. After
    each test begin the next with the present belief. Return True only if the anchors alone exclude the candidate: the
    certificate is to be revoked.
    """
    own = m.candidate
    own.cycles += 1.0
    for c in range(m.filters.W_f.shape[0]):
        for i in range(m.filters.W_f.shape[1]):
            residual = linalg.misfit(m.filters.W_f[c, i], own.theta, m.filters.tau_f[c, i])
            if c == filter_bank.SLOW and m.sensitivity.still[c, i] < sensitivity.MOVING:
                own.square += residual * residual
                own.frozen_square += m.filters.r[c, i] ** 2
            bare = m.filters.r.shape[0] + c - 1 if c > 0 else 0
            own.worst = max(own.worst, abs(residual) / m.sensitivity.h[bare, i])
    if own.cycles < k.refine_cycles:
        return False
    is_better = own.square < own.frozen_square and own.worst < 1.0
    is_fit = is_better and is_positive_definite(own.theta)
    is_anchored = is_fit and anchor.is_within(k, m, own.theta, own.P)
    if is_anchored:
        belief.promote(m, own.theta, own.P)
    begin(m)
    return bool(is_fit and not is_anchored)
