"""The SYNC that each cyclic frame answers, and the values that all devices sampled on one SYNC.

The model compares torque with motion, so all values of a sample must be of one moment. If a device answers late, its
sample is complete one or more cycles after it was taken. The sample is used then, with its age.

A device answers every SYNC with one frame. A frame that arrives in time answers the last SYNC. A frame that arrives
after the host's wait, or after the next SYNC, answers an earlier SYNC, and its value is as old as that SYNC. If the
host took it for the last SYNC's answer, the model would compare torque and motion of different moments.

SYNCs have ordinals, counted over the SYNCs that were sent. Of the SYNCs without an answer, a frame answers

- the one that its alive counter gives, if it has a counter: the counter advances by one per frame;
- else the oldest, unless a lost frame is the better explanation: the frame arrives when the device usually answers, or
  its position fits the motion over that time and not over a shorter one. An answer can't arrive sooner after its SYNC
  than any answer of the device before, except when frames that the device used to wait for are missing.

If a frame's counter is behind the last frame's, the frame is a straggler if the answer with that counter is missing.
Otherwise another sender repeats an old frame.

Two questions can't be decided from frames. First: a device with a counter missed a SYNC, or answers a whole period
late; it counts as late. Second: a frame without counter that arrives at the usual time is a period late, or follows a
lost frame. If the arm doesn't move, it counts as the latter; a second frame on the same SYNC shows that it was late.
"""

from collections.abc import Callable, Sequence

KEPT = 16
"""SYNCs whose values are kept: more than any device may be late."""
USUAL_ANSWERS = 100
"""Answers from which the usual time is taken, at the beginning of an attempt, while the arm rests: 0.1 s at 1 kHz."""
TOLERANCE_NS = 50_000
"""How much sooner or later than any of those an answer may come and be usual: half a frame of a classic bus at
1 Mbit/s, which may be sent in between."""
_MASK = 0xFFFF
CLEAR_RAD = 2e-4
"""Difference of two errors of position that decides. The drive's velocity lags 1.6 ms, so that 100 rad/s² leave
1.6e-4 rad in a period of 1 ms."""


