"""Forces between the arm and bodies, hands and walls: penalty contacts with state, for the integrator of the arm.

The arm is seen as the axes of its links. Each thing of a scenario is a row of the touch table; together they have one
state vector: the energy, then THING_STATE places per row. Things never touch each other.

    body   F = max(0, K δ + c δ̇) along the normal n from the link to the body, at the point nearest to its centre.
           δ is the penetration. The body moves in its free direction u: m ṡ̇ = F n·u, s = 0 where it stands. Its
           wall, if any, takes the force as soon as s reaches the room; what kinetic energy it has then is lost.
    hand   F = K (p_d − p) + c (ṗ_d − ṗ), never larger than its limit; p_d moves from where p was when it grasped.
    wall   F = K δ max(0, 1 + χ δ̇) along its normal, at the elbow (end of link 1) and at the tip (end of link 2)

Bodies and walls only push; only a hand can pull. The two-mass model is that of ISO/TS 15066:2016 Annex A; the damping
of a wall is that of Hunt and Crossley 1975, which has no step at the first touch and no pull at separation.

A body or wall is put in place at its time, or as soon after it as the arm is not where it is to stand. A body's side
of the link is decided there and whenever it is off the end of the link, so deep penetration never throws it through.

Power and energy are what the arm gives: −τᵀ q̇ of all that touches it, prescribed contacts included, and its integral
since the arm was last untouched.
"""

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from firmware_sim.arm.arms import ArmProfile
from firmware_sim.arm.scripted_contact import LINK as CONTACT_LINK
from firmware_sim.arm.scripted_contact import TICK_S, contact_force, contact_torque, ticks

if TYPE_CHECKING:
    from firmware_sim.arm.touch_settings import BodySettings, HandSettings, WallSettings
    from firmware_sim.scenario.scenario import Scenario

BODY: Final = 0
HAND: Final = 1
WALL: Final = 2

# Columns of a touch table, one row per thing, in the order bodies, hands, walls.
KIND: Final = 0  # BODY, HAND, WALL
INDEX: Final = 1  # in the order contacts, bodies, hands, walls
ONSET_S: Final = 2  # on the 100 µs grid
END_S: Final = 3  # inf: never
LINK: Final = 4
LENGTH1_M: Final = 5
LENGTH2_M: Final = 6
X_M: Final = 7  # body: centre; hand: where it guides to; wall: a point of it
Y_M: Final = 8
ANGLE_RAD: Final = 9  # body: free direction, nan for the normal; hand: direction, nan for none; wall: normal
STIFFNESS: Final = 10  # N/m
DAMPING: Final = 11  # body, hand: N s/m; wall: s/m
MASS: Final = 12  # kg, body
RADIUS_M: Final = 13  # body
ROOM_M: Final = 14  # body: how far it can recede
POINT_M: Final = 15  # hand
FORCE_LIMIT: Final = 16  # N, hand
SPEED: Final = 17  # m/s, hand
STIFF_RATE: Final = 18  # rad/s, largest √(K/μ) against the unloaded arm in any pose
DAMPED_RATE: Final = 19  # 1/s, largest c/μ
TOUCH_COLUMNS: Final = 20

# Places in the touch state.
ENERGY: Final = 0  # J
TOUCH_HEADER: Final = 1  # the first thing's places begin here
THING_STATE: Final = 6
PRESENCE: Final = 0  # of a thing: one of the three below
SHIFT: Final = 1  # body: s, m
SHIFT_RATE: Final = 2  # body: ṡ, m/s
FREE_X: Final = 3  # body: u; wall: normal
FREE_Y: Final = 4
SIDE: Final = 5  # body: +1 on the side of +q of its link, else −1
START_X: Final = 1  # hand: where it grasped, m
START_Y: Final = 2
PATH_X: Final = 3  # hand: direction of its way; 0, 0 for none
PATH_Y: Final = 4
PATH_LENGTH: Final = 5  # hand: m, inf for no end

Pose = tuple[float, float, float, float]
"""Cosine and sine of the angle of link 1, cosine and sine of the angle of link 2."""

