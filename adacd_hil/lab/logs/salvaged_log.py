"""The trusted records of all parts of a log, for `recover` and `cut`: see salvage.py."""

from collections.abc import Callable, Iterator
from pathlib import Path

from mcap.records import Attachment, Metadata

from adacd_hil.lab.logs.salvage import Losses, Salvage
from adacd_hil.log.log_files import ENDING_KEY, PART_KEY, RUN_METADATA, SUMMARY_METADATA, LogError
from adacd_hil.log.log_parts import DROPPED_KEY, missing_parts, parts_of, summary_count
from adacd_hil.log.mcap.chunks import Contents
from adacd_hil.log.mcap.mcap_records import Definitions


class SalvagedLog:
    """The trusted records of all parts of a log. Iterate once for chunks and, of each name, the first attachment.

    `metadata`, by name the first of each but the summary, and `definitions`, those of the present part, fill up on the
    way; then `losses` is complete. A part of another run is left out from its metadata on, and named as missing.
    Iterating raises LogError if a file can't be read, or if no record of the log can be trusted.
    """

    def __init__(self, path: Path, progress: Callable[[str], None] = lambda _: None) -> None:
        self.path = path
        self.parts = parts_of(path)
        self.definitions = Definitions()
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: set[str] = set()
        self.losses = Losses()
        self.dropped = 0
        """Packets that the parts say are not in them."""
        self.ending = ""
        """Of the last part, as it says."""
        self._progress = progress
        self._is_run_vouched = False

    def __iter__(self) -> Iterator[Attachment | Contents]:
        has_messages = False
        foreign = []
        for part in self.parts.values():
            self._progress(f"reading {part.name}")
            salvage = Salvage(part)
            self.definitions, self.ending = salvage.definitions, ""
            for item in salvage:
                if isinstance(item, Metadata):
                    if self._is_foreign(item, salvage.is_vouched):
                        foreign.append(f"{part.name} (of another run)")
                        break
                    self._take_metadata(item, salvage.is_vouched)
                elif isinstance(item, Attachment):
                    if item.name not in self.attachments:
                        self.attachments.add(item.name)
                        yield item
                else:
                    has_messages |= len(item.starts) > 0 and bool(self.definitions.channels)
                    yield item
            else:
                self.losses.add_losses(salvage.losses)
        if not (has_messages or self.attachments or self.metadata):
            raise LogError(f"{self.path}: nothing to save")
        missing = missing_parts(self.path, self.parts, self.ending)
        self.losses.missing_parts = [*(part.name for part in missing), *foreign]

    def _is_foreign(self, item: Metadata, is_vouched: bool) -> bool:
        """Return whether a part's metadata show that it is of another run than the parts before.

        False for other metadata than the run's. item: the metadata; is_vouched: a CRC vouches for them. The part's
        number may differ. A single entry that differs counts only if CRCs vouch for both, since it may be damaged.
        """
        if item.name != RUN_METADATA:
            return False
        mine, theirs = (
            {pair for pair in table.items() if pair[0] != PART_KEY}
            for table in (self.metadata.get(RUN_METADATA, item.metadata), item.metadata)
        )
        return mine != theirs and ((self._is_run_vouched and is_vouched) or len(mine - theirs) > 1)

    def _take_metadata(self, item: Metadata, is_vouched: bool) -> None:
        if item.name == SUMMARY_METADATA:
            self.dropped += summary_count(item.metadata, DROPPED_KEY)
            self.ending = item.metadata.get(ENDING_KEY, "")
        elif item.name not in self.metadata:
            self.metadata[item.name] = item.metadata
            self._is_run_vouched |= is_vouched and item.name == RUN_METADATA
