"""A contact's course from detection to its end: the times of its reports, and the arm's reaction to it.

`follow` runs in each cycle, after the kernel and the supervisor. It reads the new state, so it must run in each one.

**Reaction.** By level and link. It is chosen anew if a contact grows into a collision or its link turns out to be
another. A withdrawal changes to the `two_sided` reaction when a push comes from the other side, as in a clamp or with a
wall behind: the external torque along the direction of the withdrawal has turned against it by more than the upper
thresholds. Floating needs a valid model: without one the arm stops.

The paper's scheme withdraws from each contact, stops if it reacts without one, and never gives a withdrawal up.

Shapes: tau_ext_hat (2,), Nm.
"""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, ContactLevel, Reaction, SchemeState, Vector
from adacd_hil.scheme.supervisor.findings import COLLISION, CONTACT_SHIFT
from adacd_hil.scheme.supervisor.supervisor import IS_REACTING, SupervisorMemory
from adacd_hil.settings.configuration import Settings
from adacd_hil.structured import PerJoint

TURNED_CYCLES = 5
"""How many samples in a row the torque must be turned: the trace of a blow in the estimate is shorter."""
BLIND_S = 0.02
"""Time after the start of a withdrawal during which it is not judged: the estimate still rings from the blow."""
LINK_S = 0.01
"""Time from detection until the link is decided."""
_NEVER = 1 << 60
_CONTACT, _COLLISION = (int(level) for level in ContactLevel)
"""As plain numbers, which compiled code can compare with others."""


class CourseConstants:
    """Constants of the choice of reactions; a reaction is a number of `Reaction`.

    reactions: by level, the lower first, and link. two_sided: the reaction to a push from the other side of a
    withdrawal. is_kept: a reaction stays in force after REACT until the next contact. blind_cycles: first cycles of a
    withdrawal that aren't judged. due_cycles: cycles from the detection to each report, the final one last.
    collision_Nm: the upper thresholds.
    """

    reactions: Annotated[NDArray[np.int64], "levels n"]
    two_sided: int
    is_kept: int
    blind_cycles: int
    due_cycles: Annotated[NDArray[np.int64], "3"]
    collision_Nm: PerJoint


class CourseMemory:
    """State of the present contact.

    link: touched link, 0 for none. is_open: a report has been made that is not final yet. direction: sign of each
    joint's torque when it crossed its threshold, 0 before. level: the highest of this contact. cause_link: link for
    which the reaction was chosen. is_two_sided: a withdrawal was given up for the `two_sided` reaction. cycles: of the
    withdrawal in force; turned_cycles: the last ones in a row with the torque turned against it. kept_rows: rows
    written so far in the history for reports. early_rows: those of the contact before its detection. way: direction of
    a withdrawal, a unit vector; zeros without one.
    """

    is_reacting: int
    link: int
    is_open: int
    detected_cycle: int
    direction: Annotated[NDArray[np.int64], "n"]
    reaction: int
    level: int
    cause_link: int
    is_two_sided: int
    cycles: int
    turned_cycles: int
    kept_rows: int
    early_rows: int
    way: PerJoint


def fill_constants(settings: Settings, k: CourseConstants) -> None:
    """Fill `k` in place with the settings' reactions, upper thresholds and times, in cycles.

    In the paper's scheme the reaction to each contact is WITHDRAW.
    """
    wish, is_paper = settings.reaction, settings.scheme == "paper"
    chosen = (("withdraw",) * JOINTS,) * len(ContactLevel) if is_paper else (wish.contact, wish.collision)
    k.reactions[:] = [[Reaction[name.upper()] for name in names] for names in chosen]
    k.two_sided = Reaction[wish.two_sided.upper()]
    k.is_kept = is_paper
    k.blind_cycles = _NEVER if is_paper else round(BLIND_S / settings.bus.period_s)
    k.due_cycles[:] = [
        round(due_s / settings.bus.period_s)
        for due_s in (0.0, settings.report_s if is_paper else LINK_S, settings.report_s)
    ]
    k.collision_Nm[:] = settings.detector.collision_Nm


def begin(m: CourseMemory) -> None:
    """Set the level to CONTACT. Call it before the first cycle, with all other fields 0."""
    m.level = ContactLevel.CONTACT


def put_link(m: CourseMemory, link: int) -> None:
    """Store the touched link by a report; for another one than before, the next cycle chooses the reaction anew."""
    m.link = link


@compiled
def goes_on(m: CourseMemory) -> bool:
    """Return whether the arm moves on along its path: the reaction in force is NONE or SLOW_DOWN."""
    return bool(m.reaction in (Reaction.NONE, Reaction.SLOW_DOWN))


