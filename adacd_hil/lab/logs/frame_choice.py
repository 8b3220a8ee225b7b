"""Frames of a recording, chosen by sender, identifier and time."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from adacd_hil.wire.codec import Codec
from adacd_hil.wire.dbc_decoder import DbcDecoder

Side = Literal["host", "devices", "both"]
HOST: Final = "HOST"
"""Name of the host among a DBC's nodes."""


@dataclass(frozen=True)
class FrameChoice:
    """A choice of frames by sender, identifier and time.

    `only`: whose frames. The contract's `host_ids` and `device_ids` give the sender; for other identifiers, and for
    error and remote frames, the direction does: frames sent are the host's. `start_ns`, `end_ns` count from the first
    frame of the recording, None: no bound; `can_ids` empty: all.
    """

    only: Side
    host_ids: frozenset[int]
    device_ids: frozenset[int]
    can_ids: frozenset[int]
    start_ns: int | None
    end_ns: int | None

    def pieces(self, source: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
        """Yield the chosen frames of each array of a recording's frames, in turn; arrays without any are skipped.

        Times count from the first frame of the first array that isn't empty. A frame at `start_ns` is in, one at
        `end_ns` out.
        """
        first_ns = None
        for frames in source:
            if first_ns is None and len(frames):
                first_ns = int(frames["t_ns"][0])
            chosen = frames[self._is_chosen(frames, first_ns or 0)]
            if len(chosen):
                yield chosen

    def _is_chosen(self, frames: NDArray[Any], first_ns: int) -> NDArray[np.bool_]:
        t_ns = frames["t_ns"] - first_ns
        is_chosen = np.ones(len(frames), np.bool_)
        if self.start_ns is not None:
            is_chosen &= t_ns >= self.start_ns
        if self.end_ns is not None:
            is_chosen &= t_ns < self.end_ns
        if self.can_ids:
            is_chosen &= np.isin(frames["can_id"], list(self.can_ids))
        if self.only != "both":
            is_hosts = self._is_hosts(frames)
            is_chosen &= is_hosts if self.only == "host" else ~is_hosts
        return is_chosen

    def _is_hosts(self, frames: NDArray[Any]) -> NDArray[np.bool_]:
        """Return which frames (n,) are the host's: by the identifier, else those that the recorder sent.

        Error and remote frames go by the latter alone.
        """
        is_known = ~frames["is_error"] & ~frames["is_remote"]
        is_host = is_known & np.isin(frames["can_id"], list(self.host_ids))
        is_device = is_known & np.isin(frames["can_id"], list(self.device_ids))
        return np.asarray(is_host | (frames["is_tx"] & ~is_device))


def sides(codec: Codec | DbcDecoder) -> tuple[frozenset[int], frozenset[int]]:
    """Return the identifiers that a contract's host sends, and all others: those that its devices send."""
    return (
        frozenset(message.can_id for message in codec.messages.values() if HOST in message.senders),
        frozenset(message.can_id for message in codec.messages.values() if HOST not in message.senders),
    )
