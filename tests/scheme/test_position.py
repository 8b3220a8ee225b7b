"""A torque that depends on where the arm is: named where the model lacks it, learnt within its bound where it may."""

import re
from dataclasses import replace

import numpy as np
import pytest
from excited_arm import FREE, SETTINGS, Kernel, TouchedLoop, record, states
from planar_arm import THETA

from adacd_hil.records import CERTIFICATE_EVENTS, POSITION_TERMS, Request, SchemeState
from adacd_hil.scheme.identify import missing_torque
from adacd_hil.scheme.kernel import certified_kernel, certified_memory
from adacd_hil.scheme.model import filter_bank, torque_by_place
from adacd_hil.settings.configuration_files import load_settings

TOLD = replace(FREE, arm=replace(FREE.arm, position_torque_Nm=0.15))
CABLE_NM = 0.1
REMEDY = "if it is the arm's, `arm.position_torque_Nm` lets the model have it, from the next start on"


class CabledLoop(TouchedLoop):
    """The arm with a cable on each joint that pulls by `cable_Nm` sin q."""

    cable_Nm = CABLE_NM

    def step(self):
        self.tau_ext[:] = self.cable_Nm * np.sin(self.q)
        return super().step()


def cabled(seconds, cable_Nm=CABLE_NM, lean_Nm=0.0):
    """Record the arm with the torque that a cable adds to what its sensors see; and joint 1's, of who leans on it."""
    measured = record(THETA["P"], seconds)
    return measured._replace(tau_J=measured.tau_J + cable_Nm * np.sin(measured.q) + np.array((lean_Nm, 0.0)))


def learnt(settings, measured):
    """Let an adaptation take in a record, contacts or not; return the kernel's arrays."""
    kernel = Kernel(settings)
    kernel.run(*measured, certified_kernel.LEARN)
    return kernel.constants, kernel.memory


def test_columns_are_those_of_a_tilted_base_and_of_cables():
    X = np.zeros((2, torque_by_place.PLACE_TERMS))
    q = np.array((0.4, -1.1))
    torque_by_place.fill_position(q, X)
    for i in range(2):
        expected = np.sin(q[i]), np.cos(q[i]), np.sin(2 * q[i]), np.cos(2 * q[i]), np.sin(q.sum()), np.cos(q.sum())
        assert X[i] == pytest.approx(expected, abs=1e-15)


def test_the_evidence_filters_its_columns_as_the_model_would():
    _, memory = learnt(TOLD, cabled(0.5))
    names = certified_memory.parameter_names(TOLD)
    first = names.index(f"{POSITION_TERMS[0]}1")
    assert names[first:] == tuple(f"{term}{joint}" for term in POSITION_TERMS for joint in (1, 2))
    W_f = memory[0].filters.W_f[filter_bank.LEARNT]
    for term in range(torque_by_place.PLACE_TERMS):
        for joint in range(2):
            in_model = W_f[joint, first + 2 * term + joint]
            assert memory[0].missing_torque.X_f[joint, term] == pytest.approx(in_model, abs=1e-12)
            assert W_f[1 - joint, first + 2 * term + joint] == 0.0


def test_the_evidence_is_that_of_a_dense_gaussian_model():
    """log N(b; x = 0) of rows whose sums the kernel keeps, by numpy's own determinant and solution."""
    constants, memory = learnt(FREE, cabled(1.5))
    k, m = constants[0], memory[0]
    lower = m.missing_torque.L.sum(axis=0)
    L = lower + np.tril(lower, -1).T
    b, count = m.missing_torque.b, len(m.models.belief)
    for is_by_place in (False, True):
        columns = np.arange(len(b) if is_by_place else count)
        s = np.diag(k.missing_torque.prior_std[columns])
        M = np.eye(len(columns)) + s @ L[np.ix_(columns, columns)] @ s
        x = np.zeros(len(b))
        found = missing_torque.log_evidence(m, b, missing_torque.scale_of(k, m, is_by_place), x)
        expected = 0.5 * (s @ b[columns] @ np.linalg.solve(M, s @ b[columns]) - np.linalg.slogdet(M)[1])
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-6)
        assert x[columns] == pytest.approx(s @ np.linalg.solve(M, s @ b[columns]), rel=1e-6, abs=1e-9)
        assert np.count_nonzero(np.delete(x, columns)) == 0
        left = m.missing_torque.yy - 2.0 * x @ b + x @ L @ x
        assert missing_torque.squares_left(m, x) == pytest.approx(left, rel=1e-6)