_WAITING: Final = 0.0
_PRESENT: Final = 1.0
_GONE: Final = 2.0
_HALF_TICK_S: Final = 0.5 * TICK_S

# Places in what `describe_touch` fills.
FORCE: Final = 0  # N, the strongest force
STRONGEST_LINK: Final = 1  # 0 for none
STRONGEST_INDEX: Final = 2  # −1 for none
POWER: Final = 3  # W
TRUE_ENERGY: Final = 4  # J
TOUCH_TRUTH: Final = 5

_POSES: Final = 181
_POINTS: Final = 61
"""Grid on which the smallest effective mass of the arm is searched: 1° of the elbow, 1/60 of the link."""
_LARGEST_TURN_RAD: Final = 0.1
"""Largest rate times step. RK4 then gets a blow's impulse to 3e-4 and its energy to 8e-4, wherever in a step it begins;
with a tenth (a third) of critical damping, whose force jumps, its impulse to 3e-3 (6e-3). At 0.17 rad: 6e-4, 2e-3."""
_FASTEST_BLOW_M_S: Final = 2.0
"""Fastest blow that `largest_rate_rad_s` covers: the tip of both links, straight, at 180 deg/s."""


def _largest_mobility(arm: ArmProfile, link: int, points_m: Vector) -> float:
    """Give the largest 1/mass, 1/kg, that the unloaded arm shows a force at these points of a link, in any pose."""
    alpha, beta, gamma = arm.inertia()
    length1_m = arm.link_length_m[0]
    elbow_rad, point_m = np.meshgrid(np.linspace(0.0, math.pi, _POSES), points_m)
    if link == 1:
        point_m, length1_m = np.zeros_like(point_m), float(points_m.max())
    # At q₁ = 0. In absolute link angles the point's velocity is l₁ φ̇₁ (0, 1) + p φ̇₂ (−sin q₂, cos q₂), the mass matrix
    # [[α, β cos q₂], [β cos q₂, γ]]; its inverse lies between two Jacobians.
    coupling = beta * np.cos(elbow_rad)
    determinant = alpha * gamma - coupling**2
    j21, j12, j22 = length1_m, -point_m * np.sin(elbow_rad), point_m * np.cos(elbow_rad)
    w11 = j12 * j12 * alpha / determinant
    w12 = (j12 * j22 * alpha - j12 * j21 * coupling) / determinant
    w22 = (j21 * j21 * gamma - 2.0 * j21 * j22 * coupling + j22 * j22 * alpha) / determinant
    largest = 0.5 * (w11 + w22) + np.sqrt(0.25 * (w11 - w22) ** 2 + w12**2)
    return float(largest.max())


def _row(kind: int, arm: ArmProfile, thing: "BodySettings | HandSettings | WallSettings") -> Vector:
    """Fill the columns that all things have."""
    row = np.full(TOUCH_COLUMNS, np.nan)
    row[KIND] = kind
    row[ONSET_S] = ticks(thing.at_s) * TICK_S
    row[END_S] = math.inf if thing.duration_s is None else (ticks(thing.at_s) + ticks(thing.duration_s)) * TICK_S
    row[LENGTH1_M], row[LENGTH2_M] = arm.link_length_m
    return row


def _body_row(arm: ArmProfile, body: "BodySettings") -> Vector:
    row = _row(BODY, arm, body)
    row[LINK], row[X_M], row[Y_M] = body.link, body.x_m, body.y_m
    row[STIFFNESS], row[DAMPING], row[MASS] = body.stiffness, body.damping_N_s_m, body.mass
    row[RADIUS_M], row[ROOM_M] = body.radius_m, body.room_m
    row[ANGLE_RAD] = math.nan if body.free_deg is None else math.radians(body.free_deg)
    points_m = np.linspace(0.0, arm.link_length_m[body.link - 1], _POINTS)
    mobility = _largest_mobility(arm, body.link, points_m) + 1.0 / body.mass
    row[STIFF_RATE], row[DAMPED_RATE] = math.sqrt(body.stiffness * mobility), body.damping_N_s_m * mobility
    return row


