"""What touches the arm as a table for compiled code: bodies, hands and walls, and how fast they make the arm swing."""

import math
from typing import Final

import numpy as np

from adacd_hil.compiled import Structured
from adacd_hil.records import Vector
from firmware_sim.arm.arms import ArmProfile
from firmware_sim.arm.scripted_contact import TICK_S, ticks
from firmware_sim.arm.touch_forces import BODY, HAND, THING, THING_PLACES, TOUCH_HEADER, WALL
from firmware_sim.arm.touch_settings import BodySettings, HandSettings, WallSettings
from firmware_sim.scenario.scenario import Scenario

_POSES: Final = 181
_POINTS: Final = 61
"""Grid on which the smallest effective mass of the arm is searched: 1° of the elbow, 1/60 of the link."""
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


def _row(kind: int, arm: ArmProfile, thing: BodySettings | HandSettings | WallSettings) -> np.void:
    """Fill the columns that all things have."""
    row: np.void = np.full(THING.itemsize // 8, np.nan).view(THING)[0]
    row["kind"] = kind
    row["onset_s"] = ticks(thing.at_s) * TICK_S
    row["end_s"] = math.inf if thing.duration_s is None else (ticks(thing.at_s) + ticks(thing.duration_s)) * TICK_S
    row["length1_m"], row["length2_m"] = arm.link_length_m
    return row


def _body_row(arm: ArmProfile, body: BodySettings) -> np.void:
    row = _row(BODY, arm, body)
    row["link"], row["x_m"], row["y_m"] = body.link, body.x_m, body.y_m
    row["stiffness"], row["damping"], row["mass_kg"] = body.stiffness, body.damping_N_s_m, body.mass
    row["radius_m"], row["room_m"] = body.radius_m, body.room_m
    row["angle_rad"] = math.nan if body.free_deg is None else math.radians(body.free_deg)
    points_m = np.linspace(0.0, arm.link_length_m[body.link - 1], _POINTS)
    mobility = _largest_mobility(arm, body.link, points_m) + 1.0 / body.mass
    row["stiff_rate_rad_s"] = math.sqrt(body.stiffness * mobility)
    row["damped_rate_1_s"] = body.damping_N_s_m * mobility
    return row


def _hand_row(arm: ArmProfile, hand: HandSettings) -> np.void:
    row = _row(HAND, arm, hand)
    row["link"], row["point_m"] = hand.link, hand.point_m
    row["force_limit_N"], row["speed_m_s"] = hand.force_limit_N, hand.speed_m_s
    row["stiffness"], row["damping"] = hand.stiffness_N_m, hand.damping_N_s_m
    if hand.move_to_m is not None:
        row["x_m"], row["y_m"] = hand.move_to_m
    if hand.direction_deg is not None:
        row["angle_rad"] = math.radians(hand.direction_deg)
    mobility = _largest_mobility(arm, hand.link, np.array([hand.point_m]))
    row["stiff_rate_rad_s"] = math.sqrt(hand.stiffness_N_m * mobility)
    row["damped_rate_1_s"] = hand.damping_N_s_m * mobility
    return row


def _wall_row(arm: ArmProfile, wall: WallSettings) -> np.void:
    row = _row(WALL, arm, wall)
    row["x_m"], row["y_m"], row["angle_rad"] = wall.x_m, wall.y_m, math.radians(wall.normal_deg)
    row["stiffness"], row["damping"] = wall.stiffness_N_m, wall.damping_s_m
    mobility = max(_largest_mobility(arm, link, np.array([arm.link_length_m[link - 1]])) for link in (1, 2))
    row["stiff_rate_rad_s"] = math.sqrt(wall.stiffness_N_m * mobility)
    # ∂F/∂δ̇ = K χ δ is largest at the deepest point of a blow with v, about v/√(K/μ).
    row["damped_rate_1_s"] = row["stiff_rate_rad_s"] * wall.damping_s_m * _FASTEST_BLOW_M_S
    return row


def touch_table(scenario: Scenario) -> Structured:
    """Pack a scenario's bodies, hands and walls (n,), with the fields of THING; n = 0 when it has none."""
    arm = scenario.arm
    rows = [_body_row(arm, body) for body in scenario.bodies]
    rows += [_hand_row(arm, hand) for hand in scenario.hands]
    rows += [_wall_row(arm, wall) for wall in scenario.walls]
    table = np.array(rows, dtype=THING)
    table["index"] = len(scenario.contacts) + np.arange(len(rows))
    return table


def initial_touch_state(things: Structured) -> Vector:
    """Give the state at power-on: nothing is there (TOUCH_HEADER + n THING_PLACES,)."""
    return np.zeros(TOUCH_HEADER + things.size * THING_PLACES)


def largest_rate_rad_s(things: Structured) -> float:
    """Bound the fastest rate, rad/s, that touching gives the unloaded arm; 0 for an empty table.

    Things that can be there at the same time add up: squares of the springs' rates, and the dampers' rates.
    """
    largest = 0.0
    for onset_s in things["onset_s"]:
        there = things[(things["onset_s"] <= onset_s) & (things["end_s"] > onset_s)]
        largest = max(
            largest, math.sqrt(float(np.sum(there["stiff_rate_rad_s"] ** 2))), float(np.sum(there["damped_rate_1_s"]))
        )
    return largest
