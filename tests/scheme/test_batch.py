"""Live is replay: cycles taken in at once decide as one by one, wherever they are split."""

from dataclasses import replace

import numpy as np
import pytest
from excited_arm import PERIOD_S, SETTINGS, record
from planar_arm import PAYLOAD_1KG, THETA

from adacd_hil.control.motions import Excitation
from adacd_hil.records import ArmBatch, Request, SchemeState
from adacd_hil.replay.logged_arms import arm_at
from adacd_hil.scheme.pipeline.new_pipeline import new_pipeline
from adacd_hil.scheme.pipeline.pipeline import layout_of

REST = 60
"""Cycles at rest, the first of them without drives."""
PAUSES_S = ((4.6, 5.5), (6.2, 8.4), (8.9, 10.1))
PUSHES = (
    (4.55, 4.7, (3.0, 0.8)),
    (6.15, 6.5, (0.0, -0.6)),
    (6.5, 6.6, (0.0, -3.0)),
    (6.6, 7.5, (0.0, -0.6)),  # until something still pushes at rest
    (8.8, 8.93, (1.5, 0.3)),
)
REQUESTS = (
    (4.6, Request.ACKNOWLEDGE),  # too early
    (5.2, Request.ACKNOWLEDGE),
    (7.9, Request.ACKNOWLEDGE),
    (8.1, Request.PAYLOAD),
    (8.233, Request.PAYLOAD_CHANGED),
)
PAYLOAD_S = 8.17
SECONDS = 12.6


def settings_of(scheme):
    """Return settings with which either scheme soon monitors, promotes models while it does, and has no patience."""
    return replace(
        SETTINGS,
        scheme=scheme,
        termination=replace(SETTINGS.termination, hold_s=0.3, beta_Nm=0.4, excitation_Nm2s=1e-6),
        detector=replace(SETTINGS.detector, threshold_Nm=(0.3, 0.3)),
        certified=replace(SETTINGS.certified, refine_s=0.2),
        reaction=replace(SETTINGS.reaction, patience_s=0.25, contact=("slow_down", "stop")),
        arm=replace(SETTINGS.arm, holding_torque_Nm=(0.0, 0.0)),  # anchors judge each certificate and promotion
    )


def motion_with_pauses(seconds):
    """Return q_d, dq_d (n, 2) of the excitation, slowed down to rest in the pauses."""
    count = round(seconds / PERIOD_S)
    at_s = np.arange(count) * PERIOD_S
    rate = np.ones(count)
    for begin_s, end_s in PAUSES_S:
        rate = np.minimum(rate, np.clip(np.maximum(begin_s - at_s, at_s - end_s) / 0.1 + 1.0, 0.0, 1.0))
    excitation, warped_s = Excitation(SETTINGS), np.cumsum(rate) * PERIOD_S
    q_d, dq_d, ddq_d = (np.zeros((count, 2)) for _ in range(3))
    for k in range(count):
        excitation.evaluate(warped_s[k], q_d[k], dq_d[k], ddq_d[k])
    return q_d, rate[:, None] * dq_d


@pytest.fixture(scope="module")
def life():
    """An arm that learns, is pushed, stopped, acknowledged, touched, loaded, and pushed while it learns again."""
    motion = motion_with_pauses(SECONDS)
    count = len(motion[0])
    tau_ext = np.zeros((count, 2))
    for begin_s, end_s, torque in PUSHES:
        tau_ext[round(begin_s / PERIOD_S) : round(end_s / PERIOD_S)] = torque
    moved = record(THETA["P"], SECONDS, tau_ext, PAYLOAD_1KG, PAYLOAD_S, motion, seed=4)
    q, dq, tau_J = (np.concatenate((np.tile(column[0], (REST, 1)), column)) for column in moved)
    total = REST + count
    random = np.random.default_rng(2)
    periods = np.ones(total, dtype=np.int64)
    periods[random.integers(REST, total, 6)] = 12
    is_complete = np.ones(total, dtype=bool)
    is_complete[random.integers(REST, total, 12)] = False
    is_complete[:2] = False
    cycle = np.arange(total, dtype=np.int64)
    t_ns = 1_790_000_000_000_000_000 + np.cumsum(periods) * 1_000_000 + random.integers(0, 50_000, total)
    arms = ArmBatch(
        cycle=cycle,
        t_ns=t_ns,
        periods=periods,
        q=q,
        dq=dq,
        tau_J=tau_J,
        age_q=random.integers(0, 2, (total, 2)) + (random.random((total, 2)) < 0.01) * (cycle[:, None] < 2400),
        age_tau_J=random.integers(0, 2, (total, 2)),
        is_enabled=cycle > REST // 2,
        is_complete=is_complete,
        fault=np.zeros(total, dtype=np.uint8),
        is_late=np.zeros(total, dtype=bool),
        steps=steps_of(cycle, is_complete, periods),
        sampled_ns=t_ns,
    )
    requests = np.zeros(total, dtype=np.uint8)
    for at_s, request in REQUESTS:
        requests[REST + round(at_s / PERIOD_S)] = request
    return arms, requests


