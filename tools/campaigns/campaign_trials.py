"""One trial of a campaign: an arm and a seed, brought to armed detection, then left alone, pushed or touched.

Each trial gives a flat record of plain numbers, which is what the campaign's tables are made of.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from campaign_bound import Bound, bound_of
from campaign_schemes import ARMED, Outcome, Scheme, scheme_named, true_residual
from lab import (
    PERIOD_S,
    ContactSettings,
    LabArm,
    Motion,
    Push,
    Recording,
    cut,
    join,
    multisine,
    profile_arm,
    random_arm,
    random_motion,
    random_moves,
    record,
    still,
)
from numpy.typing import NDArray

from adacd_hil.scheme.model.regressor import inverse_dynamics
from adacd_hil.score.judge import begins_of

PAYLOAD_KG = 1.0
SETTLE_S = 0.6
"""An arm stands this long before the payload is fitted, and after."""
ALARM_GAP_S = 0.5
"""Alarms closer than this are one."""
SPACING_S = 1.2
PUSH_S = 0.3
PUSH_MOVING_CYCLES = 100
PUSHES_PER_RECORD = 80
CONTACTS_PER_RECORD = 20
STEPS_NM = (0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0)
MOVING_RAD_S = 0.02
MOVING_S = 0.5
"""A joint counts as moving when its desired speed has been above MOVING_RAD_S for MOVING_S, five filter lags."""
PROBABLY_ARMED = 0.45
"""Share of a scheme's patience in which most adaptations end: a longer record is made only for those that don't."""
LOCATED_S = 0.01
ROOT_M = 0.1
"""Nearer to its joint a link is not touched: what a small force does there, no threshold of any use sees."""
BLIND_M = 0.1
"""Below this distance between joint 1 and a force's line, as seen from joint 2, force and lever are not told apart."""
TOUCH_S = 0.3
TOUCH_NM = 1.0

Row = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """Which arm, and with which chance. profile: P, S, M, or "random"."""

    scheme: str
    profile: str
    seed: int
    is_loaded: bool
    friction: str = "plain"

    def arm(self) -> LabArm:
        """Make the arm, without payload: it is fitted after the first adaptation."""
        if self.profile == "random":
            return random_arm(self.seed, friction=self.friction)
        return profile_arm(self.profile, friction=self.friction)

    def labels(self) -> Row:
        """Say which case a row belongs to."""
        return {
            "scheme": self.scheme, "profile": self.profile, "seed": self.seed, "loaded": self.is_loaded,
            "friction": self.friction,
        }  # fmt: skip


@dataclass(frozen=True)
class Prelude:
    """A motion that ends with detection armed, and what goes with it. took_s: each adaptation, NaN for never."""

    arm: LabArm
    motion: Motion
    begins: tuple[int, ...]
    feedforward: tuple[tuple[float, NDArray[np.float64]], ...]
    payloads: tuple[tuple[float, float], ...]
    took_s: tuple[float, ...]

    @property
    def is_armed(self) -> bool:
        """Whether detection is armed at its end."""
        return all(np.isfinite(self.took_s))

    def record(self, motion: Motion, seed: int, **touches: Any) -> Recording:
        """Record the prelude and `motion` after it. touches: as of `lab.record`, times in s from the whole's begin."""
        whole = join((self.motion, motion))
        return record(self.arm, whole, seed, feedforward=self.feedforward, payloads=self.payloads, **touches)


@cache
def scheme_of(name: str) -> Scheme:
    """Return a scheme, one per process."""
    return scheme_named(name)


def arm_up(case: Case) -> Prelude:
    """Adapt, and for a loaded case fit the payload and adapt again."""
    scheme = scheme_of(case.scheme)
    prelude = Prelude(case.arm(), scheme.adaptation_motion(False), (0,), (), (), ())
    prelude = _adapt(scheme, prelude, case.seed)
    if not case.is_loaded or not prelude.is_armed:
        return prelude
    again = scheme.adaptation_motion(True)
    parked = join((prelude.motion, still(again.q_d[0], 2.0 * SETTLE_S)))
    begin = len(parked.q_d)
    fitted_s = begin * PERIOD_S - SETTLE_S
    prelude = replace(
        prelude,
        motion=join((parked, again)),
        begins=(*prelude.begins, begin),
        payloads=((fitted_s, PAYLOAD_KG),),
    )
    return _adapt(scheme, prelude, case.seed)


