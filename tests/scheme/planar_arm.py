"""A small 2R arm with drives and sensors, in closed loop with the pipeline; for the tests of the scheme only."""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import ArmState, FaultReason, Request, SchemeOutput, SchemeState
from adacd_hil.scheme.contact.reaction import Withdrawal
from adacd_hil.scheme.model.regressor import inverse_dynamics
from adacd_hil.scheme.pipeline.pipeline import Pipeline
from adacd_hil.settings.configuration import Settings

THETA = {
    "P": np.array([0.19205, 0.034125, 0.020175, 0.03, 0.015, 0.0375, 0.02]),
    "S": np.array([0.3841, 0.06825, 0.04035, 0.024, 0.012, 0.03, 0.016]),
    "M": np.array([0.3841, 0.06825, 0.04035, 0.12, 0.06, 0.15, 0.08]),
}
PAYLOAD_1KG = np.array([0.2125, 0.105, 0.090, 0.0, 0.0, 0.0, 0.0])

SUBSTEPS = 8
STICTION_RAD_S = 1e-3
TRACKING_RAD_S = 2.0 * np.pi * 200.0
ENCODER_LSB_RAD = 2.0 * np.pi / 2**20
VELOCITY_LSB_RAD_S = 5e-4
TORQUE_LSB_NM = 100.0 / 2**16
TORQUE_NOISE_NM = 0.02


@compiled
def acceleration(q, dq, tau, theta):
    """Forward dynamics, from the Lagrangian T = ½ M11 dq1² + M12 dq1 dq2 + ½ M22 dq2²."""
    a1, a2, a3, fv1, fv2, fc1, fc2 = theta
    c2, s2 = np.cos(q[1]), np.sin(q[1])
    m11, m12, m22 = a1 + 2.0 * a2 * c2, a3 + a2 * c2, a3
    slope11, slope12 = -2.0 * a2 * s2, -a2 * s2
    # d/dt (dT/d dq) - dT/dq without the terms of ddq
    h1 = slope11 * dq[1] * dq[0] + slope12 * dq[1] * dq[1]
    h2 = slope12 * dq[1] * dq[0] - (0.5 * slope11 * dq[0] * dq[0] + slope12 * dq[0] * dq[1])
    f1 = fv1 * dq[0] + fc1 * min(max(dq[0] / STICTION_RAD_S, -1.0), 1.0)
    f2 = fv2 * dq[1] + fc2 * min(max(dq[1] / STICTION_RAD_S, -1.0), 1.0)
    r1, r2 = tau[0] - h1 - f1, tau[1] - h2 - f2
    determinant = m11 * m22 - m12 * m12
    return np.array([(m22 * r1 - m12 * r2) / determinant, (m11 * r2 - m12 * r1) / determinant])


@compiled
def advance(q, dq, tracked_q, tracked_dq, tau, theta, period_s):
    """Move the arm and the drives' velocity loops by one period, RK4, in place."""
    h = period_s / SUBSTEPS
    for _ in range(SUBSTEPS):
        k1 = acceleration(q, dq, tau, theta)
        k2 = acceleration(q + 0.5 * h * dq, dq + 0.5 * h * k1, tau, theta)
        k3 = acceleration(q + 0.5 * h * dq + 0.25 * h * h * k1, dq + 0.5 * h * k2, tau, theta)
        k4 = acceleration(q + h * dq + 0.5 * h * h * k2, dq + h * k3, tau, theta)
        q += h * dq + h * h / 6.0 * (k1 + k2 + k3)
        dq += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        error = np.round(q / ENCODER_LSB_RAD) * ENCODER_LSB_RAD - tracked_q
        tracked_q += h * (tracked_dq + 2.0 * TRACKING_RAD_S * error)
        tracked_dq += h * TRACKING_RAD_S * TRACKING_RAD_S * error


def quintic(t_s: float, amplitude: float, half_period_s: float) -> tuple[float, float, float]:
    """Go from -amplitude to +amplitude and back, each in half_period_s."""
    count, s = divmod(t_s / half_period_s, 1.0)
    sign = 1.0 if count % 2 == 0 else -1.0
    q = amplitude * (2.0 * (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5) - 1.0)
    dq = 2.0 * amplitude * (30.0 * s**2 - 60.0 * s**3 + 30.0 * s**4) / half_period_s
    ddq = 2.0 * amplitude * (60.0 * s - 180.0 * s**2 + 120.0 * s**3) / half_period_s**2
    return sign * q, sign * dq, sign * ddq


