"""What the supervisor lets pass without a look is what it would have let pass with one."""

import numpy as np
import pytest
from smooth_motion import settings_with

from adacd_hil.records import ArmBatch, FaultReason, Request, SchemeState
from adacd_hil.scheme.pipeline.pipeline import arm_at
from adacd_hil.scheme.supervisor.supervisor import Supervisor
from adacd_hil.scheme.supervisor.transitions import CONTACT_SHIFT, ArmFinding, Observation, findings_of, is_calm

SETTINGS = settings_with(
    safety={"commission_s": 0.012, "phase_timeout_s": 0.15},
    termination={"timeout_s": 1.0},
    reaction={"clear_s": 0.07, "patience_s": 0.3, "rebound_s": 0.02},
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
        chance(COUNT) < 0.002, np.ones(COUNT, dtype=np.int64), cycle * 1_000_000,
    )  # fmt: skip
    return arms, observations, seldom(0, [int(request) for request in Request], 0.02)


def test_calm_cycles_change_nothing_but_the_counts():
    visited = set()
    for seed in range(4):
        random = np.random.default_rng(seed)
        states, looks = follow(*walk(seed), lambda random=random: random.integers(0, 2, 2).astype(bool).tolist())
        visited |= states
        assert looks < 0.6 * COUNT
    assert visited == set(SchemeState)


def follow(arms, observations, requests, draw):
    """Compare both along a walk; return the states they were in, and how many cycles were looked at.

    draw: gives is_reporting and goes_on, which stay until the next look.
    """
    each, few = Supervisor(SETTINGS), Supervisor(SETTINGS)
    findings = observations | findings_of(arms)
    visited, looks, k = set(), 0, 0
    while k < len(requests):
        is_reporting, goes_on = draw()
        calm, before, first, passed = few.calm(is_reporting, goes_on), few.state, k, 0
        visited.add(before)
        while k < len(requests):
            passed += int(arms.periods[k])
            given = arm_at(arms, k), Request(requests[k]), int(observations[k]), is_reporting, goes_on
            each.step(*given)
            if requests[k] or k - first >= calm.cycles or not is_calm(calm, int(findings[k]), passed, k):
                break
            k += 1
        few.pass_by(observations[first:k], arms.periods[first:k])
        if k < len(requests):
            few.step(*given)
        assert vars(few) == vars(each)
        if before is few.state is SchemeState.FAULT:
            each, few = Supervisor(SETTINGS), Supervisor(SETTINGS)
        k, looks = k + 1, looks + 1
    return visited, looks


def healthy(count):
    """Return an arm to which nothing happens, what is found of it until it monitors, and no requests."""
    observations = np.full(count, int(REST))
    observations[20] = int(Observation.ADAPTED)
    zeros, ages, no = np.zeros((count, 2)), np.zeros((count, 2), dtype=np.int64), np.zeros(count, dtype=bool)
    cycle = np.arange(count)
    arms = ArmBatch(
        cycle, cycle, np.ones_like(cycle), zeros, zeros, zeros, ages, ages, ~no, ~no, no.astype(np.uint8), no,
        np.ones_like(cycle), cycle,
    )  # fmt: skip
    return arms, observations, np.zeros(count, dtype=np.uint8)


@pytest.mark.parametrize("touched", [Observation.CONTACT, Observation.CONTACT | Observation.AT_REST])
@pytest.mark.parametrize("cycles", [20, 200, 400])
def test_a_contact_clears_and_loses_patience_in_its_cycle(touched, cycles):
    """A contact, then rest; an acknowledgement waits for its end, and is too late for one that has cleared."""
    arms, observations, requests = healthy(1000)
    observations[30 : 30 + cycles] = int(touched)
    requests[380] = Request.ACKNOWLEDGE
    states, looks = follow(arms, observations, requests, lambda: (False, False))
    assert SchemeState.REACT in states
    assert (SchemeState.STOPPED in states) == (cycles == 400)
    assert looks < 30


def test_a_changed_payload_waits_for_rest():
    arms, observations, requests = healthy(300)
    observations[40:100] = int(Observation.NONE)
    requests[[30, 60]] = Request.PAYLOAD, Request.PAYLOAD_CHANGED
    states, looks = follow(arms, observations, requests, lambda: (False, False))
    assert SchemeState.PAYLOAD in states
    assert looks < 30


def test_the_arm_s_findings_are_bits_of_their_own():
    joints = 0b11 << CONTACT_SHIFT
    assert not sum(ArmFinding) & (sum(Observation) | joints)
    arms, _, _ = walk(0)
    found = findings_of(arms)
    for bit, holds in (
        (ArmFinding.ENABLED, arms.is_enabled),
        (ArmFinding.COMPLETE, arms.is_complete),
        (ArmFinding.LATE, arms.is_late),
        (ArmFinding.FAULTY, arms.fault != FaultReason.NONE),
        (ArmFinding.OLD, np.maximum(arms.age_q.max(axis=1), arms.age_tau_J.max(axis=1)) > 1),
    ):
        np.testing.assert_array_equal(found & int(bit) != 0, holds)
