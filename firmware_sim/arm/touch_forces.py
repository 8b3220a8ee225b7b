"""Forces between the arm and bodies, hands and walls: penalty contacts with state, for the integrator of the arm.

The arm is seen as the axes of its links. Each thing of a scenario is a row of the touch table; together they have one
state vector: the energy, then THING_PLACES places per row. Things never touch each other.

    body   F = max(0, K δ + c δ̇) along the normal n from the link to the body, at the point nearest to its centre.
           δ is the penetration. The body moves in its free direction u: m ṡ̇ = F n·u, s = 0 where it stands. Its
           wall, if any, takes the force as soon as s reaches the room; its kinetic energy is then lost.
    hand   F = K (p_d − p) + c (ṗ_d − ṗ), never larger than its limit; p_d moves from where p was when it grasped.
    wall   F = K δ max(0, 1 + χ δ̇) along its normal, at the elbow (end of link 1) and at the tip (end of link 2)

Bodies and walls only push; only a hand can pull. The two-mass model is that of ISO/TS 15066:2016 Annex A; the damping
of a wall is that of Hunt and Crossley 1975, which has no step at the first touch and no pull at separation.

A body or wall is put in place at its time, or as soon after it as the arm is not where it is to stand. A body's side
of the link is decided there and whenever it is off the end of the link, so deep penetration never throws it through.

Power and energy count from the arm: −τᵀ q̇ of all touches, prescribed contacts included, and its integral
since the arm was last untouched.
"""

import math
from typing import Final

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.structured import Structured, float_fields
from firmware_sim.arm.touch_settings import TICK_S, aim, contact_force, contact_torque

BODY: Final = 0
HAND: Final = 1
WALL: Final = 2

THING: Final = float_fields(
    {
        "kind": (),  # BODY, HAND, WALL
        "index": (),  # in the order contacts, bodies, hands, walls
        "onset_s": (),  # on the 100 µs grid
        "end_s": (),  # inf: never
        "link": (),
        "length1_m": (),
        "length2_m": (),
        "x_m": (),  # body: centre; hand: where it guides to; wall: a point of it
        "y_m": (),
        "angle_rad": (),  # body: free direction, nan for the normal; hand: direction, nan without one; wall: normal
        "stiffness": (),  # N/m
        "damping": (),  # body, hand: N s/m; wall: s/m
        "mass_kg": (),  # body
        "radius_m": (),  # body
        "room_m": (),  # body: how far it can recede
        "point_m": (),  # hand
        "force_limit_N": (),  # hand
        "speed_m_s": (),  # hand
        "stiff_rate_rad_s": (),  # largest √(K/μ) against the unloaded arm in any pose
        "damped_rate_1_s": (),  # largest c/μ
    }
)
"""One row of a touch table, in the order bodies, hands, walls."""

# Places in the touch state, which an integrator carries on as a whole: the energy, then each thing's part.
ENERGY: Final = 0  # J
TOUCH_HEADER: Final = 1

THING_STATE: Final = float_fields(
    {
        "presence": (),  # one of the three below
        "shift_m": (),  # body: s
        "shift_rate_m_s": (),  # body: ṡ
        "free_x": (),  # body: u; wall: normal; hand: direction of its way, 0, 0 without one
        "free_y": (),
        "side": (),  # body: +1 on the side of +q of its link, else −1
        "start_x_m": (),  # hand: where it grasped, m
        "start_y_m": (),
        "path_length_m": (),  # hand: of its way, inf for no end
    }
)
"""A thing's part of the touch state."""
THING_PLACES: Final = THING_STATE.itemsize // 8

Pose = tuple[float, float, float, float]
"""Cosine and sine of the angle of link 1, cosine and sine of the angle of link 2."""

_WAITING: Final = 0.0
_PRESENT: Final = 1.0
_GONE: Final = 2.0
_HALF_TICK_S: Final = 0.5 * TICK_S

TOUCH_TRUTH: Final = float_fields(
    {
        "force_N": (),  # the strongest force
        "link": (),  # 0 without contact
        "index": (),  # −1 without contact
        "power_W": (),
        "energy_J": (),
    }
)
"""Filled by `describe_touch`."""