class ClosedLoop:
    """The arm under PD control, and the pipeline that watches it; one call of `step` is one period."""

    def __init__(self, settings: Settings, theta: np.ndarray, seed: int = 1, noise_Nm: float = TORQUE_NOISE_NM):
        self.settings = settings
        self.pipeline = Pipeline(settings)
        self.theta = theta.copy()
        self.random = np.random.default_rng(seed)
        self.noise_Nm = noise_Nm
        self.amplitude = np.radians(settings.trajectory.amplitude_deg)
        self.q = -self.amplitude.copy()
        self.dq = np.zeros(2)
        self.tracked_q = self.q.copy()
        self.tracked_dq = np.zeros(2)
        self.tau = np.zeros(2)
        self.tau_next = np.zeros(2)
        self.tau_ext = np.zeros(2)
        self.cycle = 0
        self.motion_cycles = 0
        self.is_moving = False
        self.withdrawal: Withdrawal | None = None
        self.withdrawal_cycle = 0
        self.request = Request.NONE

    def measure(self) -> ArmState:
        tau_J = self.tau + self.noise_Nm * self.random.standard_normal(2)
        return ArmState(
            cycle=self.cycle,
            t_ns=self.cycle * self.settings.bus.period_ns,
            periods=1,
            q=np.round(self.q / ENCODER_LSB_RAD) * ENCODER_LSB_RAD,
            dq=np.round(self.tracked_dq / VELOCITY_LSB_RAD_S) * VELOCITY_LSB_RAD_S,
            tau_J=np.round(tau_J / TORQUE_LSB_NM) * TORQUE_LSB_NM,
            age_q=(0, 0),
            age_tau_J=(0, 0),
            is_enabled=True,
            is_complete=True,
            fault=FaultReason.NONE,
        )

    def desired(self) -> np.ndarray:
        if self.withdrawal is not None:
            motion = np.zeros((3, 2))
            self.withdrawal.evaluate((self.cycle - self.withdrawal_cycle) * self.settings.bus.period_s, *motion)
            return motion
        t_s = self.motion_cycles * self.settings.bus.period_s
        return np.array(
            [quintic(t_s, self.amplitude[i], self.settings.trajectory.half_period_s[i]) for i in range(2)]
        ).T

    def step(self) -> SchemeOutput:
        arm = self.measure()
        output = self.pipeline.step(arm, self.request)
        self.request = Request.NONE
        if output.state is SchemeState.ADAPT and output.previous_state is not SchemeState.ADAPT:
            self.motion_cycles = 0
            self.is_moving = True
        if output.state is SchemeState.REACT and output.previous_state is SchemeState.MONITOR:
            q_d, dq_d, _ = self.desired()
            self.withdrawal = Withdrawal(self.settings, q_d, dq_d, output.tau_ext_hat)
            self.withdrawal_cycle = self.cycle
        q_d, dq_d, ddq_d = self.desired()
        self.tau = self.tau_next
        self.tau_next = self.settings.controller.Kp * (q_d - arm.q) + self.settings.controller.Kd * (dq_d - arm.dq)
        if output.is_model_valid:
            self.tau_next = self.tau_next + inverse_dynamics(q_d, dq_d, ddq_d, output.theta_ff, 0.0)
        advance(
            self.q,
            self.dq,
            self.tracked_q,
            self.tracked_dq,
            self.tau + self.tau_ext,
            self.theta,
            self.settings.bus.period_s,
        )
        self.cycle += 1
        self.motion_cycles += self.is_moving
        return output

    def run(self, cycles: int) -> list[SchemeOutput]:
        return [self.step() for _ in range(cycles)]

    def run_until(self, state: SchemeState, most_cycles: int = 70_000) -> list[SchemeOutput]:
        outputs = []
        for _ in range(most_cycles):
            outputs.append(self.step())
            if outputs[-1].state is state:
                return outputs
        raise AssertionError(f"still in {outputs[-1].state.name} after {most_cycles} cycles")

    def change_payload(self, added_theta: np.ndarray) -> None:
        """Park in the start corner, fit the payload, and say so; ends with the first cycle of the adaptation."""
        common_s = 2.0 * max(self.settings.trajectory.half_period_s)
        while (self.motion_cycles * self.settings.bus.period_s) % common_s > 1e-9:
            self.step()
        self.is_moving = False
        self.request = Request.PAYLOAD
        self.run(500)
        self.theta = self.theta + added_theta
        self.request = Request.PAYLOAD_CHANGED
        self.run_until(SchemeState.ADAPT, 500)