def steps_of(cycle, is_complete, periods):
    """Count the periods between each fresh sample and the one before it; 0 where there is none."""
    elapsed = np.cumsum(periods)
    steps = np.zeros(cycle.size, dtype=np.int64)
    fresh = np.flatnonzero(is_complete)
    steps[fresh] = np.diff(elapsed[fresh], prepend=elapsed[fresh[0]] - 1)
    return steps


def pipeline_of(scheme):
    return new_pipeline(settings_of(scheme))


def part(arms, begin, end):
    return ArmBatch(*(column[begin:end] for column in arms))


def state_of(thing):
    """Return everything that a pipeline remembers, in a form that compares bit by bit."""
    if isinstance(thing, np.ndarray | np.void):
        return thing.tobytes()
    if isinstance(thing, tuple | list):
        return [state_of(each) for each in thing]
    if type(thing).__module__.startswith("adacd_hil.scheme") and hasattr(thing, "__dict__"):
        own = ("_sample", "_decision", "_block")  # of the last single step
        return {name: state_of(value) for name, value in vars(thing).items() if name not in own}
    return repr(thing)


def stepped(pipeline, arms, requests):
    return [pipeline.step(arm_at(arms, k), Request(requests[k])) for k in range(len(requests))]


def rows_of(outputs):
    """Return what a batch has of each cycle, one tuple per cycle."""
    return [
        (o.cycle, o.state, o.previous_state, o.fault, o.reaction, o.contact_joints, o.is_model_valid, o.contact,
         o.block.tobytes())
        for o in outputs
    ]  # fmt: skip


def rows_of_batches(batches):
    rows = []
    for batch in batches:
        contacts = dict(zip(batch.contact_places.tolist(), batch.contacts, strict=True))
        columns = batch[:7]
        for k in range(batch.cycle.size):
            values = tuple(column[k].item() for column in columns)
            rows.append((*values, contacts.get(k), batch.block[k].tobytes()))
    return rows


SCHEMES = ("paper", "certified")


@pytest.fixture(scope="module", params=SCHEMES)
def lived(request, life):
    """The scheme's name, what its pipeline remembers after the life, its outputs cycle by cycle, and its events."""
    pipeline = pipeline_of(request.param)
    outputs = stepped(pipeline, *life)
    return request.param, state_of(pipeline), outputs, pipeline.take_events()


def test_the_life_has_all_of_it(lived):
    scheme, _, outputs, events = lived
    missing = {state.name for state in set(SchemeState) - {output.state for output in outputs}}
    assert missing == ({"FAULT", "CERTIFY"} if scheme == "paper" else {"FAULT"})
    assert len([output for output in outputs if output.contact is not None]) >= 6
    if scheme == "certified":
        assert {output.reaction.name for output in outputs} == {"NONE", "STOP", "WITHDRAW", "SLOW_DOWN"}
        assert outputs[6000].block[layout_of(settings_of(scheme)).slices["promotions"]] >= 5
        assert [event.name for event in events] == ["certificate", "touch"]


@pytest.mark.parametrize("seed", range(2))
def test_it_may_be_split_anywhere_and_mixed_with_single_steps(life, lived, seed):
    scheme, remembered, outputs, _ = lived
    arms, requests = life
    random = np.random.default_rng(seed)
    again, rows = pipeline_of(scheme), []
    begin = 0
    while begin < len(requests):
        end = min(begin + int(random.choice((0, 1, 2, 7, 60, 400, 2000))), len(requests))
        few = part(arms, begin, end), requests[begin:end]
        if end - begin < 100 and random.integers(2):
            rows += rows_of(stepped(again, *few))
        else:
            rows += rows_of_batches([again.run(*few)])
        begin = end
    assert rows == rows_of(outputs)
    assert state_of(again) == remembered