def _adapt(scheme: Scheme, prelude: Prelude, seed: int) -> Prelude:
    """Find out when the last adaptation of a prelude ends, and cut its motion there."""
    begin = prelude.begins[-1]
    for share in (PROBABLY_ARMED, 1.0):
        motion = cut(prelude.motion, begin + round(share * (len(prelude.motion.q_d) - begin)))
        recording = record(prelude.arm, motion, seed, feedforward=prelude.feedforward, payloads=prelude.payloads)
        outcome = scheme.run(recording, prelude.begins)
        end = outcome.armed[-1]
        if end >= 0:
            break
    took_s = (end - begin) * PERIOD_S if end >= 0 else float("nan")
    prelude = replace(prelude, took_s=(*prelude.took_s, took_s))
    if end < 0:
        return prelude
    return replace(
        prelude,
        motion=cut(prelude.motion, end + 1),
        feedforward=(*prelude.feedforward, (end * PERIOD_S, outcome.theta[-1, :7])),
    )


def is_moving(motion: Motion) -> NDArray[np.bool_]:
    """Tell (n, 2) where each joint has been moving for a while."""
    is_slow = np.abs(motion.dq_d) < MOVING_RAD_S
    index = np.arange(len(is_slow))[:, None]
    last_slow = np.maximum.accumulate(np.where(is_slow, index, -(10**9)), axis=0)
    result: NDArray[np.bool_] = index - last_slow > MOVING_S / PERIOD_S
    return result


def alarms(outcome: Outcome, begin: int, end: int) -> int:
    """Count the alarms of armed detection between two cycles."""
    cycles = np.flatnonzero((outcome.over[begin:end] != 0) & (outcome.phase[begin:end] == ARMED))
    return int(np.count_nonzero(begins_of(cycles, ALARM_GAP_S / PERIOD_S)))


def leave_alone(case: Case, duration_s: float, motion_seed: int) -> Row:
    """Let an armed arm move without anybody near it."""
    prelude = arm_up(case)
    row = case.labels() | {"took_s": prelude.took_s, "is_armed": prelude.is_armed}
    if not prelude.is_armed:
        return row
    begin = len(prelude.motion.q_d)
    recording = prelude.record(random_motion(motion_seed, duration_s), case.seed)
    outcome = scheme_of(case.scheme).run(recording, prelude.begins)
    end = min(begin + round(duration_s / PERIOD_S), len(recording.q))
    moving = is_moving(recording.motion)[begin:end]
    residual = np.where(moving, np.abs(outcome.tau_ext_hat[begin:end]), 0.0)
    truth = np.where(moving, np.abs(true_residual(recording, 10.0)[begin:end]), 0.0)
    over = outcome.over[begin:end]
    return row | {
        "watched_s": (end - begin) * PERIOD_S,
        "alarms": alarms(outcome, begin, end),
        "alarm_joints": [int(np.count_nonzero(over & 1 << joint)) for joint in range(2)],
        "first_alarm_s": float(np.argmax(over != 0) * PERIOD_S) if over.any() else None,
        "residual_Nm": residual.max(0).tolist(),
        "true_residual_Nm": truth.max(0).tolist(),
    }


def push_steps(case: Case) -> list[Row]:
    """Push single joints with steps of torque at random instants; a row for each.

    is_moving: whether the joint ought to be moving for the first 0.1 s; at rest, stiction hides what is below it.
    """
    prelude = arm_up(case)
    if not prelude.is_armed:
        return []
    generator = np.random.default_rng([case.seed, 10])
    duration_s = PUSHES_PER_RECORD * SPACING_S + 2.0
    start_s = prelude.motion.duration_s + 1.5
    pushes, sizes = [], np.resize(generator.permutation(STEPS_NM), PUSHES_PER_RECORD)
    for index, size in enumerate(sizes):
        joint = int(generator.integers(2))
        torque = [0.0, 0.0]
        torque[joint] = float(size * generator.choice((-1.0, 1.0)))
        at_s = start_s + index * SPACING_S + generator.uniform(0.0, SPACING_S - PUSH_S - 0.7)
        pushes.append(Push(at_s, PUSH_S, (torque[0], torque[1])))
    motion = multisine(case.seed, duration_s) if case.seed % 2 else random_moves(case.seed, duration_s)
    recording = prelude.record(motion, case.seed, pushes=tuple(pushes))
    outcome = scheme_of(case.scheme).run(recording, prelude.begins)
    rows = []
    for push in pushes:
        joint = int(push.tau_ext_Nm[1] != 0.0)
        first, last = int(np.ceil(push.at_s / PERIOD_S)), int((push.at_s + PUSH_S) / PERIOD_S)
        if outcome.over[first - 1] or last >= len(outcome.over):
            continue  # still over from before
        found = np.flatnonzero(outcome.over[first:last])
        delay_s = (first + int(found[0])) * PERIOD_S - push.at_s if found.size else float("inf")
        speed = np.abs(recording.motion.dq_d[first : first + PUSH_MOVING_CYCLES, joint])
        rows.append(
            case.labels()
            | {
                "joint": joint,
                "step_Nm": abs(push.tau_ext_Nm[joint]),
                "delay_s": delay_s,
                "is_moving": bool(speed.min() > MOVING_RAD_S),
            }
        )
    return rows


