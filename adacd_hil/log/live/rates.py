"""How often the live view shows each topic: a person watches, and the network may be a radio.

A rate is kept by log time: time is divided into slots of 1 / rate, and of each slot all records of the first cycle in
it are shown. So frames of one cycle stay together, and what comes more seldom than its rate is shown whole.
"""

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.channels import DECODED

TRANSFORMS_TOPIC, SCENE_TOPIC, DESCRIPTION_TOPIC = "/tf", "/scene", "/robot_description"
"""Topics that only the live view has; the last is sent to whoever subscribes, once."""
RATES_HZ = {
    "/scheme": 50,
    "/joint_states": 50,
    "/control": 50,
    TRANSFORMS_TOPIC: 50,
    "/cycle": 20,
    SCENE_TOPIC: 10,
    "/to_can_bus": 10,
    "/from_can_bus": 10,
    "/to_can_bus_fd": 10,
    "/from_can_bus_fd": 10,
}
DECODED_RATE_HZ = 10
EVERY_RECORD = 0
"""The rate of all other topics, as /events, /contact and /frame_checks."""


def rate_of(topic: str) -> int:
    """Return the rate of a topic, Hz; EVERY_RECORD: it is shown whole."""
    return DECODED_RATE_HZ if topic.startswith(DECODED) else RATES_HZ.get(topic, EVERY_RECORD)


class Decimator:
    """Chooses the records of one topic that are shown."""

    def __init__(self, rate_Hz: int) -> None:
        self._slot_ns = 1_000_000_000 // rate_Hz if rate_Hz else 0
        self._slot = -1
        self._first_ns = -1  # the first cycle of the slot

    def choose(self, cycles_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Say which of the next records are shown (n,), by the times of their cycles, which never run backwards."""
        if not self._slot_ns or not len(cycles_ns):
            return np.ones(len(cycles_ns), np.bool_)
        slots = cycles_ns // self._slot_ns
        begins = np.diff(slots, prepend=self._slot) != 0
        latest = np.maximum.accumulate(np.where(begins, np.arange(len(slots)), -1))
        firsts_ns = np.where(latest < 0, self._first_ns, cycles_ns[latest])
        self._slot, self._first_ns = int(slots[-1]), int(firsts_ns[-1])
        return np.asarray(cycles_ns == firsts_ns)
