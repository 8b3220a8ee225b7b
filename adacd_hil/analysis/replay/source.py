"""Where a replay gets its cycles from: the stretches of a log of ours, with what was attached to it.

Settings, contract and torque offsets are those that are attached to the log.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

from adacd_hil.analysis.replay.attempts import AttemptSplitter, Stretch
from adacd_hil.analysis.replay.scheme_comparison import SHOWN, contact_records
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import LoggedEvent, LogStream, Piece, begin_of_log
from adacd_hil.records import CERTIFICATE_EVENTS
from adacd_hil.settings.configuration import Settings, renewed
from adacd_hil.settings.schema import parse
from adacd_hil.settings.toml_files import parse_toml
from adacd_hil.wire.codec import Codec, parse_codec

FRAME_TOPICS: Final = ("/to_can_bus", "/from_can_bus", "/to_can_bus_fd", "/from_can_bus_fd")
TOPICS: Final = (*FRAME_TOPICS, "/scheme", "/cycle", "/contact", "/events")
CYCLES_PER_PIECE: Final = 20_000
_SAID_BEFORE_ANCHORS: Final = frozenset({"margin"})
_SAID: Final = _SAID_BEFORE_ANCHORS | CERTIFICATE_EVENTS
"""Names of the events that the scheme itself says."""


class Source(Protocol):
    """Where stretches come from: a log of ours, or a recording by others. Iterated once; notes are complete then."""

    settings: Settings
    codec: Codec
    metadata: Mapping[str, str]

    def __iter__(self) -> Iterator["Part"]:
        """Give the parts, in order."""

    @property
    def start_ns(self) -> int:
        """When it begins, ns of the clock of its cycles."""

    def notes(self) -> list[str]:
        """Say what is missing."""


class Part(NamedTuple):
    """What one piece of a log holds. contacts: logged reports by time, ns; events: of the names in `said`."""

    stretches: Iterable[Stretch]
    contacts: Mapping[int, Mapping[str, Any]]
    events: Sequence[LoggedEvent]
    said: frozenset[str]


class LogSource:
    """A log of ours."""

    def __init__(self, path: Path, cycles_per_piece: int = CYCLES_PER_PIECE) -> None:
        """Open the log. Raises LogError, ConfigError, CodecError."""
        self._stream = LogStream(path, TOPICS, cycles_per_piece)
        self._path = path
        self.metadata: Mapping[str, str] = self._stream.metadata
        self.settings = settings_of(path, self._stream.attachments)
        self.codec = codec_of(path, self._stream.attachments)
        self._said = _SAID if _has_anchors(self._stream.attachments) else _SAID_BEFORE_ANCHORS
        self._splitter = AttemptSplitter(self._stream.epoch_ns)

    def __iter__(self) -> Iterator[Part]:
        """Give the parts, in order."""
        for read in self._stream:
            piece = self._piece(read)
            events = [logged for logged in self._stream.events(piece) if logged.event.name in self._said]
            yield Part(self._splitter.split(piece), contact_records(piece.series["/contact"]), events, self._said)

    @property
    def start_ns(self) -> int:
        """When the log's first message was, ns of the run's clock. Raises LogError."""
        return begin_of_log(self._path)

    def _piece(self, piece: Piece) -> Piece:
        """Return what is to be replayed of a piece: all of it."""
        return piece

    def notes(self) -> list[str]:
        """Say what is missing."""
        splitter = self._splitter
        notes = [f"the log is not whole: {self._stream.problem}"] if self._stream.problem else []
        dropped = self._stream.summary.get("dropped", "0")
        if dropped != "0":
            notes.append(f"{dropped} packets never reached the log")
        if splitter.headless_cycles:
            notes.append(
                f"{splitter.headless_cycles} cycles at its beginning can't be replayed: the attempt began before"
            )
        for gap in splitter.gaps[:SHOWN]:
            notes.append(
                f"{gap.missing} cycles with their frames are missing before cycle {gap.cycle}: what follows in that "
                "attempt is replayed but can't be compared"
            )
        if len(splitter.gaps) > SHOWN:
            notes.append(f"and {len(splitter.gaps) - SHOWN} more gaps")
        if splitter.unpaired:
            notes.append(f"{splitter.unpaired} records of /scheme or /cycle lack the other one of their cycle")
        return notes


def settings_of(path: Path, attachments: Mapping[str, bytes]) -> Settings:
    """Read the settings that a run had. Raises LogError."""
    if "config.toml" not in attachments:
        raise LogError(f"log {path} has no attachment config.toml: its settings are not known")
    try:
        return parse(Settings, renewed(parse_toml(attachments["config.toml"])))
    except ValueError as error:  # what is wrong with the text, the TOML or a setting is a ValueError each
        raise LogError(f"log {path}, attachment config.toml: {error}") from None


def codec_of(path: Path, attachments: Mapping[str, bytes]) -> Codec:
    """Generate the codec of the DBC that a run had. Raises LogError, CodecError."""
    if "arm.dbc" not in attachments:
        raise LogError(f"log {path} has no arm.dbc attached: its frames can't be decoded")
    return parse_codec(attachments["arm.dbc"], path.with_name("arm.dbc"))


def _has_anchors(attachments: Mapping[str, bytes]) -> bool:
    """Tell whether the run that the settings are of knew anchors: since then they say how a zero drifts."""
    tare = parse_toml(attachments["config.toml"]).get("tare")
    return isinstance(tare, dict) and "drift_Nm_sqrt_s" in tare