@compiled
def _own(state: Vector, row: int) -> np.void:
    """Return the values of a thing in the touch state, or in its rates, as a writable view.

    row: its row in the touch table.
    """
    place = TOUCH_HEADER + row * THING_PLACES
    part: np.void = state[place : place + THING_PLACES].view(THING_STATE)[0]
    return part


@compiled
def _cosines(q1: float, q2: float) -> tuple[float, float, float, float]:
    """Return the pose for the functions below: cosine and sine of link 1's angle q1, then of link 2's, q1 + q2."""
    return math.cos(q1), math.sin(q1), math.cos(q1 + q2), math.sin(q1 + q2)


@compiled
def _moved_point(
    link: float, point_m: float, length1_m: float, pose: Pose, dq1: float, dq2: float
) -> tuple[float, float, float, float]:
    """Return x, y, m, of a link's point in the world, and their rates, m/s.

    point_m: distance from the joint that carries the link.
    """
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
    """Return the torques of both joints, Nm, of a force on a link's point, Jᵀ F. force: N, in the world.

    point_m: distance from the joint that carries the link.
    """
    c1, s1, c2, s2 = pose
    if link == 2.0:
        torque2 = point_m * (force_y * c2 - force_x * s2)
        return torque2 + length1_m * (force_y * c1 - force_x * s1), torque2
    return point_m * (force_y * c1 - force_x * s1), 0.0


@compiled
def _meet(thing: np.void, own: np.void, pose: Pose) -> tuple[float, float, float, float, float]:
    """Return how a body meets its link: penetration and point along the link, m; normal x, y; distance across, m.

    The penetration is negative while they are apart. The normal points from the link to the body, between the ends of
    the link on the stored side; a body beyond an end meets that end. The last is the signed distance of the body's
    centre from the link's line. thing, own: the body's row of the touch table, and its part of the touch state.
    """
    along_x, along_y, link2_x, link2_y = pose
    length_m = thing["length1_m"]
    off_x = thing["x_m"] + own["shift_m"] * own["free_x"]
    off_y = thing["y_m"] + own["shift_m"] * own["free_y"]
    if thing["link"] == 2.0:
        off_x -= length_m * along_x
        off_y -= length_m * along_y
        length_m, along_x, along_y = thing["length2_m"], link2_x, link2_y
    point_m = off_x * along_x + off_y * along_y
    across_m = off_y * along_x - off_x * along_y
    if 0.0 <= point_m <= length_m:
        side = own["side"]
        return thing["radius_m"] - side * across_m, point_m, -side * along_y, side * along_x, across_m
    end_m = 0.0 if point_m < 0.0 else length_m
    off_x -= end_m * along_x
    off_y -= end_m * along_y
    distance_m = math.hypot(off_x, off_y)
    return thing["radius_m"] - distance_m, end_m, off_x / distance_m, off_y / distance_m, across_m


@compiled
def _recede_rate(thing: np.void, own: np.void) -> float:
    """Return a body's velocity along its free direction, m/s; 0 if it would move into the wall behind it.

    The stored velocity stays until `_settle_body` resets it. thing, own: the body's row of the touch table, and its
    part of the touch state.
    """
    if own["shift_m"] >= thing["room_m"] and own["shift_rate_m_s"] > 0.0:
        return 0.0
    return float(own["shift_rate_m_s"])


@compiled
def _body_force(thing: np.void, own: np.void, pose: Pose, dq1: float, dq2: float) -> tuple[float, float, float, float]:
    """Return a body's force on the arm, N, as x and y, its point on the link and the penetration, both in m.

    Without penetration (0 or negative) the force is 0. thing, own: the body's row of the touch table, and its part of
    the touch state.
    """
    depth_m, point_m, normal_x, normal_y, _ = _meet(thing, own, pose)
    if depth_m <= 0.0:
        return 0.0, 0.0, point_m, depth_m
    _, _, dx, dy = _moved_point(thing["link"], point_m, thing["length1_m"], pose, dq1, dq2)
    recede = _recede_rate(thing, own)
    rate = normal_x * (dx - recede * own["free_x"]) + normal_y * (dy - recede * own["free_y"])
    force = max(0.0, thing["stiffness"] * depth_m + thing["damping"] * rate)
    return -force * normal_x, -force * normal_y, point_m, depth_m