def _hand_row(arm: ArmProfile, hand: "HandSettings") -> Vector:
    row = _row(HAND, arm, hand)
    row[LINK], row[POINT_M], row[FORCE_LIMIT], row[SPEED] = hand.link, hand.point_m, hand.force_limit_N, hand.speed_m_s
    row[STIFFNESS], row[DAMPING] = hand.stiffness_N_m, hand.damping_N_s_m
    if hand.move_to_m is not None:
        row[X_M], row[Y_M] = hand.move_to_m
    if hand.direction_deg is not None:
        row[ANGLE_RAD] = math.radians(hand.direction_deg)
    mobility = _largest_mobility(arm, hand.link, np.array([hand.point_m]))
    row[STIFF_RATE], row[DAMPED_RATE] = math.sqrt(hand.stiffness_N_m * mobility), hand.damping_N_s_m * mobility
    return row


def _wall_row(arm: ArmProfile, wall: "WallSettings") -> Vector:
    row = _row(WALL, arm, wall)
    row[X_M], row[Y_M], row[ANGLE_RAD] = wall.x_m, wall.y_m, math.radians(wall.normal_deg)
    row[STIFFNESS], row[DAMPING] = wall.stiffness_N_m, wall.damping_s_m
    mobility = max(_largest_mobility(arm, link, np.array([arm.link_length_m[link - 1]])) for link in (1, 2))
    row[STIFF_RATE] = math.sqrt(wall.stiffness_N_m * mobility)
    # ∂F/∂δ̇ = K χ δ is largest at the deepest point of a blow with v, about v/√(K/μ).
    row[DAMPED_RATE] = row[STIFF_RATE] * wall.damping_s_m * _FASTEST_BLOW_M_S
    return row


def touch_table(scenario: "Scenario") -> NDArray[np.float64]:
    """Pack a scenario's bodies, hands and walls (n, TOUCH_COLUMNS); n = 0 when it has none."""
    arm = scenario.arm
    rows = [_body_row(arm, body) for body in scenario.bodies]
    rows += [_hand_row(arm, hand) for hand in scenario.hands]
    rows += [_wall_row(arm, wall) for wall in scenario.walls]
    table = np.array(rows, dtype=np.float64).reshape(len(rows), TOUCH_COLUMNS)
    table[:, INDEX] = len(scenario.contacts) + np.arange(len(rows))
    return table


def initial_touch_state(things: NDArray[np.float64]) -> Vector:
    """Give the state at power-on: nothing is there (TOUCH_HEADER + n THING_STATE,)."""
    return np.zeros(TOUCH_HEADER + things.shape[0] * THING_STATE)


def largest_rate_rad_s(things: NDArray[np.float64]) -> float:
    """Bound the fastest rate, rad/s, that touching gives the unloaded arm; 0 for an empty table.

    Things that can be there at the same time add up: squares of the springs' rates, and the dampers' rates.
    """
    largest = 0.0
    for onset_s in things[:, ONSET_S]:
        there = things[(things[:, ONSET_S] <= onset_s) & (things[:, END_S] > onset_s)]
        largest = max(
            largest, math.sqrt(float(np.sum(there[:, STIFF_RATE] ** 2))), float(np.sum(there[:, DAMPED_RATE]))
        )
    return largest


def touch_substeps(things: NDArray[np.float64]) -> int:
    """Say into how many steps a tick of 100 µs must be cut for classical RK4."""
    return max(1, math.ceil(largest_rate_rad_s(things) * TICK_S / _LARGEST_TURN_RAD))


@compiled
def _cosines(q1: float, q2: float) -> tuple[float, float, float, float]:
    """Give the pose that the functions below take: cosine and sine of the angle of link 1, then of link 2."""
    return math.cos(q1), math.sin(q1), math.cos(q1 + q2), math.sin(q1 + q2)


