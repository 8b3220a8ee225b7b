"""Touches of an arm that learns, for touch_campaign.py: the arm of the scheme's tests, in closed loop, by seed.

Arm and noise are those of tests/scheme (no emulator, no bus); pipeline, desired motion and controller are the
product's. The motors are free and said to be, so the reading at rest is an anchor.
"""

import sys
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "scheme"))

from campaign_figures import KNOWN_S
from excited_arm import NAMES, OFFSETS, PERIOD_S, SETTINGS, TouchedLoop
from lab_motion import paper_motion
from mujoco_arm import MujocoArm
from planar_arm import THETA

from adacd_hil.control.controller import Controller
from adacd_hil.control.reference import Reference
from adacd_hil.records import ArmState, Request, SchemeOutput, SchemeState, Vector
from adacd_hil.scheme.identify import earlier, evidence, fit_check
from adacd_hil.scheme.kernel import certified_kernel, certified_memory
from adacd_hil.scheme.model.regressor import payload_direction
from adacd_hil.scheme.pipeline.certificate_watch import BY_WORD
from adacd_hil.structured import Structured

FREE = replace(
    SETTINGS, arm=replace(SETTINGS.arm, holding_torque_Nm=(0.0, 0.0)), safety=replace(SETTINGS.safety, commission_s=0.2)
)
KINDS = {
    "lean": 0.32, "tip force": 0.12, "drag": 0.12, "viscous": 0.10, "spring": 0.08, "inertia": 0.10, "payload": 0.06,
    "ramp": 0.10,
}  # fmt: skip
"""Kinds of touch, and their shares."""
SIZES = {
    "lean": (0.1, 2.0), "tip force": (1.0, 8.0), "drag": (0.1, 1.0), "viscous": (0.05, 0.3), "spring": (0.5, 10.0),
    "inertia": (0.01, 0.1), "payload": (0.05, 1.0), "ramp": (0.02, 1.0), "help": (0.05, 0.5),
}  # fmt: skip
"""Nm, N, Nm, Nm s/rad, N/m, kg m², kg, Nm/s, Nm; log-uniform. A hand that helps pushes along the motion, as friction
pulls against it."""
RULES = ("one model of the whole fit", "each sample explained", "borne out by what came later", "no more than before")
LIKE_A_JOINT = ("drag", "viscous", "inertia", "payload", "help")
"""Whose torque is a change of the arm's parameters."""
WIDE = 3.0
"""A wide arm has each parameter of profile M times or over at most this."""
HELPS_FROM_RAD_S = 0.02
"""Speed from which on a hand that helps pushes with all its torque."""
LIGHTEST_KGM2 = 0.04
STEADY_S = 0.6
"""How long the user lets the arm stand in a stop."""
UNTOUCHED_S, LONGEST_S, AFTER_S = 4.0, 14.0, 12.0
BEGINS_WITHIN_S = 3.0


@dataclass(frozen=True)
class Hand:
    """One touch: what it adds to the parameters (7,), its torque at the joints (2,), and at the tip force and spring.

    ramp_s: time in which the torque comes up. begins_s: since the arm began to learn.
    """

    kind: str
    size: float
    begins_s: float
    lasts_s: float
    added: Vector
    torque_Nm: Vector
    tip_N: float = 0.0
    spring_N_m: float = 0.0
    help_Nm: Vector = field(default_factory=lambda: np.zeros(2))
    ramp_s: float = 0.0

    @property
    def is_like_a_joint_from_the_start(self) -> bool:
        """Whether no run alone can tell it from the arm."""
        return self.kind in LIKE_A_JOINT and self.begins_s < KNOWN_S


@dataclass(frozen=True)
class Trial:
    """What came of one arm. Times in s; errors_Nm: of each certificate since the touch began, on the paper's motion.

    by_word_Nm: of those that carry the user's word, who acknowledges every stop, also one that names what has changed.
    rule_shares: how much of its limit each of RULES was, in the fits that led to certificates.
    """

    seed: int
    arm: str
    kind: str
    is_excused: bool
    is_reported: bool
    is_withheld: bool
    certified_s: float | None
    errors_Nm: tuple[float, ...]
    by_word_Nm: tuple[float, ...]
    back_after_s: float | None
    is_released: bool
    fault: str
    rule_shares: tuple[tuple[float, ...], ...]


