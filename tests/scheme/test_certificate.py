"""The evidence for a fit: each part of it can be the one that is missing, and is named."""

import numpy as np
import pytest
from excited_arm import NAMES, SETTINGS, Kernel, kernel_of
from planar_arm import THETA

from adacd_hil.records import PARAMETER_UNITS
from adacd_hil.scheme.identify import termination

K, _ = kernel_of()
FIT = SETTINGS.certified.fit_s
TRAVEL, SPEED = float(K.travel_rad), float(K.velocity_rad_s)


def fitted_arm(**changes):
    """Return the memory of an arm whose evidence is just complete, with some fields changed."""
    _, m = kernel_of()
    m.motion.samples = round(FIT[0] * 1e3)
    m.models.belief[: len(THETA["P"])] = THETA["P"]
    m.models.P_belief[:] = np.diag(np.array(K.enough_std) ** 2 * 0.999)
    m.fit.excitation, m.fit.condition = K.excitation_Nm2s, K.condition
    m.motion.q_low[:], m.motion.q_high[:] = -0.5001 * TRAVEL, 0.5001 * TRAVEL
    m.motion.dq_low[:], m.motion.dq_high[:] = -SPEED, SPEED
    for name, value in changes.items():
        (record,) = (record for record in (m.motion, m.fit, m.models) if name in record.dtype.names)
        record[name] = value
    return m


def missing(m):
    return termination.describe_missing(K, m, NAMES)


def uncertain(name, times):
    j = NAMES.index(name)
    P = np.array(fitted_arm().models.P_belief)
    P[j, j] = (times * K.enough_std[j]) ** 2
    return P


def with_a3(value):
    belief = np.array(fitted_arm().models.belief)
    belief[NAMES.index("a3")] = value
    return belief


def test_an_arm_with_all_the_evidence_is_fitted():
    assert termination.is_complete(K, fitted_arm())
    assert missing(fitted_arm()) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"samples": round(FIT[0] * 1e3) - 1},
        {"q_high": [0.49 * TRAVEL, 0.6 * TRAVEL]},
        {"q_low": [-0.6 * TRAVEL, -0.49 * TRAVEL]},
        {"dq_high": [SPEED, 0.99 * SPEED]},
        {"dq_low": [-0.99 * SPEED, -SPEED]},
        {"excitation": 0.99 * SETTINGS.certified.excitation_Nm2s},
        {"excitation": np.nan},
        {"condition": 1.01 * SETTINGS.certified.condition},
        {"condition": np.inf},
        {"condition": np.nan},
        {"P_belief": uncertain("a2", 1.01)},
        {"P_belief": uncertain("stribeck2", 1.01)},
        {"P_belief": uncertain("offset1", np.nan)},
        {"belief": with_a3(0.0)},
        {"belief": with_a3(np.nan)},
    ],
    ids=str,
)
def test_with_any_part_missing_it_is_not(changes):
    assert not termination.is_complete(K, fitted_arm(**changes))
    assert len(missing(fitted_arm(**changes))) == 1


def test_motion_that_excites_too_little_or_leaves_parameters_alike_is_named_with_value_and_bound():
    first, second = missing(fitted_arm(excitation=1e-5, condition=9.4e5))
    assert first.startswith("the motion excites the parameters by 1e-05 Nm² s, certified.excitation_Nm2s = 5e-05")
    assert second.startswith("the parameters can't be told apart: condition 9.4e+05, certified.condition = 1e+05")


def test_a_mass_matrix_that_is_not_positive_definite_is_named_with_a_payload_too():
    for is_payload in (0.0, 1.0):
        m = fitted_arm(belief=with_a3(-0.01), is_payload=is_payload, samples=10_000)
        assert not termination.is_complete(K, m)
        assert missing(m) == ["the estimated mass matrix is not positive definite: accelerate both joints harder"]


def test_a_payload_needs_neither_travel_nor_excitation_but_certain_parameters():
    unmoved = {"is_payload": 1.0, "q_high": [-np.inf] * 2, "excitation": 0.0, "condition": np.inf}
    samples = round(FIT[1] * 1e3)
    assert termination.is_complete(K, fitted_arm(**unmoved, samples=samples))
    assert not termination.is_complete(K, fitted_arm(**unmoved, samples=samples - 1))
    assert not termination.is_complete(K, fitted_arm(**unmoved, samples=samples, P_belief=uncertain("a1", 1.01)))


def test_before_its_first_sample_an_arm_has_not_travelled_at_all():
    lines = missing(Kernel().m)
    assert "joint 1 has travelled 0.0 deg of 20: move it further" in lines
    assert "joint 2 has moved at 0.0 to 0.0 deg/s, 10 both ways needed: move it back and forth" in lines


def test_a_joint_that_has_moved_too_little_or_one_way_only_is_named_with_the_way_it_lacks():
    lines = missing(fitted_arm(q_low=[np.radians(-3.0), -TRAVEL], q_high=[np.radians(4.5), TRAVEL]))
    lines += missing(fitted_arm(dq_low=[-SPEED, np.radians(2.0)], dq_high=[SPEED, np.radians(30.0)]))
    assert lines == [
        "joint 1 has travelled 7.5 deg of 20: move it further",
        "joint 2 has moved at 0.0 to 30.0 deg/s, 10 both ways needed: move it back and forth",
    ]


@pytest.mark.parametrize("name", NAMES)
def test_a_parameter_that_is_not_known_is_named_with_value_bound_unit_and_motion(name):
    (line,) = missing(fitted_arm(P_belief=uncertain(name, 3.0)))
    enough, unit = K.enough_std[NAMES.index(name)], PARAMETER_UNITS[name]
    assert unit != ""
    known, motion = line.split(" needed: ")
    assert known == f"{name} is known to {3.0 * enough:.3g} {unit}, {enough:.3g}"
    assert f"joint {1 if name == 'a2' else 2 if name == 'a3' else name[-1]} " in motion
