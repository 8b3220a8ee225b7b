"""A torque-sensed arm of any number of joints, moved by Pinocchio's forward dynamics; its mechanics are not ours."""

import numpy as np

PERIOD_S = 1e-3
BANDWIDTH_RAD_S = 25.0
SLIP_RAD_S = 4e-3  # width of the friction's sign


class Multisine:
    """A periodic motion of random phases within position and velocity limits."""

    def __init__(self, seed, low, high, velocity_limit, period_s=10.0, harmonics=6):
        random = np.random.default_rng(seed)
        n = low.size
        self.rate = 2.0 * np.pi / period_s * np.arange(1, harmonics + 1)
        self.cosine, self.sine = random.normal(size=(2, n, harmonics)) / self.rate * self.rate[0]
        t_s = np.arange(0.0, period_s, 0.02)
        q, dq, _ = (np.array(values) for values in zip(*(self.raw(at) for at in t_s), strict=True))
        middle, half = 0.5 * (low + high), 0.45 * (high - low)
        share = np.minimum(half / np.max(np.abs(q), axis=0), 0.7 * velocity_limit / np.max(np.abs(dq), axis=0))
        self.cosine *= share[:, None]
        self.sine *= share[:, None]
        self.middle = middle

    def raw(self, t_s):
        c, s = np.cos(self.rate * t_s), np.sin(self.rate * t_s)
        q = self.cosine @ c + self.sine @ s
        dq = self.sine @ (self.rate * c) - self.cosine @ (self.rate * s)
        ddq = -self.cosine @ (self.rate**2 * c) - self.sine @ (self.rate**2 * s)
        return q, dq, ddq

    def __call__(self, t_s):
        q, dq, ddq = self.raw(t_s)
        return self.middle + q, dq, ddq


def simulate(pinocchio, model, motion, seconds, F_v, F_c, offset, noise_Nm, seed, force=None):
    """Return q, dq, tau_J (k, n), tau_ext (k, n).

    The joint torque goes in a straight line from one sample to the next and acts a period late. force: of the time,
    a (frame, force in the world's axes at the frame's origin) or None.
    """
    data, shadow = model.createData(), model.createData()
    random = np.random.default_rng(seed)
    count = round(seconds / PERIOD_S)
    q, dq, _ = motion(0.0)
    tau = pinocchio.rnea(model, shadow, *motion(0.0)) + F_v * dq + F_c * np.tanh(dq / SLIP_RAD_S)
    record = np.zeros((4, count, model.nv))
    for k in range(count):
        t_s = k * PERIOD_S
        q_d, dq_d, ddq_d = motion(t_s + PERIOD_S)
        wanted = ddq_d + 2.0 * BANDWIDTH_RAD_S * (dq_d - dq) + BANDWIDTH_RAD_S**2 * (q_d - q)
        tau_next = pinocchio.rnea(model, shadow, q, dq, wanted) + F_v * dq_d + F_c * np.sign(dq_d)
        pushed = None if force is None else force(t_s)
        tau_ext = np.zeros(model.nv)
        if pushed is not None:
            frame, newtons = pushed
            jacobian = pinocchio.computeFrameJacobian(
                model, shadow, q, model.getFrameId(frame), pinocchio.LOCAL_WORLD_ALIGNED
            )
            tau_ext = jacobian[:3].T @ newtons
        record[:, k] = q, dq, tau, tau_ext

        def acceleration(q, dq, tau, tau_ext=tau_ext):
            friction = F_v * dq + F_c * np.tanh(dq / SLIP_RAD_S)
            return pinocchio.aba(model, data, q, dq, tau + tau_ext - friction)

        half = 0.5 * PERIOD_S
        ddq = acceleration(q, dq, tau)
        dq_half = dq + half * ddq
        ddq_half = acceleration(q + half * dq, dq_half, 0.5 * (tau + tau_next))
        q, dq = q + PERIOD_S * dq_half, dq + PERIOD_S * ddq_half
        tau = tau_next
    q, dq, tau_J, tau_ext = record
    return q, dq, tau_J + offset + noise_Nm * random.standard_normal(tau_J.shape), tau_ext