@compiled
def _hand_force(thing: np.void, own: np.void, time_s: float, pose: Pose, dq1: float, dq2: float) -> tuple[float, float]:
    """Return a hand's force on the arm, N, as x and y, limited to `force_limit_N`.

    own: the hand's part of the touch state: where it grasped, and its way. time_s: scenario time, which gives how far
    the hand has moved.
    """
    x, y, dx, dy = _moved_point(thing["link"], thing["point_m"], thing["length1_m"], pose, dq1, dq2)
    way_m = thing["speed_m_s"] * (time_s - thing["onset_s"])
    speed = thing["speed_m_s"]
    if way_m >= own["path_length_m"]:
        way_m, speed = own["path_length_m"], 0.0
    force_x = thing["stiffness"] * (own["start_x_m"] + way_m * own["free_x"] - x) + thing["damping"] * (
        speed * own["free_x"] - dx
    )
    force_y = thing["stiffness"] * (own["start_y_m"] + way_m * own["free_y"] - y) + thing["damping"] * (
        speed * own["free_y"] - dy
    )
    size = math.sqrt(force_x * force_x + force_y * force_y)
    if size > thing["force_limit_N"]:
        force_x *= thing["force_limit_N"] / size
        force_y *= thing["force_limit_N"] / size
    return force_x, force_y


@compiled
def _wall_force(
    thing: np.void, own: np.void, link: float, pose: Pose, dq1: float, dq2: float
) -> tuple[float, float, float, float]:
    """Return a wall's force on the end of a link, N, as x and y, the link's length and the penetration, both in m.

    In front of the wall the force is 0 and the penetration negative. own: the wall's part of the touch state, with its
    normal toward the free side.
    """
    point_m = thing["length2_m"] if link == 2.0 else thing["length1_m"]
    x, y, dx, dy = _moved_point(link, point_m, thing["length1_m"], pose, dq1, dq2)
    normal_x, normal_y = own["free_x"], own["free_y"]
    depth_m = -(x - thing["x_m"]) * normal_x - (y - thing["y_m"]) * normal_y
    if depth_m <= 0.0:
        return 0.0, 0.0, point_m, depth_m
    rate = -dx * normal_x - dy * normal_y
    force = thing["stiffness"] * depth_m * max(0.0, 1.0 + thing["damping"] * rate)
    return force * normal_x, force * normal_y, point_m, depth_m


