"""Topics of a log, and the numpy layout of their message records where these have a fixed size."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel, Schema

from adacd_hil.log.mcap.mcap_records import MESSAGE_HEAD


class Payload(NamedTuple):
    """The layout of a topic's payloads. `has_tail`: they end in bytes, counted by the field `count`, that fill `data`.

    Records of such payloads are padded with zeros to those with the longest tail.
    """

    dtype: "np.dtype[Any]"
    has_tail: bool = False


PayloadLayout = Callable[[Channel, Schema], Payload | None]
"""Describes the payloads of a channel; None where their size varies otherwise."""


def record_dtype(payload: "np.dtype[Any]") -> "np.dtype[Any]":
    """Describe a whole message record with such a payload."""
    assert payload.names is not None
    assert payload.fields is not None
    fields = [payload.fields[name] for name in payload.names]
    layout = {
        "names": ["record_length", "log_time", "publish_time", *payload.names],
        "formats": ["<u8", "<u8", "<u8", *(field[0] for field in fields)],
        "offsets": [1, 15, 23, *(MESSAGE_HEAD + int(field[1]) for field in fields)],
        "itemsize": MESSAGE_HEAD + payload.itemsize,
    }
    return np.dtype(layout)  # type: ignore[call-overload,no-any-return]


class Topic(NamedTuple):
    """A topic of messages."""

    name: str
    type_name: str
    dtype: "np.dtype[Any] | None"  # of its records; None where their size varies
    has_tail: bool

    @classmethod
    def of(cls, name: str, type_name: str, payload: Payload | None) -> "Topic":
        """Describe a topic by its payloads."""
        if payload is None:
            return cls(name, type_name, None, has_tail=False)
        return cls(name, type_name, record_dtype(payload.dtype), payload.has_tail)
