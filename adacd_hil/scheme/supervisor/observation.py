"""What one cycle's numbers say, as far as the supervisor needs it: bits that compiled code sets.

Any kernel of the scheme sets them, and only those that it knows: the paper's never certifies.
"""

from enum import IntFlag

CONTACT_SHIFT = 16
"""The joints over their lower threshold are the bits of an observation from here on."""


class Observation(IntFlag):
    """One cycle's findings. Numbers are not logged."""

    NONE = 0
    NOT_A_NUMBER = 1  # a measurement is not finite
    OVER_LIMIT = 2  # beyond the arm's limits: |q|, or |dq| where OVER_SPEED is not told apart
    AT_REST = 4  # every |dq| below the rest velocity
    UNLOADED = 8  # every |tau_J| below the rest torque
    ADAPTED = 16  # eq. (15) holds with the evidence for it
    CONTACT = 32  # a joint is over its lower threshold
    FITTED = 64  # the evidence for the estimate is complete; it is to be tested
    CERTIFIED = 128  # the frozen model has passed its test
    REFUTED = 256  # the frozen model has failed its test
    COLLISION = 512  # a joint is over its upper threshold
    OVER_SPEED = 1024  # |dq| beyond the arm's limit, which a blow may do for a moment
    UNSEEN = 2048  # the filters took no sample in: the residual is not of now
    WITHHELD = 4096  # an anchor, a touch or a torque by place excludes what would be certified, or what is