@compiled
def touch(
    things: Structured,
    time_s: float,
    q1: float,
    q2: float,
    dq1: float,
    dq2: float,
    state: Vector,
    rates_out: Vector,
) -> tuple[float, float]:
    """Return the external torque of the bodies, hands and walls that are present, Nm, and fill the touch state's rates.

    things: table of all. state: touch state. time_s: scenario time. Writes only rates_out, and leaves even that
    unchanged for an empty table: an integrator may call it at any stage of a step.
    """
    torque1, torque2 = 0.0, 0.0
    if things.shape[0] == 0:
        return torque1, torque2
    rates_out[:] = 0.0
    pose = _cosines(q1, q2)
    for row in range(things.shape[0]):
        thing, own = things[row], _own(state, row)
        if own["presence"] != _PRESENT:
            continue
        length1_m = thing["length1_m"]
        if thing["kind"] == BODY:
            force_x, force_y, point_m, _ = _body_force(thing, own, pose, dq1, dq2)
            gain1, gain2 = _joint_torque(thing["link"], point_m, force_x, force_y, length1_m, pose)
            rates = _own(rates_out, row)
            rates["shift_m"] = _recede_rate(thing, own)
            rates["shift_rate_m_s"] = -(force_x * own["free_x"] + force_y * own["free_y"]) / thing["mass_kg"]
        elif thing["kind"] == HAND:
            force_x, force_y = _hand_force(thing, own, time_s, pose, dq1, dq2)
            gain1, gain2 = _joint_torque(thing["link"], thing["point_m"], force_x, force_y, length1_m, pose)
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
def _appear(thing: np.void, own: np.void, pose: Pose) -> None:
    """Set a body, hand or wall as present, a body or wall only if the arm isn't in its place.

    Store where a hand grasps and the way that it guides, a body's side and given free direction, or a wall's normal,
    in its part of the touch state, `own`.
    """
    if thing["kind"] == HAND:
        own["start_x_m"], own["start_y_m"], _, _ = _moved_point(
            thing["link"], thing["point_m"], thing["length1_m"], pose, 0.0, 0.0
        )
        own["free_x"], own["free_y"], own["path_length_m"] = 0.0, 0.0, np.inf
        if not math.isnan(thing["angle_rad"]):
            own["free_x"], own["free_y"] = math.cos(thing["angle_rad"]), math.sin(thing["angle_rad"])
        elif not math.isnan(thing["x_m"]):
            way_x, way_y = thing["x_m"] - own["start_x_m"], thing["y_m"] - own["start_y_m"]
            own["path_length_m"] = math.sqrt(way_x * way_x + way_y * way_y)
            if own["path_length_m"] > 0.0:
                own["free_x"], own["free_y"] = way_x / own["path_length_m"], way_y / own["path_length_m"]
        own["presence"] = _PRESENT
    elif thing["kind"] == WALL:
        own["free_x"], own["free_y"] = math.cos(thing["angle_rad"]), math.sin(thing["angle_rad"])
        _, _, _, depth1_m = _wall_force(thing, own, 1.0, pose, 0.0, 0.0)
        _, _, _, depth2_m = _wall_force(thing, own, 2.0, pose, 0.0, 0.0)
        if depth1_m <= 0.0 and depth2_m <= 0.0:
            own["presence"] = _PRESENT
    else:
        _, _, _, _, across_m = _meet(thing, own, pose)
        own["side"] = 1.0 if across_m >= 0.0 else -1.0
        depth_m, _, _, _, _ = _meet(thing, own, pose)
        if depth_m <= 0.0:
            own["presence"] = _PRESENT
            if not math.isnan(thing["angle_rad"]):
                own["free_x"], own["free_y"] = math.cos(thing["angle_rad"]), math.sin(thing["angle_rad"])


@compiled
def _settle_body(thing: np.void, own: np.void, pose: Pose) -> bool:
    """Stop a body that has reached the wall behind it, and return whether the arm touches the body.

    While it doesn't touch: update the side of a body off the link's end, and the free direction of a body that has not
    moved. thing, own: the body's row of the touch table, and its part of the touch state.
    """
    if own["shift_m"] >= thing["room_m"] and own["shift_rate_m_s"] > 0.0:
        own["shift_rate_m_s"] = 0.0
    depth_m, point_m, normal_x, normal_y, across_m = _meet(thing, own, pose)
    if depth_m > 0.0:
        return True
    length_m = thing["length2_m"] if thing["link"] == 2.0 else thing["length1_m"]
    if point_m in (0.0, length_m):
        own["side"] = 1.0 if across_m >= 0.0 else -1.0
    if math.isnan(thing["angle_rad"]) and own["shift_m"] == 0.0 and own["shift_rate_m_s"] == 0.0:
        own["free_x"], own["free_y"] = normal_x, normal_y
    return False


@compiled
def change_touch(things: Structured, time_s: float, q1: float, q2: float, state: Vector, is_prescribed: bool) -> None:
    """Apply the changes between ticks to the touch state: bodies, hands, walls come and go, a body stops at its wall.

    A body or wall whose place the arm occupies comes as soon as the place is free. The energy is set to 0 while nothing
    touches the arm. Call it at the start of each tick and before `describe_touch`; a second call at the same instant
    changes nothing. is_prescribed: whether a scripted contact acts. The free direction of a body that has not moved
    turns with the normal, unless its row gives one.
    """
    is_touched = is_prescribed
    pose = _cosines(q1, q2)
    for row in range(things.shape[0]):
        thing, own = things[row], _own(state, row)
        if own["presence"] == _GONE:
            continue
        if time_s > thing["end_s"] - _HALF_TICK_S:
            own["presence"] = _GONE
            continue
        if own["presence"] == _WAITING and time_s > thing["onset_s"] - _HALF_TICK_S:
            _appear(thing, own, pose)
        if own["presence"] != _PRESENT:
            continue
        if thing["kind"] == HAND:
            is_touched = True
        elif thing["kind"] == BODY:
            is_touched = _settle_body(thing, own, pose) or is_touched
        else:
            _, _, _, depth1_m = _wall_force(thing, own, 1.0, pose, 0.0, 0.0)
            _, _, _, depth2_m = _wall_force(thing, own, 2.0, pose, 0.0, 0.0)
            is_touched = is_touched or depth1_m > 0.0 or depth2_m > 0.0
    if not is_touched:
        state[ENERGY] = 0.0