def random_contact(generator: np.random.Generator, at_s: float, lengths_m: tuple[float, float]) -> ContactSettings:
    """Draw a contact: half-sine of 20 to 100 ms, step or slow push, 5 to 60 N, anywhere on either link but its root.

    One in two is without friction, so that its direction is known to be across the link.
    """
    link = int(generator.integers(1, 3))
    shape = ("half_sine", "step", "push")[int(generator.integers(3))]
    duration_s = {"half_sine": (0.02, 0.1), "step": (0.05, 0.15), "push": (0.3, 0.6)}[shape]
    side = float(generator.choice((-1.0, 1.0)))
    slant_deg = float(generator.uniform(-45.0, 45.0)) if generator.random() < 0.5 else 0.0
    return ContactSettings(
        at_s=at_s,
        link=link,
        point_m=float(generator.uniform(ROOT_M, lengths_m[link - 1])),
        force_N=float(generator.uniform(5.0, 60.0)),
        duration_s=float(generator.uniform(*duration_s)),
        angle_deg=side * 90.0 + slant_deg,
        shape=shape,
    )


def push_links(case: Case) -> list[Row]:
    """Touch links at random; a row for each contact."""
    prelude = arm_up(case)
    if not prelude.is_armed:
        return []
    generator = np.random.default_rng([case.seed, 11])
    start_s = prelude.motion.duration_s + 1.5
    spacing_s = 2.2
    lengths_m = prelude.arm.arm.link_length_m
    contacts = tuple(
        random_contact(generator, start_s + index * spacing_s + generator.uniform(0.0, 0.4), lengths_m)
        for index in range(CONTACTS_PER_RECORD)
    )
    motion = random_moves(case.seed + 1, CONTACTS_PER_RECORD * spacing_s + 2.0)
    recording = prelude.record(motion, case.seed, contacts=contacts)
    outcome = scheme_of(case.scheme).run(recording, prelude.begins)
    bound = profile_bound(case.profile, case.is_loaded)
    return [case.labels() | judge_contact(contact, recording, outcome, bound) for contact in contacts]


@cache
def profile_bound(profile: str, is_loaded: bool) -> Bound:
    """Return the noise-limited bound of a profile, measured once per process."""
    return bound_of(profile_arm(profile, PAYLOAD_KG if is_loaded else 0.0))


def _lever(contact: ContactSettings, recording: Recording, outcome: Outcome) -> Row:
    """Compare force and lever arm of a contact on link 2 without friction; nothing near q2 = 90 degrees.

    F = (tau1 - tau2) / (l1 cos q2), lever r = tau2 / F by least squares over the contact.
    """
    first, last = int(contact.at_s / PERIOD_S), int((contact.at_s + contact.duration_s) / PERIOD_S) + 3
    across_m = recording.arm.arm.link_length_m[0] * np.cos(recording.q[first:last, 1])
    if contact.link != 2 or abs(contact.angle_deg) != 90.0 or np.abs(across_m).min() < BLIND_M:
        return {}
    tau = outcome.tau_ext_wide_hat[first:last]
    force_N = (tau[:, 0] - tau[:, 1]) / across_m
    lever_m = float(tau[:, 1] @ force_N / (force_N @ force_N))
    return {"lever_error_m": lever_m - contact.point_m, "force_ratio": float(np.abs(force_N).max() / contact.force_N)}