@compiled
def _moved_point(
    link: float, point_m: float, length1_m: float, pose: Pose, dq1: float, dq2: float
) -> tuple[float, float, float, float]:
    """Give a link's point in the world: x, y in m and their rates in m/s."""
    c1, s1, c2, s2 = pose
    reach_m = length1_m if link == 2.0 else point_m
    x, y = reach_m * c1, reach_m * s1
    dx, dy = -y * dq1, x * dq1
    if link == 2.0:
        ahead_x, ahead_y = point_m * c2, point_m * s2
        x += ahead_x
        y += ahead_y
        dx -= ahead_y * (dq1 + dq2)
        dy += ahead_x * (dq1 + dq2)
    return x, y, dx, dy


@compiled
def _joint_torque(
    link: float, point_m: float, force_x: float, force_y: float, length1_m: float, pose: Pose
) -> tuple[float, float]:
    """Give Jᵀ F of a force on a link's point, Nm."""
    c1, s1, c2, s2 = pose
    if link == 2.0:
        torque2 = point_m * (force_y * c2 - force_x * s2)
        return torque2 + length1_m * (force_y * c1 - force_x * s1), torque2
    return point_m * (force_y * c1 - force_x * s1), 0.0


@compiled
def _meet(thing: Vector, own: Vector, pose: Pose) -> tuple[float, float, float, float, float]:
    """Say where a body's link meets it: penetration and point along the link in m, normal x, y, distance across in m.

    The normal points from the link to the body; the last is the signed distance of its centre from the link's line.
    """
    along_x, along_y, link2_x, link2_y = pose
    length_m = thing[LENGTH1_M]
    off_x = thing[X_M] + own[SHIFT] * own[FREE_X]
    off_y = thing[Y_M] + own[SHIFT] * own[FREE_Y]
    if thing[LINK] == 2.0:
        off_x -= length_m * along_x
        off_y -= length_m * along_y
        length_m, along_x, along_y = thing[LENGTH2_M], link2_x, link2_y
    point_m = off_x * along_x + off_y * along_y
    across_m = off_y * along_x - off_x * along_y
    if 0.0 <= point_m <= length_m:
        side = own[SIDE]
        return thing[RADIUS_M] - side * across_m, point_m, -side * along_y, side * along_x, across_m
    end_m = 0.0 if point_m < 0.0 else length_m
    off_x -= end_m * along_x
    off_y -= end_m * along_y
    distance_m = math.hypot(off_x, off_y)
    return thing[RADIUS_M] - distance_m, end_m, off_x / distance_m, off_y / distance_m, across_m


@compiled
def _recede_rate(thing: Vector, own: Vector) -> float:
    """Give the velocity of a body along its free direction, m/s: none into the wall behind it.

    What its speed ṡ gathers against the wall within a tick is taken away between ticks.
    """
    if own[SHIFT] >= thing[ROOM_M] and own[SHIFT_RATE] > 0.0:
        return 0.0
    return float(own[SHIFT_RATE])


@compiled
def _body_force(thing: Vector, own: Vector, pose: Pose, dq1: float, dq2: float) -> tuple[float, float, float, float]:
    """Give a body's force on the arm, N, as x and y, its point in m, and the penetration in m."""
    depth_m, point_m, normal_x, normal_y, _ = _meet(thing, own, pose)
    if depth_m <= 0.0:
        return 0.0, 0.0, point_m, depth_m
    _, _, dx, dy = _moved_point(thing[LINK], point_m, thing[LENGTH1_M], pose, dq1, dq2)
    recede = _recede_rate(thing, own)
    rate = normal_x * (dx - recede * own[FREE_X]) + normal_y * (dy - recede * own[FREE_Y])
    force = max(0.0, thing[STIFFNESS] * depth_m + thing[DAMPING] * rate)
    return -force * normal_x, -force * normal_y, point_m, depth_m


