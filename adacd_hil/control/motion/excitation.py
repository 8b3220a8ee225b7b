"""The excitation: the motion by which the certified scheme learns the arm, a short Fourier series per joint.

It begins and ends at rest in the trajectory's start corner and moves both joints at once and both ways, so that no
combination of parameters stays hidden (`analysis.excitation` finds the coefficients).

Units: rad, rad/s, rad/s², s. Joint vectors (2,).
"""

import numpy as np

from adacd_hil.records import Vector
from adacd_hil.settings.configuration import Settings


class Excitation:
    """The excitation of one run."""

    def __init__(self, settings: Settings) -> None:
        amplitude = np.radians(settings.trajectory.amplitude_deg)[:, np.newaxis]
        self._corner = -amplitude[:, 0]
        self._cosine = amplitude * np.array(settings.excitation.cosine)
        self._sine = amplitude * np.array(settings.excitation.sine)
        period_s = settings.excitation.period_s
        self._rad_s = np.arange(1, self._sine.shape[1] + 1) * (2.0 * np.pi / period_s if period_s else 0.0)
        self._acceleration = self._rad_s**2
        self.is_on = bool(period_s and self._rad_s.size)

    def evaluate(self, elapsed_s: float, q_d: Vector, dq_d: Vector, ddq_d: Vector) -> None:
        """Fill the desired motion (2,) at this time since its start; it goes on and on."""
        cosine, sine = np.cos(self._rad_s * elapsed_s), np.sin(self._rad_s * elapsed_s)
        q_d[:] = self._corner + self._cosine @ (cosine - 1.0) + self._sine @ sine
        dq_d[:] = self._sine @ (self._rad_s * cosine) - self._cosine @ (self._rad_s * sine)
        ddq_d[:] = -(self._cosine @ (self._acceleration * cosine)) - self._sine @ (self._acceleration * sine)