@compiled
def _note(out: np.void, force_x: float, force_y: float, link: float, index: float) -> None:
    """Store force, N, link and index of a contact in `out`, of TOUCH_TRUTH, if none or a weaker one is stored."""
    size = math.sqrt(force_x * force_x + force_y * force_y)
    if out["index"] < 0.0 or size > out["force_N"]:
        out["force_N"], out["link"], out["index"] = size, link, index


@compiled
def describe_touch(
    things: Structured,
    time_s: float,
    q1: float,
    q2: float,
    dq1: float,
    dq2: float,
    state: Vector,
    contact: Structured,
    contact_index: float,
    elapsed_s: float,
    length1_m: float,
    out: np.void,
) -> tuple[float, float]:
    """Fill `out`, a record of TOUCH_TRUTH, and return the external torque of all contacts on both joints, Nm.

    Contacts are the scripted one, bodies, hands and walls, not joint stops. `out` has link, index and force of the
    strongest, or 0, -1 and 0 without a contact. contact, contact_index, elapsed_s: the scripted contact that acts, its
    index and the time since its onset; an empty array without one. time_s: scenario time.
    """
    out["force_N"], out["link"], out["index"] = 0.0, 0.0, -1.0
    torque1, torque2 = 0.0, 0.0
    if contact.size != 0:
        force = contact_force(contact[0], elapsed_s)
        torque1, torque2 = contact_torque(contact[0], force, length1_m, q1, q2, dq1, dq2)
        _, size_N = aim(contact[0], force, length1_m, q1, q2, dq1, dq2)
        _note(out, size_N, 0.0, contact[0]["link"], contact_index)
    pose = _cosines(q1, q2)
    for row in range(things.shape[0]):
        thing, own = things[row], _own(state, row)
        if own["presence"] != _PRESENT:
            continue
        for end in (1.0, 2.0):
            link, point_m, depth_m = thing["link"], thing["point_m"], 1.0
            if thing["kind"] == WALL:
                link = end
                force_x, force_y, point_m, depth_m = _wall_force(thing, own, link, pose, dq1, dq2)
            elif end == 2.0:
                continue
            elif thing["kind"] == BODY:
                force_x, force_y, point_m, depth_m = _body_force(thing, own, pose, dq1, dq2)
            else:
                force_x, force_y = _hand_force(thing, own, time_s, pose, dq1, dq2)
            if depth_m <= 0.0:
                continue
            gain1, gain2 = _joint_torque(link, point_m, force_x, force_y, length1_m, pose)
            torque1 += gain1
            torque2 += gain2
            _note(out, force_x, force_y, link, thing["index"])
    out["power_W"] = -torque1 * dq1 - torque2 * dq2
    out["energy_J"] = state[ENERGY]
    return torque1, torque2


@compiled
def add_prescribed_work(
    contact: Structured,
    elapsed_s: float,
    step_s: float,
    length1_m: float,
    before1: float,
    before2: float,
    q1: float,
    q2: float,
    state: Vector,
) -> None:
    """Add to the touch state the energy that the arm gave to a scripted contact in a step, J; no change without one.

    before1, before2: joint positions at the start of the step, elapsed_s after the onset; q1, q2: at its end. A force
    of frame "motion" is aimed by the mean velocity of the step.
    """
    if contact.size == 0:
        return
    way1, way2 = q1 - before1, q2 - before2
    dq1, dq2 = way1 / step_s, way2 / step_s
    begun_N, ended_N = contact_force(contact[0], elapsed_s), contact_force(contact[0], elapsed_s + step_s)
    torque1, torque2 = contact_torque(contact[0], begun_N, length1_m, before1, before2, dq1, dq2)
    after1, after2 = contact_torque(contact[0], ended_N, length1_m, q1, q2, dq1, dq2)
    state[ENERGY] -= 0.5 * ((torque1 + after1) * way1 + (torque2 + after2) * way2)