@compiled
def _hand_force(thing: Vector, own: Vector, time_s: float, pose: Pose, dq1: float, dq2: float) -> tuple[float, float]:
    """Give a hand's force on the arm, N, as x and y."""
    x, y, dx, dy = _moved_point(thing[LINK], thing[POINT_M], thing[LENGTH1_M], pose, dq1, dq2)
    way_m = thing[SPEED] * (time_s - thing[ONSET_S])
    speed = thing[SPEED]
    if way_m >= own[PATH_LENGTH]:
        way_m, speed = own[PATH_LENGTH], 0.0
    force_x = thing[STIFFNESS] * (own[START_X] + way_m * own[PATH_X] - x) + thing[DAMPING] * (speed * own[PATH_X] - dx)
    force_y = thing[STIFFNESS] * (own[START_Y] + way_m * own[PATH_Y] - y) + thing[DAMPING] * (speed * own[PATH_Y] - dy)
    size = math.sqrt(force_x * force_x + force_y * force_y)
    if size > thing[FORCE_LIMIT]:
        force_x *= thing[FORCE_LIMIT] / size
        force_y *= thing[FORCE_LIMIT] / size
    return force_x, force_y


@compiled
def _wall_force(
    thing: Vector, own: Vector, link: float, pose: Pose, dq1: float, dq2: float
) -> tuple[float, float, float, float]:
    """Give a wall's force on the end of a link, N, as x and y, the end's place on its link and the penetration in m."""
    point_m = thing[LENGTH2_M] if link == 2.0 else thing[LENGTH1_M]
    x, y, dx, dy = _moved_point(link, point_m, thing[LENGTH1_M], pose, dq1, dq2)
    normal_x, normal_y = own[FREE_X], own[FREE_Y]
    depth_m = -(x - thing[X_M]) * normal_x - (y - thing[Y_M]) * normal_y
    if depth_m <= 0.0:
        return 0.0, 0.0, point_m, depth_m
    rate = -dx * normal_x - dy * normal_y
    force = thing[STIFFNESS] * depth_m * max(0.0, 1.0 + thing[DAMPING] * rate)
    return force * normal_x, force * normal_y, point_m, depth_m


@compiled
def touch(
    things: NDArray[np.float64],
    time_s: float,
    q1: float,
    q2: float,
    dq1: float,
    dq2: float,
    state: Vector,
    rates_out: Vector,
) -> tuple[float, float]:
    """Give the external torque of all bodies, hands and walls, Nm, and fill the rates of their state.

    time_s: scenario time. Changes nothing but rates_out, and not even that when the table is empty: an integrator may
    call it at any stage of a step.
    """
    torque1, torque2 = 0.0, 0.0
    if things.shape[0] == 0:
        return torque1, torque2
    rates_out[:] = 0.0
    pose = _cosines(q1, q2)
    for row in range(things.shape[0]):
        place = TOUCH_HEADER + row * THING_STATE
        if state[place + PRESENCE] != _PRESENT:
            continue
        thing = things[row]
        own = state[place : place + THING_STATE]
        length1_m = thing[LENGTH1_M]
        if thing[KIND] == BODY:
            force_x, force_y, point_m, _ = _body_force(thing, own, pose, dq1, dq2)
            gain1, gain2 = _joint_torque(thing[LINK], point_m, force_x, force_y, length1_m, pose)
            rates_out[place + SHIFT] = _recede_rate(thing, own)
            rates_out[place + SHIFT_RATE] = -(force_x * own[FREE_X] + force_y * own[FREE_Y]) / thing[MASS]
        elif thing[KIND] == HAND:
            force_x, force_y = _hand_force(thing, own, time_s, pose, dq1, dq2)
            gain1, gain2 = _joint_torque(thing[LINK], thing[POINT_M], force_x, force_y, length1_m, pose)
        else:
            force_x, force_y, point_m, _ = _wall_force(thing, own, 1.0, pose, dq1, dq2)
            gain1, gain2 = _joint_torque(1.0, point_m, force_x, force_y, length1_m, pose)
            torque1 += gain1
            force_x, force_y, point_m, _ = _wall_force(thing, own, 2.0, pose, dq1, dq2)
            gain1, gain2 = _joint_torque(2.0, point_m, force_x, force_y, length1_m, pose)
        torque1 += gain1
        torque2 += gain2
    rates_out[ENERGY] = -torque1 * dq1 - torque2 * dq2
    return torque1, torque2


