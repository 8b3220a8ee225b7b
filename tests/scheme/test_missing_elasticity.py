"""Elastic joints: named where a model of rigid ones is refused."""

import re
from typing import NamedTuple

import numpy as np
import pytest
from excited_arm import PERIOD_S, Record, record
from planar_arm import THETA
from scipy.signal import butter, filtfilt
from test_position import CABLE_NM, FREE, cabled, learnt

from adacd_hil.records import CERTIFICATE_EVENTS
from adacd_hil.scheme.identify import certificate, missing_torque
from adacd_hil.scheme.pipeline.certificate_watch import CertificateWatch


class Found(NamedTuple):
    """Whether a torque is missing, whether an elastic joint's, and what is said of it."""

    is_found: bool
    is_elastic: bool
    lines: list[str]


def seen_by_motors(rigid: Record, stiffness_Nm_rad: np.ndarray) -> Record:
    """Return what encoders see that turn by tau_J / K more than the links; tau_J (n, 2) as it is below 40 Hz."""
    smooth = filtfilt(*butter(4, 40.0, fs=1.0 / PERIOD_S), rigid.tau_J, axis=0)
    twist = smooth / stiffness_Nm_rad
    return Record(rigid.q + twist, rigid.dq + np.gradient(twist, PERIOD_S, axis=0), rigid.tau_J)


def elastic(seconds: float, swing_Hz: float) -> Record:
    """Record arm P as encoders on the motors of joints see it that swing at this frequency."""
    return seen_by_motors(record(THETA["P"], seconds), (2.0 * np.pi * swing_Hz) ** 2 * THETA["P"][[0, 2]])


def found_in(measured: Record) -> Found:
    constants, memory = learnt(FREE, measured)
    is_found = missing_torque.is_found(constants[0], memory[0])
    return Found(bool(is_found), bool(memory[0]["is_elastic"]), missing_torque.describe(memory[0]))


@pytest.mark.parametrize("seconds", [1.4, 2.0])
def test_joints_that_swing_at_8_hz_are_named(seconds: float) -> None:
    """After 1.4 s the columns by place explain more than those of elastic joints do, by chance of the way."""
    found = found_in(elastic(seconds, 8.0))
    assert found.is_elastic
    assert re.fullmatch(
        r"the torque of an elastic joint, 0\.\d\d\d Nm rms in joint 1 and 0\.\d\d\d Nm rms in joint 2, is missing in "
        r"the model, which has rigid ones",
        *found.lines,
    )


@pytest.mark.parametrize("measured", [elastic(2.0, 80.0), cabled(4.0, 0.0)], ids=["80 Hz", "rigid"])
def test_stiff_joints_are_not(measured: Record) -> None:
    assert found_in(measured) == Found(is_found=False, is_elastic=False, lines=[])


@pytest.mark.parametrize("cable_Nm", [2.0 * CABLE_NM, 10.0 * CABLE_NM])
def test_a_cable_is_a_cable(cable_Nm: float) -> None:
    """A strong one is explained by the columns of elastic joints a little, where those by place are left out."""
    found = found_in(cabled(4.0, cable_Nm))
    assert found.is_found
    assert not found.is_elastic
    assert "depends on where the arm is" in found.lines[0]


def test_a_fit_that_is_refused_for_it_says_so_and_what_helps() -> None:
    constants, memory = learnt(FREE, elastic(2.0, 8.0))
    m = memory[0]
    m["withheld_by"] = certificate.missing_cause(constants[0], m)
    assert m["withheld_by"] == certificate.ELASTIC
    event = CertificateWatch(constants, memory, "").refuse(is_reading=False)
    assert event is not None
    assert (event.level, event.name) == ("warning", "elastic")
    assert event.name in CERTIFICATE_EVENTS
    assert event.message.startswith("the torque of an elastic joint, ")
    assert event.message.endswith("learning begins anew; the model needs encoders on the links, or stiffer joints")
