"""What the supervisor lets pass without a look is what it would have let pass with one."""

import numpy as np
from smooth_motion import settings_with

from adacd_hil.records import ArmBatch, FaultReason, Request, SchemeState
from adacd_hil.scheme.batch import arm_at
from adacd_hil.scheme.calm import ArmFinding, is_calm
from adacd_hil.scheme.observation import CONTACT_SHIFT, Observation
from adacd_hil.scheme.supervisor import Supervisor

SETTINGS = settings_with(
    safety={"commission_cycles": 12, "phase_timeout_s": 0.15},
    termination={"timeout_s": 1.0},
    reaction={"clear_s": 0.06, "patience_s": 0.3, "rebound_s": 0.02},
    bus={"max_age_cycles": 3},
)
COUNT = 6000
REST = Observation.AT_REST | Observation.UNLOADED
ONCE = (
    *(bit for bit in Observation if bit is not Observation.NONE),
    Observation.CONTACT | Observation.COLLISION,
    Observation.NONE,
)


def walk(seed):
    """Return the arm, what the kernel finds of it (n,) and requests (n,): long calm, and much that ends it."""
    random = np.random.default_rng(seed)
    chance = random.random

    def seldom(usual, values, share=0.002):
        return np.where(chance(COUNT) < share, random.choice(values, COUNT), usual)

    # stretches of motion, rest and contact, and what comes for a cycle
    observations = np.zeros(COUNT, dtype=np.int64)
    at = 0
    while at < COUNT:
        length = int(random.choice((3, 30, 90, 200)))
        kinds = (REST, REST, Observation.UNLOADED, Observation.CONTACT, Observation.AT_REST | Observation.CONTACT)
        observations[at : at + length] = int(random.choice(kinds))
        at += length
    observations = np.where(chance(COUNT) < 0.02, observations | random.choice(ONCE, COUNT), observations)
    learnt = (Observation.ADAPTED, Observation.FITTED, Observation.CERTIFIED, Observation.REFUTED)
    observations = np.where(chance(COUNT) < 0.01, observations | random.choice(learnt, COUNT), observations)
    zeros = np.zeros((COUNT, 2))
    cycle = np.arange(COUNT)
    arms = ArmBatch(
        cycle, cycle * 1_000_000, seldom(1, (2, 9, 140)), zeros, zeros, zeros,
        np.stack((seldom(0, (3, 4)), np.zeros(COUNT, dtype=np.int64)), axis=1),
        np.stack((np.zeros(COUNT, dtype=np.int64), seldom(0, (3, 4))), axis=1),
        (chance(COUNT) > 0.003) & (cycle % 500 > 20),
        (chance(COUNT) > 0.01) & (cycle % 400 < 330),
        seldom(0, range(1, 11), 5e-4).astype(np.uint8),
        chance(COUNT) < 0.002,
    )  # fmt: skip
    return arms, observations, seldom(0, [int(request) for request in Request], 0.02)


def test_calm_cycles_change_nothing_but_the_counts():
    visited = set()
    for seed in range(4):
        states, looks = follow(seed)
        visited |= states
        assert looks < 0.6 * COUNT
    assert visited == set(SchemeState)


def follow(seed):
    """Compare both along a walk; return the states they were in, and how many cycles were looked at."""
    arms, observations, requests = walk(seed)
    random = np.random.default_rng(seed)
    each, few = Supervisor(SETTINGS), Supervisor(SETTINGS)
    findings = observations | few.findings(arms)
    visited, looks, k = set(), 0, 0
    while k < COUNT:
        is_reporting, goes_on = (bool(value) for value in random.integers(0, 2, 2))
        calm, before, first, passed = few.calm(is_reporting, goes_on), few.state, k, 0
        visited.add(before)
        while k < COUNT:
            passed += int(arms.periods[k])
            given = arm_at(arms, k), Request(requests[k]), int(observations[k]), is_reporting, goes_on
            each.step(*given)
            if requests[k] or k - first >= calm.cycles or not is_calm(calm, int(findings[k]), passed, k):
                break
            k += 1
        few.pass_by(observations[first:k], arms.periods[first:k])
        if k < COUNT:
            few.step(*given)
        assert vars(few) == vars(each)
        if before is few.state is SchemeState.FAULT:
            each, few = Supervisor(SETTINGS), Supervisor(SETTINGS)
        k, looks = k + 1, looks + 1
    return visited, looks


def test_the_arm_s_findings_are_bits_of_their_own():
    joints = 0b11 << CONTACT_SHIFT
    assert not sum(ArmFinding) & (sum(Observation) | joints)
    arms, _, _ = walk(0)
    found = Supervisor(SETTINGS).findings(arms)
    for bit, holds in (
        (ArmFinding.ENABLED, arms.is_enabled),
        (ArmFinding.COMPLETE, arms.is_complete),
        (ArmFinding.LATE, arms.is_late),
        (ArmFinding.FAULTY, arms.fault != FaultReason.NONE),
        (ArmFinding.OLD, np.maximum(arms.age_q.max(axis=1), arms.age_tau_J.max(axis=1)) == 4),
    ):
        np.testing.assert_array_equal(found & int(bit) != 0, holds)