@compiled
def follow(
    k: CourseConstants,
    m: CourseMemory,
    supervisor: SupervisorMemory,
    cycle: int,
    observation: int,
    is_valid: bool,
    tau_ext_hat: Vector,
    tau_ext: Vector,
) -> bool:
    """Choose the reaction to a contact in this cycle; return whether a report of the contact is due.

    Outside the states of reaction clear the contact and return False. If the reaction begins with no joint over its
    threshold, as for a late host, stop the arm without a report.
    supervisor: its memory, after its step. observation: bit COLLISION, and from bit CONTACT_SHIFT on one bit per joint
    over its threshold. is_valid: there is a model to float with. tau_ext_hat: filtered, for the reaction; tau_ext:
    gives the direction of a joint when it crosses its threshold.
    """
    if not IS_REACTING[supervisor.state]:
        _leave(k, m, supervisor.state)
        return False
    joints = observation >> CONTACT_SHIFT
    level = _COLLISION if observation & COLLISION else _CONTACT
    if not m.is_reacting:
        m.is_reacting = 1
        if not joints:  # a late host, for example
            _react(m, Reaction.STOP, tau_ext_hat, False)
            m.level, m.cause_link = _COLLISION, 0
            return False
        m.is_open, m.detected_cycle = 1, cycle
        m.direction[:] = 0
        m.link = 2 if joints & 2 else 1
        m.is_two_sided = 0
        m.level, m.cause_link = level, m.link
        _choose(k, m, tau_ext_hat, is_valid)
    elif m.link:
        _reconsider(k, m, level, supervisor.is_latched != 0, tau_ext_hat, is_valid)
    return bool(m.is_open) and _is_due(k, m, cycle, joints, tau_ext)


@compiled
def _leave(k: CourseConstants, m: CourseMemory, state: int) -> None:
    """If the contact is in progress, end it, and its reaction unless `is_kept`.

    A report that is still due stays due, except in state FAULT.
    """
    if m.is_reacting:
        m.is_reacting, m.link = 0, 0
        if not k.is_kept:
            m.reaction, m.level, m.cause_link = Reaction.NONE, _CONTACT, 0
    if state == SchemeState.FAULT:
        m.is_open = 0


@compiled
def _is_due(k: CourseConstants, m: CourseMemory, cycle: int, joints: int, tau_ext: Vector) -> bool:
    """Return whether a report of the contact is due, `due_cycles` after its detection; the last one clears `is_open`.

    joints: bit i for joint i + 1 over its threshold. When a joint first crosses it, store the sign of its tau_ext.
    """
    elapsed = cycle - m.detected_cycle
    for i in range(m.direction.shape[0]):
        if joints >> i & 1 and m.direction[i] == 0:
            m.direction[i] = int(np.sign(tau_ext[i]))
    if elapsed >= k.due_cycles[-1]:
        m.is_open = 0
        return True
    return bool(np.any(k.due_cycles == elapsed))


@compiled
def _reconsider(
    k: CourseConstants, m: CourseMemory, level: int, is_latched: bool, tau_ext_hat: Vector, is_valid: bool
) -> None:
    """Choose the reaction anew if the contact has a higher level or another link, unless a withdrawal was given up.

    Stop an arm that goes on along its path once the supervisor has latched a contact without a collision (is_latched).
    Give up a withdrawal in force if the torque has turned against it, see `_judge`. is_valid: there is a model to float
    with.
    """
    level = max(level, m.level)
    is_other = level != m.level or m.link != m.cause_link
    if is_other and m.cause_link and not m.is_two_sided:
        m.level, m.cause_link = level, m.link
        _choose(k, m, tau_ext_hat, is_valid)
    if is_latched and goes_on(m) and m.level == _CONTACT:
        _react(m, Reaction.STOP, tau_ext_hat, True)
    if m.reaction == Reaction.WITHDRAW and np.any(m.way):
        _judge(k, m, tau_ext_hat, is_valid)


@compiled
def _choose(k: CourseConstants, m: CourseMemory, tau_ext_hat: Vector, is_valid: bool) -> None:
    """Begin the reaction of the settings to the contact's level and link, unless it is in force already.

    is_valid: there is a model to float with; else STOP takes the place of FLOAT.
    """
    reaction = k.reactions[m.level - 1, m.cause_link - 1]
    if reaction != m.reaction:
        _react(m, _possible(reaction, is_valid), tau_ext_hat, True)


@compiled
def _possible(reaction: int, is_valid: bool) -> int:
    """Return STOP in place of FLOAT without a valid model, else `reaction`."""
    return Reaction.STOP if reaction == Reaction.FLOAT and not is_valid else int(reaction)


@compiled
def _react(m: CourseMemory, reaction: int, tau_ext_hat: Vector, is_pushed: bool) -> None:
    """Set the reaction, and count its cycles from 0.

    is_pushed: set the direction of withdrawal to that of tau_ext_hat, else to zeros.
    """
    m.reaction = reaction
    size = np.sqrt(tau_ext_hat[0] * tau_ext_hat[0] + tau_ext_hat[1] * tau_ext_hat[1]) if is_pushed else 0.0
    for i in range(m.way.shape[0]):
        m.way[i] = tau_ext_hat[i] / size if size > 0.0 else 0.0
    m.cycles = m.turned_cycles = 0


@compiled
def _judge(k: CourseConstants, m: CourseMemory, tau_ext_hat: Vector, is_valid: bool) -> None:
    """Count a cycle of a withdrawal; change to the `two_sided` reaction if the torque has turned against it.

    It has if for TURNED_CYCLES in a row, after the first `blind_cycles`, the torque against the withdrawal was over the
    upper thresholds in that direction. is_valid: there is a model to float with.
    """
    m.cycles += 1
    if m.cycles <= k.blind_cycles:
        return
    along_Nm, bound_Nm = linalg.dot(tau_ext_hat, m.way), linalg.dot(np.abs(m.way), k.collision_Nm)
    m.turned_cycles = m.turned_cycles + 1 if along_Nm < -bound_Nm else 0
    if m.turned_cycles >= TURNED_CYCLES:
        m.is_two_sided = 1
        _react(m, _possible(k.two_sided, is_valid), tau_ext_hat, True)