def judge_contact(contact: ContactSettings, recording: Recording, outcome: Outcome, bound: Bound) -> Row:
    """Compare what was made of a contact with what it was."""
    first = int(np.ceil(contact.at_s / PERIOD_S))
    last = int((contact.at_s + contact.duration_s) / PERIOD_S) + 100
    truth = recording.tau_ext[first:last]
    row: Row = {
        "link": contact.link, "shape": contact.shape, "force_N": contact.force_N, "duration_s": contact.duration_s,
        "peak_Nm": np.abs(truth).max(0).tolist(), "impulse_Nms": np.abs(truth.sum(0) * PERIOD_S).tolist(),
        "was_over": bool(outcome.over[first - 1]), "noise_delay_s": bound.contact_delay_s(truth),
    }  # fmt: skip
    found = np.flatnonzero(outcome.over[first:last])
    if not found.size:
        return row | {"delay_s": float("inf")}
    alarm = first + int(found[0])
    located = slice(alarm, alarm + round(LOCATED_S / PERIOD_S) + 1)
    joints = int(np.bitwise_or.reduce(outcome.over[located]))
    threshold = float(outcome.threshold[alarm, 1])
    hidden = contact.link == 2 and bool(np.abs(recording.tau_ext[first : located.stop, 1]).max() < threshold)
    over = [joint for joint in range(2) if int(outcome.over[alarm]) >> joint & 1]
    pushed = np.sign(recording.tau_ext[first : alarm + 1].sum(0))
    signs = [outcome.direction[alarm, joint] == pushed[joint] for joint in over]
    strong = int(np.argmax(np.abs(truth).max(0)))
    wide = outcome.tau_ext_wide_hat[first:last, strong]
    return row | {
        "delay_s": alarm * PERIOD_S - contact.at_s,
        "found_link": 2 if joints & 2 else 1,
        "is_hidden": hidden,
        "is_direction_right": all(signs),
        "peak_ratio": float(np.abs(wide).max() / np.abs(truth[:, strong]).max()),
        **_lever(contact, recording, outcome),
    }


def predicted_change(before: NDArray[np.float64], after: NDArray[np.float64], motion: Motion) -> float:
    """Return the largest change of predicted torque over a motion, Nm; parameters after seven: two offsets, a lag."""
    change = after - before
    largest = 0.0
    for k in range(0, len(motion.q_d), 20):
        torque = inverse_dynamics(motion.q_d[k], motion.dq_d[k], motion.ddq_d[k], change[:7].copy(), 0.0)
        offset = change[7:9] if len(change) >= 9 else np.zeros(2)
        largest = max(largest, float(np.abs(torque + offset).max()))
    return largest


def touch_while_adapting(case: Case) -> Row:
    """Push a joint with TOUCH_NM during the first adaptation, and compare with the same run without."""
    scheme = scheme_of(case.scheme)
    case = replace(case, is_loaded=False)
    prelude = arm_up(case)
    row = case.labels() | {"took_s": prelude.took_s}
    if not prelude.is_armed:
        return row | {"is_armed": False}
    generator = np.random.default_rng([case.seed, 12])
    joint = int(generator.integers(2))
    torque = [0.0, 0.0]
    torque[joint] = TOUCH_NM * float(generator.choice((-1.0, 1.0)))
    at_s = float(generator.uniform(0.2, prelude.took_s[0] - TOUCH_S))
    recording = record(
        prelude.arm, scheme.adaptation_motion(False), case.seed, pushes=(Push(at_s, TOUCH_S, (torque[0], torque[1])),)
    )
    outcome = scheme.run(recording, (0,))
    first = int(np.ceil(at_s / PERIOD_S))
    found = np.flatnonzero(outcome.over[first : first + round(TOUCH_S / PERIOD_S)])
    changed = float("inf")
    if outcome.armed[0] >= 0:
        free = scheme.run(record(prelude.arm, scheme.adaptation_motion(False), case.seed), (0,)).theta[0]
        changed = predicted_change(free, outcome.theta[0], random_moves(case.seed, 20.0))
    return row | {
        "is_armed": outcome.armed[0] >= 0,
        "joint": joint,
        "at_s": at_s,
        "took_touched_s": outcome.armed[0] * PERIOD_S if outcome.armed[0] >= 0 else float("nan"),
        "flagged_s": (first + int(found[0])) * PERIOD_S - at_s if found.size else float("inf"),
        "was_over": bool(outcome.over[first - 1]),
        "changed_Nm": changed,
    }