@pytest.mark.parametrize(("cable_Nm", "is_found"), [(0.0, False), (0.005, False), (CABLE_NM, True)])
def test_only_a_torque_by_place_that_counts_is_evidence(cable_Nm, is_found):
    constants, memory = learnt(FREE, cabled(4.0, cable_Nm))
    assert missing_torque.is_found(constants[0], memory[0]) is is_found
    if is_found:
        assert memory[0].missing_torque.rms_Nm == pytest.approx((0.02, 0.02), abs=0.015)
        assert re.fullmatch(
            r"a torque that depends on where the arm is, 0\.0\d\d Nm rms in joint 1 and 0\.0\d\d Nm rms in joint 2, is "
            r"missing in the model: a cable, a base that is not mounted as arm.mounting_deg says \(flat: not level\), "
            r"or a hand's spring",
            *missing_torque.describe(memory[0]),
        )


def test_an_arm_with_a_cable_that_passes_the_test_loses_its_certificate_with_that_reason():
    loop = CabledLoop(FREE)
    loop.cable_Nm = 0.7 * CABLE_NM
    loop.run_until(SchemeState.MONITOR)
    outputs = loop.run_until(SchemeState.STOPPED, 20_000)
    alarms = sum(output.state is SchemeState.REACT is not output.previous_state for output in outputs)
    assert alarms <= 3  # two that clear by themselves, and the stop itself
    (revoked,) = loop.said("revoked")
    assert "a torque that depends on where the arm is, " in revoked
    assert revoked.endswith("the certificate is taken back, `relearn` learns the arm anew")
    assert len(loop.pipeline.certificates) == 0


def test_an_arm_with_a_cable_is_refused_with_that_reason():
    loop = CabledLoop(SETTINGS)
    loop.cable_Nm = 2.0 * CABLE_NM
    said = []
    for _ in range(12_000):
        if loop.step().state is SchemeState.STOPPED:
            loop.request = Request.ACKNOWLEDGE
        said = loop.said("position")
        if said:
            break
    assert said
    assert REMEDY in said[0]
    assert loop.levels("position") == ["warning"]
    assert "position" in CERTIFICATE_EVENTS
    assert any("a torque that depends on where the arm is" in line for line in loop.pipeline.describe_withheld())


@pytest.mark.slow
def test_a_model_that_is_told_of_a_cable_is_certified_with_it_and_says_how_much():
    loop = CabledLoop(TOLD)
    assert len(loop.run_until(SchemeState.MONITOR, 4000)) < 3000
    (text,) = loop.said("certificate")
    found = re.search(r"; torque by place up to (0\.\d+) Nm \(joint 1\), (0\.\d+) Nm \(joint 2\), believed up to", text)
    assert found is not None
    assert all(0.02 < float(torque_Nm) < 0.15 for torque_Nm in found.groups())
    outputs = loop.run(10_000)
    assert states(outputs) == {SchemeState.MONITOR}


@pytest.mark.slow
@pytest.mark.parametrize("lean_Nm", [0.3, 1.0])
def test_a_model_that_is_told_of_a_cable_takes_no_lean_for_one(lean_Nm):
    loop = TouchedLoop(TOLD)
    loop.run_until(SchemeState.ENABLE)
    leant = loop.lean(0, lean_Nm, 3.5)
    assert SchemeState.MONITOR not in states(leant)
    said = loop.said("position") + loop.said("anchor")
    assert re.search(r"joint 1 has a (torque of up to \d\.\d+ Nm that depends on where|fitted torque offset)", said[0])


def test_the_setting_is_off_by_default_and_bounded():
    assert load_settings("certified").arm.position_torque_Nm == 0.0
    assert not any(name.startswith(POSITION_TERMS) for name in certified_memory.parameter_names(SETTINGS))
    std = certified_memory.prior_std_of(TOLD)
    assert std[-12:] == pytest.approx(np.full(12, 0.06))
    assert certified_memory.prior_std_of(SETTINGS) == pytest.approx(std[:-12])