def draw_arm(random: np.random.Generator) -> tuple[str, Vector]:
    """Draw profile P, S or M, or a wide arm; return its name and parameters (7,)."""
    kind = "PSMW"[random.integers(4)]
    if kind != "W":
        return kind, THETA[kind].copy()
    while True:
        theta = THETA["M"] * np.exp(random.uniform(-np.log(WIDE), np.log(WIDE), 7))
        a1, a2, a3 = theta[:3]
        is_possible = a3 * (a1 - a3) > 1.3 * a2**2
        # What the controller, whose gains are profile P's, accelerates with joint 2 free; lighter arms vibrate.
        if is_possible and (a1 - a3) - a2**2 / a3 > LIGHTEST_KGM2:
            return kind, theta


def draw_hand(random: np.random.Generator, kind: str = "") -> Hand:
    """Draw a touch, of a kind or of any: a quarter from before the start, a fifth without end."""

    def between(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    kind = kind or str(random.choice(list(KINDS), p=list(KINDS.values())))
    joint, sign = int(random.integers(2)), float(random.choice([-1.0, 1.0]))
    added, torque = np.zeros(7), np.zeros(2)
    size = between(*SIZES[kind])
    more: dict[str, Any] = {}
    if kind == "lean":
        torque[joint] = sign * size
    elif kind == "ramp":
        torque[joint] = sign * between(*SIZES["lean"])
        more["ramp_s"] = abs(torque[joint]) / size
    elif kind == "drag":
        added[5 + joint] = size
    elif kind == "viscous":
        added[3 + joint] = size
    elif kind == "inertia":
        added[[0, 2] if joint else [0]] = size
    elif kind == "help":
        more["help_Nm"] = size * np.eye(2)[joint]
    elif kind == "payload":
        added[:] = size * payload_direction(FREE.arm.link_length_m, 7, 0.0)
    else:
        more["tip_N" if kind == "tip force" else "spring_N_m"] = size * (sign if kind == "tip force" else 1.0)
    begins_s = 0.0 if random.random() < 0.25 else float(random.uniform(0.0, BEGINS_WITHIN_S))
    lasts_s = np.inf if random.random() < 0.2 else between(0.1, 10.0)
    return Hand(kind, size, begins_s, lasts_s, added, torque, **more)


class HandLoop(TouchedLoop):
    """The arm under a hand; the user acknowledges a stop after STEADY_S. is_foreign: an arm of MuJoCo's."""

    def __init__(self, seed: int, is_foreign: bool = False):
        random = np.random.default_rng(seed)
        self.arm, free = draw_arm(random)
        super().__init__(FREE, random.uniform(-0.2, 0.2, 2), theta=free, seed=seed)
        self.free, self.random = free, random
        if is_foreign:
            self.advance = MujocoArm().advance
        self.reference, self.controller = Reference(FREE, *self.desired), Controller(FREE)
        self.tau_d = np.zeros(2)
        self.stopped_cycles = 0
        self.held_at: tuple[float, float] | None = None

    @property
    def truth(self) -> Vector:
        """The parameters that a fit of the untouched arm should find (p,)."""
        values = np.zeros(len(NAMES))
        values[:7], values[OFFSETS] = self.free, self.offset_Nm
        return values

    def touch(self, hand: Hand, since_s: float) -> None:
        """Let the hand act, which began so long ago."""
        l1, l2 = FREE.arm.link_length_m
        share = min(since_s / hand.ramp_s, 1.0) if hand.ramp_s else 1.0
        q1, q12 = self.q[0], self.q.sum()
        x, y = l1 * np.cos(q1) + l2 * np.cos(q12), l1 * np.sin(q1) + l2 * np.sin(q12)
        self.held_at = self.held_at or (x, y)
        pull = hand.spring_N_m * np.subtract(self.held_at, (x, y))
        self.theta = self.free + hand.added
        self.tau_ext[:] = share * hand.torque_Nm + hand.help_Nm * np.clip(self.dq / HELPS_FROM_RAD_S, -1.0, 1.0)
        self.tau_ext += hand.tip_N * np.array([l2 + l1 * np.cos(self.q[1]), l2])
        self.tau_ext += (x * pull[1] - y * pull[0], l2 * (np.cos(q12) * pull[1] - np.sin(q12) * pull[0]))

    def let_go(self) -> None:
        """End the touch."""
        self.theta, self.held_at = self.free, None
        self.tau_ext[:] = 0.0

    def control(self, arm: ArmState, output: SchemeOutput) -> Vector:
        """Return the torque that the product commands (2,)."""
        self.reference.step(arm, output)
        if output.is_model_valid:
            self.controller.feed_forward(output.theta_ff)
        self.controller.torque(arm.q, arm.dq, *self.desired, self.tau_d)
        return self.tau_d.copy()

    def step(self) -> SchemeOutput:
        """Play one period, and acknowledge what has stood long enough."""
        output = super().step()
        self.stopped_cycles = self.stopped_cycles + 1 if output.state is SchemeState.STOPPED else 0
        if self.stopped_cycles * PERIOD_S >= STEADY_S:
            self.request, self.stopped_cycles = Request.ACKNOWLEDGE, 0
        return output


def rule_shares(constants: Structured, memory: Structured) -> tuple[float, ...]:
    """Return how much of its limit each of RULES is of the fit that has just ended."""
    memory = memory.copy()
    k, m = constants[0], memory[0]
    steps = range(min(int(m.fit_check.steps_used), fit_check.STEPS))
    places = [(s, i) for s in range(int(m.fit_check.samples_kept)) for i in range(2)]
    changed = max((fit_check.changed_share(m, s) for s in steps), default=0.0)
    explained = max((abs(fit_check.residual(m, *place)) for place in places), default=0.0) / fit_check.limit_Nm(m)
    later = max((fit_check.later_share(k, m, s) for s in steps), default=0.0)
    earlier.forget(m)
    earlier.keep_fit(k, m)
    earlier.is_no_more(k, m)
    more = np.max(m.evidence.difference[evidence.KEPT :] / m.evidence.limit[evidence.KEPT :])
    return float(changed), float(explained), float(later), float(more)


@cache
def paper_rows() -> Vector:
    """Return rows (n, p) of the slowest filter on the paper's motion, without the lags, which no touch looks like."""
    motion = paper_motion(12.0)
    constants, memory = certified_memory.constants_of(FREE), certified_memory.new_memory(FREE)
    block, rows = certified_memory.new_block(FREE), []
    for cycle, (q, dq) in enumerate(zip(motion.q_d, motion.dq_d, strict=True)):
        block["q"], block["dq"], block["period_s"] = q, dq, 0.0
        certified_kernel.step(constants, memory, block, 1, 1, 0)
        if cycle >= 1000 and cycle % 20 == 0:
            rows.append(memory[0].filters.W_f[0].copy())
    found = np.concatenate(rows)
    found[:, [place for place, name in enumerate(NAMES) if name.startswith("lag")]] = 0.0
    return found


def play(seed: int, is_touched: bool, is_foreign: bool = False, kind: str = "") -> Trial:
    """Play one arm, and unless it stays untouched one hand. is_foreign: the arm is MuJoCo's. kind: of the hand."""
    loop = HandLoop(seed, is_foreign)
    hand = draw_hand(loop.random, kind) if is_touched else None
    begins_s, ends_s = (0.0, 0.0) if hand is None else (hand.begins_s, hand.begins_s + hand.lasts_s)
    until_s = UNTOUCHED_S if hand is None else LONGEST_S if np.isinf(ends_s) else ends_s + AFTER_S
    loop.run_until(SchemeState.ADAPT)
    begun, state = loop.cycle, SchemeState.ADAPT
    errors: list[float] = []
    by_word: list[float] = []
    shares: list[tuple[float, ...]] = []
    is_reported, certified_s, back_after_s, fault = False, None, None, ""
    while (at_s := (loop.cycle - begun) * PERIOD_S) < until_s and back_after_s is None and not fault:
        if hand is not None and begins_s <= at_s < ends_s:
            loop.touch(hand, at_s - begins_s)
        else:
            loop.let_go()
        output, before = loop.step(), state
        state = output.state
        if state is SchemeState.CERTIFY and before is SchemeState.ADAPT:
            shares.append(rule_shares(*loop.kernel))
        is_reported |= state is SchemeState.REACT and before is not state and at_s >= begins_s
        if state is SchemeState.MONITOR and before is SchemeState.CERTIFY and (hand is None or at_s > begins_s):
            certified_s = at_s if certified_s is None else certified_s
            error_Nm = float(np.abs(paper_rows() @ (loop.model_theta - loop.truth)).max())
            (by_word if BY_WORD in loop.said("certificate")[-1] else errors).append(error_Nm)
        if hand is not None and at_s > ends_s and state is SchemeState.MONITOR:
            back_after_s = at_s - ends_s
        fault = output.fault.name if state is SchemeState.FAULT else ""
    return Trial(
        seed, loop.arm, "none" if hand is None else hand.kind, hand is not None and hand.is_like_a_joint_from_the_start,
        is_reported, bool(loop.said("anchor") or loop.said("touch")), certified_s, tuple(errors), tuple(by_word),
        back_after_s,
        is_released=bool(np.isfinite(ends_s)), fault=fault, rule_shares=tuple(shares),
    )  # fmt: skip
