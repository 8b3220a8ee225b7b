"""The findings of one cycle that the supervisor needs: bits of an observation, which compiled code sets.

Each kernel sets only the bits that it knows: the paper's kernel never certifies.
"""

CONTACT_SHIFT = 16
"""Index of an observation's first bit for a joint over its lower threshold; one bit per joint."""

# Bits of an observation, the findings of one cycle. Numbers are not logged.
NOT_A_NUMBER = 1  # a measurement is not finite
OVER_LIMIT = 2  # beyond the arm's limits: |q|, or |dq| where OVER_SPEED is not a bit of its own
AT_REST = 4  # every |dq| below the rest velocity
UNLOADED = 8  # every |tau_J| below the rest torque
ADAPTED = 16  # eq. (15) holds with the evidence for it
CONTACT = 32  # a joint is over its lower threshold
FITTED = 64  # the evidence for the estimate is complete; it is to be tested
CERTIFIED = 128  # the frozen model has passed its test
REFUTED = 256  # the frozen model has failed its test
COLLISION = 512  # a joint is over its upper threshold
OVER_SPEED = 1024  # |dq| beyond the arm's limit, which a blow may do for a moment
UNSEEN = 2048  # the filters took no new sample in: the residual is an old one
WITHHELD = 4096  # an anchor, a touch or a torque by place excludes the model to be certified, or the certified one
ANY_CONTACT = CONTACT | COLLISION