class AnswerClock:
    """The answers of one device.

    answered: the ordinal of the last SYNC that was answered; None before the first. earliest_ns: least time from a SYNC
    to its answer, of USUAL_ANSWERS answers in time, from the second on; 0 before them.
    """

    def __init__(self) -> None:
        self.answered: int | None = None
        self.earliest_ns = self._latest_ns = 0
        self._usual_count = 0
        self._is_guess = False
        self._unanswered = 0  # bit k: the SYNC k before the last answered one has no answer
        self._kept: list[tuple[int, tuple[float, ...]]] = [(-1, ())] * KEPT

    def find(
        self,
        newest: int,
        offset_ns: int,
        step: int | None,
        position_error: Callable[[int], float] | None = None,
        soonest_ns: int | None = None,
    ) -> int | None:
        """Return the ordinal of the SYNC that a frame answers; None if all SYNCs up to `newest` are answered already.

        Before the first answer it is `newest`. With a counter it is `step` SYNCs after the last answered one, at least
        one and at most up to `newest`. Without a counter it is the oldest unanswered SYNC, or `newest` if arrival time
        and position show that answers were lost. If the last answer was a guess that the frame corrects, `newest` is
        returned again.

        newest: ordinal of the last SYNC before the frame, which came `offset_ns` after it. step: advance of its alive
        counter since the last frame; None without a counter, and at the beginning. position_error: returns, for a
        number of SYNCs between the last frame and this one, the difference between the frame's position and the
        position extrapolated with its velocity, rad. soonest_ns: least time from SYNC to an answer; None: the device's
        least so far.
        """
        answered = self.answered
        if answered is None:
            return newest
        if answered >= newest:
            return newest if self._is_guess and self._is_newer(offset_ns, position_error) else None
        if step is not None:
            return min(answered + max(step, 1), newest)
        soonest_ns = self.earliest_ns if soonest_ns is None else soonest_ns
        if self._usual_count and offset_ns < soonest_ns - TOLERANCE_NS:
            return answered + 1
        return newest if self._follows_lost_ones(newest - answered, offset_ns, position_error) else answered + 1

    def _is_newer(self, offset_ns: int, position_error: Callable[[int], float] | None) -> bool:
        """Return whether a second frame after one SYNC, without counter, answers it, so that the first one was late.

        False if it comes later after SYNC (`offset_ns`) than usual. If position_error, as of `find`, is given, the
        frame must also fit one period after the first frame about as well as one period before it.
        """
        if not self._is_usual(offset_ns):
            return False
        return position_error is None or position_error(1) <= position_error(-1) + CLEAR_RAD

    def _is_usual(self, offset_ns: int) -> bool:
        """Return whether a frame comes no later after SYNC than the device usually answers; True if that is unknown."""
        return not self._usual_count or offset_ns <= self._latest_ns + TOLERANCE_NS

    def _follows_lost_ones(self, owed: int, offset_ns: int, position_error: Callable[[int], float] | None) -> bool:
        """Return whether a frame without counter answers the last SYNC, so that answers to earlier SYNCs were lost.

        `owed`: number of SYNCs since the last answered one. The position decides if its errors over one and over `owed`
        periods differ by more than CLEAR_RAD. Else the time does: True if the frame comes no later after SYNC than
        usual.
        """
        advantage_rad = 0.0 if position_error is None else position_error(1) - position_error(owed)
        if abs(advantage_rad) > CLEAR_RAD:
            return advantage_rad > 0.0
        return self._is_usual(offset_ns)

    def take_straggler(self, behind: int) -> bool:
        """Return whether a frame that answers no new SYNC is a delayed answer; note it, so that a second call is False.

        `behind`: how far its counter is behind the last answer's; the answer with that counter must be missing. 0: no
        counter; then the frame is a delayed answer if the last answer was a guess.
        """
        if behind == 0:
            was_guess, self._is_guess = self._is_guess, False
            return was_guess
        is_missing = bool(self._unanswered >> behind & 1)
        self._unanswered &= ~(1 << behind)
        return is_missing

    def keep(self, ordinal: int, values: tuple[float, ...]) -> None:
        """Store the values that the device sampled on the SYNC `ordinal`, in place of those of KEPT SYNCs earlier."""
        self._kept[ordinal % KEPT] = ordinal, values

    def values_of(self, ordinal: int) -> tuple[float, ...] | None:
        """Return the values sampled on the SYNC `ordinal`; None if they did not come or are no longer stored."""
        answered, values = self._kept[ordinal % KEPT]
        return values if answered == ordinal else None

    def set_answered(self, ordinal: int, newest: int, offset_ns: int, is_counted: bool) -> None:
        """Set `ordinal` as the last answered SYNC, and note the SYNCs skipped before it as unanswered.

        The first USUAL_ANSWERS answers in time, without the very first, also set the device's usual time to an answer;
        an answer without a counter after skipped SYNCs is a guess, which doesn't. newest: ordinal of the last SYNC
        before the answer, which came offset_ns after it. is_counted: whether the frame has a counter.
        """
        before, self.answered = self.answered, ordinal
        if before is not None and ordinal > before:
            passed = ordinal - before
            self._unanswered = (self._unanswered << passed | (1 << passed) - 2) & _MASK
        self._is_guess = not is_counted and before is not None and before < newest - 1 and ordinal == newest
        if ordinal != newest or self._is_guess or self._usual_count >= USUAL_ANSWERS or before is None:
            return
        if not self._usual_count:
            self.earliest_ns = self._latest_ns = offset_ns
        self.earliest_ns = min(self.earliest_ns, offset_ns)
        self._latest_ns = max(self._latest_ns, offset_ns)
        self._usual_count += 1

    def begin_anew(self, newest: int) -> None:
        """Count every SYNC up to `newest` as answered: the device restarted its counter."""
        self.answered = newest
        self._is_guess = False
        self._unanswered = 0


def newest_sample(clocks: Sequence[AnswerClock], last: int, after: int) -> tuple[int, list[tuple[float, ...]]] | None:
    """Return the ordinal of the newest SYNC that all devices have answered, and each device's values; None without one.

    clocks: of the devices. Only SYNCs with ordinals after `after` and up to `last` are considered, of these the last
    KEPT.
    """
    for ordinal in range(last, max(after, last - KEPT), -1):
        values = [found for clock in clocks if (found := clock.values_of(ordinal)) is not None]
        if len(values) == len(clocks):
            return ordinal, values
    return None