@compiled
def _appear(thing: Vector, own: Vector, pose: Pose) -> None:
    """Put a thing in place, unless the arm is there; a hand remembers where the point is."""
    if thing[KIND] == HAND:
        own[START_X], own[START_Y], _, _ = _moved_point(thing[LINK], thing[POINT_M], thing[LENGTH1_M], pose, 0.0, 0.0)
        own[PATH_X], own[PATH_Y], own[PATH_LENGTH] = 0.0, 0.0, np.inf
        if not math.isnan(thing[ANGLE_RAD]):
            own[PATH_X], own[PATH_Y] = math.cos(thing[ANGLE_RAD]), math.sin(thing[ANGLE_RAD])
        elif not math.isnan(thing[X_M]):
            way_x, way_y = thing[X_M] - own[START_X], thing[Y_M] - own[START_Y]
            own[PATH_LENGTH] = math.sqrt(way_x * way_x + way_y * way_y)
            if own[PATH_LENGTH] > 0.0:
                own[PATH_X], own[PATH_Y] = way_x / own[PATH_LENGTH], way_y / own[PATH_LENGTH]
        own[PRESENCE] = _PRESENT
    elif thing[KIND] == WALL:
        own[FREE_X], own[FREE_Y] = math.cos(thing[ANGLE_RAD]), math.sin(thing[ANGLE_RAD])
        _, _, _, depth1_m = _wall_force(thing, own, 1.0, pose, 0.0, 0.0)
        _, _, _, depth2_m = _wall_force(thing, own, 2.0, pose, 0.0, 0.0)
        if depth1_m <= 0.0 and depth2_m <= 0.0:
            own[PRESENCE] = _PRESENT
    else:
        _, _, _, _, across_m = _meet(thing, own, pose)
        own[SIDE] = 1.0 if across_m >= 0.0 else -1.0
        depth_m, _, _, _, _ = _meet(thing, own, pose)
        if depth_m <= 0.0:
            own[PRESENCE] = _PRESENT
            if not math.isnan(thing[ANGLE_RAD]):
                own[FREE_X], own[FREE_Y] = math.cos(thing[ANGLE_RAD]), math.sin(thing[ANGLE_RAD])


@compiled
def _settle_body(thing: Vector, own: Vector, pose: Pose) -> bool:
    """Do what happens to a body between ticks; say whether it is touched."""
    if own[SHIFT] >= thing[ROOM_M] and own[SHIFT_RATE] > 0.0:
        own[SHIFT_RATE] = 0.0
    depth_m, point_m, normal_x, normal_y, across_m = _meet(thing, own, pose)
    if depth_m > 0.0:
        return True
    length_m = thing[LENGTH2_M] if thing[LINK] == 2.0 else thing[LENGTH1_M]
    if point_m in (0.0, length_m):
        own[SIDE] = 1.0 if across_m >= 0.0 else -1.0
    if math.isnan(thing[ANGLE_RAD]) and own[SHIFT] == 0.0 and own[SHIFT_RATE] == 0.0:
        own[FREE_X], own[FREE_Y] = normal_x, normal_y
    return False


@compiled
def change_touch(
    things: NDArray[np.float64], time_s: float, q1: float, q2: float, state: Vector, is_prescribed: bool
) -> None:
    """Do what changes between ticks: things come and go, hands grasp, a body stops at its wall, the energy restarts.

    Call it at the start of each tick and before `describe_touch`; twice at the same instant is once. is_prescribed:
    whether a prescribed contact is in force. The free direction of a body that has not moved turns with the normal.
    """
    is_touched = is_prescribed
    pose = _cosines(q1, q2)
    for row in range(things.shape[0]):
        place = TOUCH_HEADER + row * THING_STATE
        own = state[place : place + THING_STATE]
        thing = things[row]
        if own[PRESENCE] == _GONE:
            continue
        if time_s > thing[END_S] - _HALF_TICK_S:
            own[PRESENCE] = _GONE
            continue
        if own[PRESENCE] == _WAITING and time_s > thing[ONSET_S] - _HALF_TICK_S:
            _appear(thing, own, pose)
        if own[PRESENCE] != _PRESENT:
            continue
        if thing[KIND] == HAND:
            is_touched = True
        elif thing[KIND] == BODY:
            is_touched = _settle_body(thing, own, pose) or is_touched
        else:
            _, _, _, depth1_m = _wall_force(thing, own, 1.0, pose, 0.0, 0.0)
            _, _, _, depth2_m = _wall_force(thing, own, 2.0, pose, 0.0, 0.0)
            is_touched = is_touched or depth1_m > 0.0 or depth2_m > 0.0
    if not is_touched:
        state[ENERGY] = 0.0


