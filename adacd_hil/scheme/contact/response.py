"""The choice of a reaction: by level and link, and what changes it while the arm reacts.

A contact that grows into a collision, or whose link turns out to be another, has its reaction chosen anew. A withdrawal
is given up for the `two_sided` reaction when something pushes from the other side: the external torque along the way of
the withdrawal has turned against it by more than the upper thresholds, as in a clamp or with a wall behind.

Shapes: tau_ext_hat (2,), Nm.
"""

import numpy as np

from adacd_hil.records import ContactLevel, Reaction, Vector
from adacd_hil.scheme.supervisor.observation import Observation
from adacd_hil.scheme.supervisor.skip_conditions import Calm
from adacd_hil.settings.configuration import Settings

TURNED_CYCLES = 5
"""How many samples in a row the torque must be turned: what a blow leaves in the estimate is shorter."""
BLIND_S = 0.02
"""After a withdrawal has begun it is not judged yet: the estimate still rings from the blow."""

_ROUNDING_NM = 1e-9
"""More than two ways of adding up a torque along a way may differ by."""
_COLLISION = int(Observation.COLLISION)


class Response:
    """What is done about the contact of REACT and STOPPED."""

    def __init__(self, settings: Settings) -> None:
        wish = settings.reaction
        self._table = {
            ContactLevel.CONTACT: tuple(Reaction[name.upper()] for name in wish.contact),
            ContactLevel.COLLISION: tuple(Reaction[name.upper()] for name in wish.collision),
        }
        self._two_sided = Reaction[wish.two_sided.upper()]
        self._collision_Nm = np.array(settings.detector.collision_Nm)
        self._blind_cycles = round(BLIND_S / settings.bus.period_s)
        self._reaction = Reaction.NONE
        self._cause = (ContactLevel.CONTACT, 0)
        self._is_two_sided = False
        self._is_given_up = False
        self._way = np.zeros(0)
        self._cycles = 0
        self._turned_cycles = 0

    @property
    def reaction(self) -> Reaction:
        """What is to be done now; NONE also while nothing touches."""
        return self._reaction

    @property
    def level(self) -> ContactLevel:
        """The highest level of this contact so far."""
        return self._cause[0]

    @property
    def is_two_sided(self) -> bool:
        """Whether something has pushed from the other side too."""
        return self._is_two_sided

    @property
    def goes_on(self) -> bool:
        """Whether the arm moves on along its path."""
        return self._reaction in (Reaction.NONE, Reaction.SLOW_DOWN)

    def hold(self) -> None:
        """Begin to stop without a contact, as for a host that is late."""
        self._begin(Reaction.STOP, np.zeros(0))
        self._cause = (ContactLevel.COLLISION, 0)

    def end(self) -> None:
        """Forget the contact: the arm goes on."""
        self._begin(Reaction.NONE, np.zeros(0))
        self._cause = (ContactLevel.CONTACT, 0)

    def begin(self, level: ContactLevel, link: int, tau_ext_hat: Vector, is_model_valid: bool) -> None:
        """Choose for a contact that begins. Without a valid model there is nothing to float with: the arm stops."""
        self._is_two_sided = self._is_given_up = False
        self._cause = (level, link)
        self._choose(tau_ext_hat, is_model_valid)

    def step(
        self,
        level: ContactLevel,
        link: int,
        is_latched: bool,
        tau_ext_hat: Vector,
        is_model_valid: bool,
    ) -> None:
        """Take in one cycle of a contact and change the reaction if something calls for it."""
        cause = (max(level, self._cause[0]), link)
        if cause != self._cause and self._cause[1] and not self._is_given_up:
            self._cause = cause
            self._choose(tau_ext_hat, is_model_valid)
        if is_latched and self.goes_on and self.level is ContactLevel.CONTACT:
            self._begin(Reaction.STOP, tau_ext_hat)
        if self._is_judging:
            self._judge(tau_ext_hat, is_model_valid)

    def calm(self, calm: Calm, link: int) -> Calm:
        """Narrow the bounds to those within which nothing calls for another reaction, but what `judged` says."""
        if self._is_given_up:
            return calm
        if link != self._cause[1]:
            return calm._replace(cycles=0)
        is_contact = self.level is ContactLevel.CONTACT
        return calm._replace(watched=calm.watched | _COLLISION) if is_contact else calm

    @property
    def judged(self) -> tuple[tuple[float, float], float]:
        """A way, and the external torque along it, Nm, from which on a withdrawal certainly goes on; -inf: any."""
        if not self._is_judging:
            return (0.0, 0.0), -np.inf
        return (float(self._way[0]), float(self._way[1])), _ROUNDING_NM - self._bound_Nm

    def pass_by(self, cycles: int) -> None:
        """Count calm cycles."""
        if self._is_judging:
            self._cycles += cycles
            self._turned_cycles = 0

    @property
    def _is_judging(self) -> bool:
        return self._reaction is Reaction.WITHDRAW and self._way.size > 0

    @property
    def _bound_Nm(self) -> float:
        """How far the torque along the way may turn against it."""
        return float(np.abs(self._way) @ self._collision_Nm)

    def _choose(self, tau_ext_hat: Vector, is_model_valid: bool) -> None:
        level, link = self._cause
        reaction = self._table[level][link - 1]
        if reaction is not self._reaction:
            self._begin(self._possible(reaction, is_model_valid), tau_ext_hat)

    @staticmethod
    def _possible(reaction: Reaction, is_model_valid: bool) -> Reaction:
        return Reaction.STOP if reaction is Reaction.FLOAT and not is_model_valid else reaction

    def _begin(self, reaction: Reaction, tau_ext_hat: Vector) -> None:
        self._reaction = reaction
        size = float(np.linalg.norm(tau_ext_hat)) if tau_ext_hat.size else 0.0
        self._way = tau_ext_hat / size if size > 0.0 else np.zeros(0)
        self._cycles = self._turned_cycles = 0

    def _judge(self, tau_ext_hat: Vector, is_model_valid: bool) -> None:
        """Give a withdrawal up if it pushes something on the other side."""
        self._cycles += 1
        if self._cycles <= self._blind_cycles:
            return
        along = float(tau_ext_hat @ self._way)
        self._turned_cycles = self._turned_cycles + 1 if along < -self._bound_Nm else 0
        self._is_two_sided = self._is_two_sided or self._turned_cycles >= TURNED_CYCLES
        if self._is_two_sided:
            self._is_given_up = True
            self._begin(self._possible(self._two_sided, is_model_valid), tau_ext_hat)
