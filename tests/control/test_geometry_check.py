"""What a certificate says of the lengths that the host was told."""

import dataclasses

import pytest

from adacd_hil.control.geometry_check import geometry_event
from adacd_hil.records import Event
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings

LENGTHS = (0.4, 0.25)
MASSES = (2.0, 1.0)


def inertia(l1: float, l2: float) -> tuple[float, float, float]:
    """Return a1, a2, a3 of uniform rods."""
    m1, m2 = MASSES
    a3 = m2 * l2**2 / 3.0
    return m1 * l1**2 / 3.0 + m2 * l1**2 + a3, m2 * l1 * l2 / 2.0, a3


def told(cad: tuple[float, ...], tilt_deg: float = 0.0) -> Settings:
    settings = load_settings("certified")
    estimator, mounting_deg = settings.estimator, None
    if tilt_deg:
        estimator = dataclasses.replace(estimator, gravity=True, P0=(*estimator.P0, 50.0, 50.0))
        mounting_deg, cad = (tilt_deg, -90.0), (*cad, 0.0, 0.0) if cad else ()
    arm = dataclasses.replace(settings.arm, link_length_m=LENGTHS, cad_theta=cad, mounting_deg=mounting_deg)
    return dataclasses.replace(settings, arm=arm, estimator=estimator)


def event_of(settings: Settings, *parameters: float) -> Event | None:
    return geometry_event(settings, Certificate(parameters, (), (), (), (), (), (), False, ""))


FRICTION = (0.03, 0.015, 0.04, 0.02)
CAD = (*inertia(*LENGTHS), 0.0, 0.0, 0.0, 0.0)


def test_lengths_that_agree_with_the_cad_model_are_not_spoken_of() -> None:
    assert event_of(told(CAD), *inertia(*LENGTHS), *FRICTION) is None


@pytest.mark.parametrize(("joint", "factor"), [(1, 1.25), (1, 0.8), (2, 1.25), (2, 0.8)])
def test_a_link_that_is_longer_or_shorter_than_told_is_named(joint: int, factor: float) -> None:
    l1, l2 = LENGTHS
    lengths = (l1 * factor, l2) if joint == 1 else (l1, l2 * factor)
    event = event_of(told(CAD), *inertia(*lengths), *FRICTION)
    assert event is not None
    assert event.level == "warning"
    assert f"as if link {joint} were {lengths[joint - 1]:.3f} m long" in event.message
    assert f"arm.link_length_m[{joint - 1}] = {LENGTHS[joint - 1]:g} m" in event.message


def test_a_cad_model_that_is_off_otherwise_says_nothing_of_lengths() -> None:
    a1, a2, a3 = inertia(*LENGTHS)
    assert event_of(told(CAD), 1.07 * a1, 0.92 * a2, 1.06 * a3, *FRICTION) is None
    assert event_of(told(CAD), a1 + 0.22, a2 + 0.1, a3 + 0.0625, *FRICTION) is None  # 1 kg at the tip


def test_without_a_cad_model_the_lengths_are_told_as_an_assumption() -> None:
    event = event_of(told(()), *inertia(*LENGTHS), *FRICTION)
    assert event is not None
    assert event.message.startswith("assumed: arm.link_length_m = [0.4, 0.25] m")


@pytest.mark.parametrize(
    ("length_m", "said"), [(0.4, None), (0.5, "at 90 deg link 1 is 0.500 m long"), (0.32, "link 1 is 0.320 m long")]
)
def test_gravity_tells_the_length_of_link_1(length_m: float, said: str | None) -> None:
    a5 = MASSES[1] * LENGTHS[1] / 2.0 * 9.80665
    event = event_of(told((), 90.0), *inertia(length_m, LENGTHS[1]), *FRICTION, 3.0, a5)
    assert event is not None
    if said is None:
        assert event.message.startswith("assumed: arm.link_length_m[1] = 0.25 m")
        return
    assert said in event.message
    is_longer = length_m > LENGTHS[0]
    assert event.level == ("info" if is_longer else "warning")
    assert ("is right if the arm moves at 53 deg to the level" in event.message) == is_longer


def test_a_tilt_that_is_told_is_no_longer_link() -> None:
    a5 = MASSES[1] * LENGTHS[1] / 2.0 * 9.80665 * 0.5
    event = event_of(told((), 30.0), *inertia(*LENGTHS), *FRICTION, 3.0, a5)
    assert event is not None
    assert event.message.startswith("assumed: arm.link_length_m[1] = 0.25 m")


@pytest.mark.parametrize(("l1", "l2", "joint"), [(0.4, 0.25, 0), (0.4, 0.3125, 2), (0.5, 0.25, 1)])
def test_masses_tell_both_lengths_of_an_upright_arm_too(l1: float, l2: float, joint: int) -> None:
    a5 = MASSES[1] * l2 / 2.0 * 9.80665
    event = event_of(told(CAD, 90.0), *inertia(l1, l2), *FRICTION, 13.7, a5)
    if joint == 0:
        assert event is None
        return
    assert event is not None
    assert event.level == "warning"
    assert f"as if link {joint} were" in event.message


@pytest.mark.parametrize(("direction", "is_named"), [(1.0, False), (-0.02, False), (-1.0, True)])
@pytest.mark.parametrize("cad", [CAD, ()], ids=["masses", "no masses"])
def test_gravity_that_acts_the_other_way_is_named_with_the_mounting(
    cad: tuple[float, ...], direction: float, is_named: bool
) -> None:
    a1, a2, a3 = inertia(*LENGTHS)
    a5 = direction * 9.80665 * a2 / LENGTHS[0]
    event = event_of(told(cad, 90.0), a1, a2, a3, *FRICTION, 3.0 * a5, a5)
    said = event is not None and "arm.mounting_deg[1] = -90 deg; link 1 hangs at q1 = 90 deg" in event.message
    assert said is is_named