@compiled
def _note(out: Vector, force_x: float, force_y: float, link: float, index: float) -> None:
    """Keep the strongest force."""
    size = math.sqrt(force_x * force_x + force_y * force_y)
    if out[STRONGEST_INDEX] < 0.0 or size > out[FORCE]:
        out[FORCE], out[STRONGEST_LINK], out[STRONGEST_INDEX] = size, link, index


@compiled
def describe_touch(
    things: NDArray[np.float64],
    time_s: float,
    q1: float,
    q2: float,
    dq1: float,
    dq2: float,
    state: Vector,
    contact: Vector,
    contact_index: float,
    elapsed_s: float,
    length1_m: float,
    out: Vector,
) -> tuple[float, float]:
    """Fill force, link, index, power and energy (TOUCH_TRUTH,); give the external torque of all that touches, Nm.

    contact, contact_index, elapsed_s: the prescribed contact in force, an empty row for none.
    """
    out[FORCE], out[STRONGEST_LINK], out[STRONGEST_INDEX] = 0.0, 0.0, -1.0
    torque1, torque2 = 0.0, 0.0
    if contact.size != 0:
        force = contact_force(contact, elapsed_s)
        torque1, torque2 = contact_torque(contact, force, length1_m, q1, q2)
        _note(out, force, 0.0, contact[CONTACT_LINK], contact_index)
    pose = _cosines(q1, q2)
    for row in range(things.shape[0]):
        place = TOUCH_HEADER + row * THING_STATE
        if state[place + PRESENCE] != _PRESENT:
            continue
        thing = things[row]
        own = state[place : place + THING_STATE]
        for end in (1.0, 2.0):
            link, point_m, depth_m = thing[LINK], thing[POINT_M], 1.0
            if thing[KIND] == WALL:
                link = end
                force_x, force_y, point_m, depth_m = _wall_force(thing, own, link, pose, dq1, dq2)
            elif end == 2.0:
                continue
            elif thing[KIND] == BODY:
                force_x, force_y, point_m, depth_m = _body_force(thing, own, pose, dq1, dq2)
            else:
                force_x, force_y = _hand_force(thing, own, time_s, pose, dq1, dq2)
            if depth_m <= 0.0:
                continue
            gain1, gain2 = _joint_torque(link, point_m, force_x, force_y, length1_m, pose)
            torque1 += gain1
            torque2 += gain2
            _note(out, force_x, force_y, link, thing[INDEX])
    out[POWER] = -torque1 * dq1 - torque2 * dq2
    out[TRUE_ENERGY] = state[ENERGY]
    return torque1, torque2


@compiled
def add_prescribed_work(
    contact: Vector,
    elapsed_s: float,
    step_s: float,
    length1_m: float,
    before1: float,
    before2: float,
    q1: float,
    q2: float,
    state: Vector,
) -> None:
    """Add what the arm gave to a prescribed contact in a step: the mean torque along the way of the joints.

    before1, before2: joint positions at the start of the step, at elapsed_s; q1, q2: at its end. An empty row adds
    nothing.
    """
    if contact.size == 0:
        return
    torque1, torque2 = contact_torque(contact, contact_force(contact, elapsed_s), length1_m, before1, before2)
    after1, after2 = contact_torque(contact, contact_force(contact, elapsed_s + step_s), length1_m, q1, q2)
    state[ENERGY] -= 0.5 * ((torque1 + after1) * (q1 - before1) + (torque2 + after2) * (q2 - before2))
