"""What the user has asked for and not got: it outlives a fault that is acknowledged."""

from collections.abc import Iterable

from adacd_hil.records import Request, SchemeState
from adacd_hil.scheme.supervisor.supervisor import KEPT_IN


class KeptRequest:
    """The end of the run, or a stop to change the payload, until it is served. One object per attempt.

    carried: what the attempt before has left; it is asked once the drives are enabled again.
    """

    def __init__(self, carried: Request = Request.NONE) -> None:
        self.request = carried
        self._carried = carried

    def take(self) -> Request:
        """Return what the attempt before has left, once; then NONE."""
        carried, self._carried = self._carried, Request.NONE
        return carried

    def ask(self, request: Request, state: SchemeState) -> None:
        """Take note of a request; state: that of the cycle before."""
        is_kept = request is Request.FINISH or (request is Request.PAYLOAD and state in KEPT_IN[request])
        if is_kept and self.request is not Request.FINISH:
            self.request = request

    def serve(self, states: Iterable[int]) -> None:
        """Take note of the states that cycles have led to."""
        if self.request is Request.PAYLOAD and SchemeState.PAYLOAD in states:
            self.request = Request.NONE
