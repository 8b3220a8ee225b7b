"""The walk over message records, compiled and without the GIL: each record goes where it is wanted, or nowhere.

Bytes are read and written eight at a time through views of int64 at every byte, `words`: words[p] are the bytes p to
p + 7, little endian. A record: opcode, length (uint64), channel (uint16), sequence (uint32), log time and publish time
(uint64), payload; MCAP specification, Message. A bus frame: reader.FRAME_DTYPE or LONG_FRAME_DTYPE.
"""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled

Numbers: TypeAlias = NDArray[np.int64]
Bytes: TypeAlias = NDArray[np.uint8]

MESSAGE = 5
RECORD_HEAD = 9
HEAD = 31
WORD = 8

# Why `take` stops, and what is to be done with a record.
DONE, CUT, DEFINITION, UNDEFINED, VARYING, FULL, FRAMES_FULL, LONG, BROKEN, WANTED, NOT_WANTED = range(11)

# What `take` keeps from call to call, in `state`.
POSITION = 0  # in the block
LATEST_NS = 1  # highest publish time so far
CYCLES = 2  # of the piece: how often that time has risen
MOST_CYCLES = 3
FRAMES = 4  # of the piece
WRONG = 5  # messages that weren't as long as their schema says
CULPRIT = 6  # slot or channel because of which it stopped
STATE = 7

# What `take` knows of a topic, in its row of `slots`.
SIZE = 0  # of its records, bytes; of the longest where they vary by their tail
TAIL = 1  # where the tail begins; SIZE where there is none
COUNT = 2  # where the length of the tail is
KIND = 3
START = 4  # of its records in the arena
ROOM = 5  # how many records that holds
FILLED = 6
SLOT = 7

# Kinds of topics, bits.
IS_RECORDS = 1  # records are gathered
IS_VARYING = 2  # payloads are gathered, by the caller
IS_FRAME = 4  # frames are gathered
IS_SENT = 8  # by the host
IS_LONG = 16  # FD

# Channels that are no number of a slot.
UNKNOWN = -1
UNWANTED = -2

FRAME_DATA = 23
"""Where the data of a bus frame begin."""


@compiled(nogil=True)
def take(  # noqa: PLR0912, PLR0915 - functions that are handed arrays count references, which costs more than the walk
    data: Bytes,
    words: Numbers,
    end: int,
    channels: Numbers,
    slots: Numbers,
    arena: Bytes,
    arena_words: Numbers,
    frames: Bytes,
    frame_words: Numbers,
    frame_bytes: int,
    frame_places: Numbers,
    epoch_ns: int,
    state: Numbers,
) -> int:
    """Walk over records from state[POSITION] up to `end`, or until something is for the caller to do; return why.

    data: at least WORD bytes longer than `end`; channels: slot of each channel (65536,); arena, frames: what is
    gathered; frame_bytes: size of a bus frame; frame_places: where a record of a short and of a long frame has can_id,
    is_error, length and data (2, 4).
    """
    position = state[POSITION]
    reason = DONE
    while position < end:
        left = end - position
        length = words[position + 1] if left >= RECORD_HEAD else -1
        if length < 0 or length > left - RECORD_HEAD:
            reason = BROKEN
            break
        size = RECORD_HEAD + length
        if data[position] != MESSAGE:
            reason = DEFINITION
            break
        if size < HEAD:
            state[WRONG] += 1
            position += size
            continue
        publish_ns = words[position + 23]
        if publish_ns > state[LATEST_NS]:
            if state[CYCLES] == state[MOST_CYCLES]:
                reason = CUT
                break
            state[CYCLES] += 1
            state[LATEST_NS] = publish_ns
        channel = words[position + 9] & 0xFFFF
        slot = channels[channel]
        if slot == UNWANTED:
            position += size
            continue
        if slot == UNKNOWN:
            state[CULPRIT] = channel
            reason = UNDEFINED
            break
        state[CULPRIT] = slot
        kind = slots[slot, KIND]
        if kind & IS_VARYING:
            reason = VARYING
            break
        tail = slots[slot, TAIL]
        most = slots[slot, SIZE]
        count = size - tail
        is_right = size == most
        if tail < most:
            is_right = 0 <= count <= most - tail and words[position + slots[slot, COUNT]] & 0xFFFFFFFF == count
        if not is_right:
            state[WRONG] += 1
            position += size
            continue
        if kind & IS_FRAME:
            place = state[FRAMES] * frame_bytes
            if place + frame_bytes > len(frames) - WORD:
                reason = FRAMES_FULL
                break
            is_long = 1 if kind & IS_LONG else 0
            if is_long and frame_bytes == FRAME_DATA + WORD:
                reason = LONG
                break
        if kind & IS_RECORDS and slots[slot, FILLED] == slots[slot, ROOM]:
            reason = FULL
            break
        if kind & IS_FRAME:
            stamp = words[position + HEAD + 4]
            start = position + frame_places[is_long, 3]
            frame_words[place] = (stamp & 0xFFFFFFFF) * 1_000_000_000 + ((stamp >> 32) & 0xFFFFFFFF) - epoch_ns
            frame_words[place + 8] = publish_ns - epoch_ns
            frame_words[place + 16] = words[position + frame_places[is_long, 0]]
            frames[place + 20] = 1 if kind & IS_SENT else 0
            frames[place + 21] = data[position + frame_places[is_long, 1]]
            frames[place + 22] = data[position + frame_places[is_long, 2]]
            count = position + size - start
            if count == WORD:
                frame_words[place + FRAME_DATA] = words[start]
            else:
                for index in range(count):
                    frames[place + FRAME_DATA + index] = data[start + index]
            for index in range(place + FRAME_DATA + count, place + frame_bytes):
                frames[index] = 0
            state[FRAMES] += 1
        if kind & IS_RECORDS:
            place = slots[slot, START] + slots[slot, FILLED] * most
            last = size - WORD
            for offset in range(0, last, WORD):
                arena_words[place + offset] = words[position + offset]
            arena_words[place + last] = words[position + last]
            for index in range(place + size, place + most):
                arena[index] = 0
            slots[slot, FILLED] += 1
        position += size
    state[POSITION] = position
    return reason


@compiled
def whole_size(words: Numbers, position: int, end: int) -> int:
    """Return how many bytes the record at `position` has; 0 when it isn't whole up to `end`."""
    if end - position < RECORD_HEAD:
        return 0
    length = words[position + 1]
    return RECORD_HEAD + length if 0 <= length <= end - position - RECORD_HEAD else 0


@compiled(nogil=True)
def pass_over(data: Bytes, words: Numbers, position: int, end: int, is_passed: NDArray[np.bool_]) -> int:
    """Return where the first record from `position` on is that isn't to be passed over, or isn't whole up to `end`.

    is_passed: by opcode (256,).
    """
    while position < end and is_passed[data[position]]:
        size = whole_size(words, position, end)
        if size == 0:
            break
        position += size
    return position


def words_of(data: Bytes) -> Numbers:
    """View bytes as an integer of eight bytes at every byte."""
    words: NDArray[Any] = np.ndarray((len(data) - WORD + 1,), np.int64, data, strides=(1,))
    return words
