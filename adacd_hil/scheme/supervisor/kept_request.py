"""The end of the run, or a stop to change the payload, kept until it is served, also beyond an acknowledged fault."""

from collections.abc import Iterable

from adacd_hil.records import Request, SchemeState
from adacd_hil.scheme.supervisor.supervisor import KEPT_IN


class KeptRequest:
    """The request that is kept, or NONE. One object per attempt.

    carried: request left over from the attempt before; it is repeated once the drives are enabled again.
    """

    def __init__(self, carried: Request = Request.NONE) -> None:
        self.request = carried
        self._carried = carried

    def take_carried(self) -> Request:
        """Return the request left over from the attempt before, once; then NONE."""
        carried, self._carried = self._carried, Request.NONE
        return carried

    def ask(self, request: Request, state: SchemeState) -> None:
        """Keep a request to finish, or to change the payload in a state in which it waits; ignore all others.

        Such states are in `KEPT_IN`. A request replaces the kept one, but nothing replaces FINISH. state: that of the
        cycle before.
        """
        is_kept = request is Request.FINISH or (request is Request.PAYLOAD and state in KEPT_IN[request])
        if is_kept and self.request is not Request.FINISH:
            self.request = request

    def serve(self, states: Iterable[int]) -> None:
        """Drop a kept request to change the payload if `states`, those of the last cycles, contain PAYLOAD."""
        if self.request is Request.PAYLOAD and SchemeState.PAYLOAD in states:
            self.request = Request.NONE
