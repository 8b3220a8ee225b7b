"""What is done every so many cycles."""


class Recurrence:
    """Something that is done every so many cycles, and after skipped ones as soon as there is a cycle again."""

    def __init__(self, interval_s: float, period_s: float) -> None:
        self._cycles = max(1, round(interval_s / period_s))
        self._due_cycle = 0

    def is_due(self, cycle: int) -> bool:
        """Whether it is to be done in this cycle; asked once per cycle."""
        if cycle < self._due_cycle:
            return False
        self._due_cycle = cycle - cycle % self._cycles + self._cycles
        return True
