"""A device's own clock: that of the bench, until it is set to run fast or slow.

Everything that a device times goes by it: heartbeats, event timers, inhibit times, watchdogs, the time in an EMCY. Both
times are integer ns; `drift_ppm` > 0 runs fast. A clock that drifts no more keeps the lead that it has.
"""

from firmware_sim.canopen.object_dictionary import NEVER_NS

_BILLION = 1_000_000_000


class NodeClock:
    """Turns the bench's time into the device's, and back."""

    def __init__(self) -> None:
        self.is_true = True
        """Whether it is the bench's time."""
        self._since_ns = self._own_since_ns = 0
        self._rate = _BILLION  # own ns in a second of the bench

    def set_drift(self, drift_ppm: float, t_ns: int) -> None:
        """Run fast by `drift_ppm` from the bench's `t_ns` on."""
        self._own_since_ns = self.own_ns(t_ns)
        self._since_ns = t_ns
        self._rate = _BILLION + round(drift_ppm * 1000)
        self.is_true = self._rate == _BILLION and self._own_since_ns == t_ns

    def own_ns(self, t_ns: int) -> int:
        """Return the device's time."""
        if self.is_true:
            return t_ns
        return self._own_since_ns + (t_ns - self._since_ns) * self._rate // _BILLION

    def bench_ns(self, own_ns: int) -> int:
        """Return the first time of the bench at which the device's is `own_ns`."""
        if self.is_true or own_ns >= NEVER_NS:
            return own_ns
        return self._since_ns - (own_ns - self._own_since_ns) * _BILLION // -self._rate
