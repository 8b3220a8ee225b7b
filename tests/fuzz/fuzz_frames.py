"""Legal traffic of one arm, and seeded streams of random and damaged frames made from it."""

import random
from collections.abc import Iterator, Sequence
from pathlib import Path

from rig import SessionRig

from adacd_hil.clock import VirtualClock
from adacd_hil.control.session import SessionSummary
from adacd_hil.log.reader import read_log
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.embedded_bus import EmbeddedBus

CanFrame = tuple[int, bytes]
SHORT_RUN = '[operator]\nscript = [{ at_s = 0.3, request = "finish" }]\n'


def play_short_run(folder: Path, bus: EmbeddedBus | None = None, clock: VirtualClock | None = None) -> SessionSummary:
    """Boot, enable and move the emulated arm for 0.3 s, on a bus that may be given; its log is in the folder."""
    (folder / "short.toml").write_text(SHORT_RUN)
    settings = load_settings(str(folder / "short.toml"))
    return SessionRig(folder, settings, bus=bus, clock=clock).session.run()


def record_legal_traffic(folder: Path) -> list[CanFrame]:
    """Return every frame of a short run: NMT, SDO, SYNC, heartbeats, status, the way to Operation enabled, torque."""
    frames = read_log(play_short_run(folder).log.path).frames
    return [(int(frame["can_id"]), bytes(frame["data"][: frame["length"]])) for frame in frames]


def damaged(legal: Sequence[CanFrame], seed: int, longest: int = 8) -> Iterator[CanFrame]:
    """Yield what `fuzz` yields without any frame that is a legal one unchanged."""
    known = set(legal)
    return (frame for frame in fuzz(legal, seed, longest) if frame not in known)


def fuzz(legal: Sequence[CanFrame], seed: int, longest: int = 8) -> Iterator[CanFrame]:
    """Yield frames without end, in equal shares:

    random identifier, length (0…`longest`) and bytes; a legal identifier with random bytes, half of them in the legal
    length; a legal frame with one to four flipped bits, identifier included; a legal frame cut or lengthened; a legal
    frame again, out of its order. Legal identifiers are chosen evenly, so that rare frames aren't rare here.
    """
    dice = random.Random(seed)
    by_id: dict[int, list[bytes]] = {}
    for can_id, data in dict.fromkeys(legal):
        by_id.setdefault(can_id, []).append(data)
    ids = sorted(by_id)
    while True:
        kind = dice.randrange(5)
        if kind == 0:
            yield dice.getrandbits(11), dice.randbytes(dice.randint(0, longest))
            continue
        can_id = dice.choice(ids)
        data = dice.choice(by_id[can_id])
        if kind == 1:
            yield can_id, dice.randbytes(len(data) if dice.getrandbits(1) else dice.randint(0, longest))
        elif kind == 2:
            yield _flip(can_id, data, dice)
        elif kind == 3:
            yield can_id, (data + dice.randbytes(longest))[: dice.randint(0, longest)]
        else:
            yield can_id, data


def _flip(can_id: int, data: bytes, dice: random.Random) -> CanFrame:
    bits = 8 * len(data)
    flipped = bytearray(data)
    for _ in range(dice.randint(1, 4)):
        bit = dice.randrange(bits + 11)
        if bit < bits:
            flipped[bit // 8] ^= 1 << bit % 8
        else:
            can_id ^= 1 << (bit - bits)
    return can_id, bytes(flipped)


def foreign(frames: Iterator[CanFrame], known: frozenset[int]) -> Iterator[CanFrame]:
    """Pass the frames whose identifier isn't known."""
    return (frame for frame in frames if frame[0] not in known)
