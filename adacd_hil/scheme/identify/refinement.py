"""Refinement of a certified model while it detects: a candidate, its own test, and its promotion.

The belief goes on learning where nothing touches the arm. Every so often its mean is frozen as a candidate and runs
beside the model in use on motion that neither was fitted to. It takes over if it explains that motion better and would
have raised no alarm. So friction that warms up, and a model that was armed early, are followed, but a touch is not:
a contact pauses the test, and what is left below the thresholds can't move a candidate by more than that. An offset
that has left its anchor (`anchor`), by somebody who leans lightly or a sensor that moves, takes the certificate back.
"""

from typing import Any

from adacd_hil.compiled import compiled
from adacd_hil.scheme.detect import sensitivity
from adacd_hil.scheme.identify import anchor
from adacd_hil.scheme.model import bank
from adacd_hil.scheme.model.regressor import is_positive_definite


@compiled
def restart(m: Any) -> None:
    """Begin the next test with the belief as it is now."""
    m["candidate_cycles"] = 0.0
    m["candidate_square"] = 0.0
    m["frozen_square"] = 0.0
    m["candidate_worst"] = 0.0
    m["candidate"][:] = m["belief"]
    m["P_candidate"][:] = m["P_belief"]


@compiled
def test_candidate(k: Any, m: Any) -> bool:
    """Take one sample into the test; tell whether a candidate that passes it is excluded by an anchor alone."""
    m["candidate_cycles"] += 1.0
    for c in range(m["W_f"].shape[0]):
        for i in range(m["W_f"].shape[1]):
            residual = -m["tau_f"][c, i]
            for j in range(m["candidate"].shape[0]):
                residual += m["W_f"][c, i, j] * m["candidate"][j]
            if c == bank.SLOW and m["still"][c, i] < sensitivity.MOVING:
                m["candidate_square"] += residual * residual
                m["frozen_square"] += m["r"][c, i] ** 2
            bare = max(m["r"].shape[0] + c - 1, 0) if c > 0 else 0
            m["candidate_worst"] = max(m["candidate_worst"], abs(residual) / m["h"][bare, i])
    if m["candidate_cycles"] < k["refine_cycles"]:
        return False
    is_better = m["candidate_square"] < m["frozen_square"] and m["candidate_worst"] < 1.0
    is_fit = is_better and is_positive_definite(m["candidate"])
    is_anchored = is_fit and anchor.is_within(k, m, m["candidate"], m["P_candidate"])
    if is_anchored:
        m["theta"][:] = m["candidate"]
        m["P"][:] = m["P_candidate"]
        m["certified"][:] = m["theta"]
        m["P_certified"][:] = m["P"]
        m["promotions"] += 1.0
    restart(m)
    return bool(is_fit and not is_anchored)
