"""Replay: the arm's states of a log once more through the scheme, and the result beside the log.

The log has the states in /arm and /scheme. Its frames are decoded by the arm's live classes where it lacks them, as
logs of earlier versions and recordings do, where other settings of the arm would make other states of the frames, and
where that is to be proved: then each state is compared with the logged one, too.

The log is read in pieces, in constant memory. Each attempt of the run has an arm and a pipeline of its own, as it had
on the arm. The log has the user's requests and the motion of the arm: a replay with other settings decides otherwise
about the same motion.

A replay of a stretch begins with the log too, because the state of filters and model depends on the cycles before. It
ends with the stretch, and compares and reports only the cycles in it.
"""

from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.device.recorded_arm import RecordedArm, Ticks
from adacd_hil.log.log_files import SCRIPTED, SHOWN, LogError
from adacd_hil.log.logged_run import Milestones, Mismatch, Progress, is_armed_in
from adacd_hil.log.time_window import EVER_NS, WHOLE, TimeWindow
from adacd_hil.log.types.topics import SCHEME
from adacd_hil.printable import number_of
from adacd_hil.records import MOTION_START, ArmBatch, Event, Request
from adacd_hil.replay.can_recording import RecordingAlone
from adacd_hil.replay.log_source import SAID, CycleStretch, LogSource, Part
from adacd_hil.replay.replayed_outcome import OutcomeGatherer, Replay
from adacd_hil.replay.scheme_comparison import (
    TOLERANCE,
    Asking,
    SchemeComparison,
    ScriptOf,
    different_arithmetic,
)
from adacd_hil.scheme.pipeline.new_pipeline import new_pipeline
from adacd_hil.scheme.pipeline.pipeline import Pipeline, SchemeBatch
from adacd_hil.score.emulator_truth import KnownTruth, contacts_beside
from adacd_hil.score.wording import unjudged_sentence
from adacd_hil.settings.configuration import Settings

_PROGRESS_CYCLES: Final = 200_000
_OTHER_FRAMES: Final = "a setting is another by which the arm takes its frames: they are decoded, which takes longer"
_NO_ARM: Final = (
    "the log has no /arm, as an older one or one without a cycle: its frames are decoded, which takes longer"
)

ReplaySource = LogSource | RecordingAlone
Watch = Callable[[int, Ticks, SchemeBatch], None]
"""Is shown the decisions of each variant, by its place among them, as they are made."""


def replay(path: Path, script_of: ScriptOf | None = None) -> Replay:
    """Replay a log with its own settings, compare the decisions with the log's, and return the outcome.

    Behind missing cycles, decisions of the same attempt are not compared. The emulator's own log beside the log, if
    there is one, gives the true contacts for the score. script_of: plays the user of a configuration; with it, the
    requests of a run without typed requests are compared. Raises LogError, ConfigError or CodecError if the log, its
    attachments or a device can't be read.
    """
    source, remarks = LogSource(path), list[str]()
    truth = contacts_beside(path, remarks.append)
    return replay_source(source, [source.settings], truth, script_of=script_of, remarks=remarks)[0]


def replay_many(
    path: Path,
    variants: Sequence[Settings],
    progress: Progress = lambda _: None,
    *,
    watch: Watch | None = None,
    stretch: TimeWindow = WHOLE,
) -> list[Replay]:
    """Replay a log, or a stretch of it, once for each of the settings; the log is read once.

    Its frames are decoded once for all settings that decode alike, if at all. Only settings equal to the log's are
    compared with it. progress: prints a line about the work. watch: called with the decisions of each variant. Raises
    LogError, ConfigError or CodecError if the log, its attachments or a device can't be read; LogError also if no cycle
    of the stretch can be replayed.
    """
    source, remarks = LogSource(path), list[str]()
    truth = contacts_beside(path, remarks.append)
    return replay_source(source, variants, truth, progress, watch=watch, stretch=stretch, remarks=remarks)


_DecodedPart = tuple[Part, list[list[ArmBatch]]]
"""A part of a log, and the states of each of its stretches, for each of the variants."""


class _Player:
    """The replay of one variant, stretch by stretch. asking: plays the script, None without one.

    comparison: with the log, None if it isn't compared. checks_arms: its states were decoded, and are compared with the
    log's, too.
    """

    def __init__(
        self,
        settings: Settings,
        truth: KnownTruth | None,
        comparison: SchemeComparison | None,
        asking: Asking | None,
        checks_arms: bool,
    ) -> None:
        self.settings = settings
        self.cycles = self.monitored = self.uncovered = 0  # in the stretch; uncovered: monitored without the truth
        self.comparison = comparison
        self.gatherer = OutcomeGatherer(settings, truth)
        self.attempts = 0
        self._asking = asking
        self._checks_arms = checks_arms
        self._pipeline: Pipeline  # of the attempt, with which the first stretch begins

    def play(self, stretch: CycleStretch, arms: ArmBatch, part: Part, is_told: bool) -> SchemeBatch:
        """Run the scheme on the cycles of `stretch`, in piece `part` of the log; gather and return its decisions.

        arms: the arm's states in these cycles (n,). is_told: the cycles are reported: compare and count them, too.
        """
        ticks = stretch.ticks
        if stretch.is_begin:
            self._begin()
            self.gatherer.begin_attempt(stretch.attempt, int(ticks.cycle[0]))
        batch = self._run(stretch, arms)
        events = self._pipeline.take_events()
        self.gatherer.add_stretch(ticks, batch, stretch.follows_gap)
        asked = None
        if self._asking is not None and stretch.requests is not None and stretch.is_exact:
            asked = self._asking.requests(ticks, batch, stretch.requests)
        if is_told:
            self.cycles += len(ticks.cycle)
            monitored = ticks.cycle[is_armed_in(batch.state)]
            self.monitored += len(monitored)
            self.uncovered += int(np.count_nonzero(self.gatherer.uncovered(monitored)))
            self._compare(stretch, arms, batch, asked, part, events)
        return batch

    def _compare(
        self,
        stretch: CycleStretch,
        arms: ArmBatch,
        batch: SchemeBatch,
        asked: NDArray[np.uint8] | None,
        part: Part,
        events: Sequence[Event],
    ) -> None:
        """Compare the decisions about a stretch's cycles with the log, and the requests, reports and events in them.

        Compare states that were decoded from frames, too. Do nothing if this variant isn't compared, or the log lacks
        its decisions, requests, or earlier cycles of the attempt. asked: requests of the script (n,); None: each logged
        one that is a Request is believed.
        """
        if self.comparison is None or not stretch.is_exact or stretch.scheme is None or stretch.requests is None:
            return
        ticks = stretch.ticks
        if self._checks_arms and stretch.arms is not None:
            self.comparison.compare_arms(stretch.arms, arms, ticks)
        self.comparison.compare(stretch.scheme, ticks, batch)
        if asked is None:  # whatever a user could ask is believed
            asked = _known(stretch.requests)
        self.comparison.compare_requests(ticks, stretch.requests, asked)
        first_ns, last_ns = ticks.t_ns[[0, -1]].tolist()
        reports = {t_ns: fields for t_ns, fields in part.contacts.items() if first_ns <= t_ns <= last_ns}
        self.comparison.compare_contacts(reports, ticks, batch)
        logged = [event for event in part.events if first_ns <= event.t_ns <= last_ns]
        replayed = [event for event in events if event.name in SAID]
        self.comparison.compare_events(logged, replayed, ticks)

    def _begin(self) -> None:
        """Begin an attempt: a new pipeline in INIT, and a new attempt of the script."""
        self._pipeline = new_pipeline(self.settings)
        self.attempts += 1
        if self._asking is not None:
            self._asking.begin_attempt()

    def _run(self, stretch: CycleStretch, arms: ArmBatch) -> SchemeBatch:
        """Run the scheme on a stretch and return its decisions, with the logged requests.

        If the requests are unknown, the script makes them, cycle by cycle.
        """
        if stretch.requests is not None:
            return self._pipeline.run(arms, _known(stretch.requests))
        assert self._asking is not None
        batches = []
        for row, cycle in enumerate(stretch.ticks.cycle.tolist()):
            before = self._pipeline.state
            request = self._asking.ask(cycle, before)
            batches.append(self._pipeline.run(_arms_of(arms, slice(row, row + 1)), np.array([request], np.uint8)))
            self._asking.note_request(cycle, request, before, self._pipeline.state)
        return _joined(batches)


def _joined(batches: Sequence[SchemeBatch]) -> SchemeBatch:
    """Return batches of one cycle each as one."""
    names = set(SchemeBatch._fields) - {"contacts", "contact_places"}
    columns: dict[str, Any] = {name: np.concatenate([getattr(batch, name) for batch in batches]) for name in names}
    return SchemeBatch(
        **columns,
        contacts=[report for batch in batches for report in batch.contacts],
        contact_places=np.flatnonzero([len(batch.contacts) for batch in batches]),
    )


def replay_source(
    source: ReplaySource,
    variants: Sequence[Settings],
    truth: KnownTruth | None = None,
    progress: Progress = lambda _: None,
    tolerance: float | None = None,
    script_of: ScriptOf | None = None,
    shown: int = SHOWN,
    watch: Watch | None = None,
    stretch: TimeWindow = WHOLE,
    by_frames: bool = False,
    remarks: Sequence[str] = (),
) -> list[Replay]:
    """Replay a source, once for each of the settings; shown: mismatches that are kept.

    Only settings equal to the source's are compared with the log. truth: the true contacts, None if unknown; remarks:
    on it, for the notes of each replay. progress: prints a line about the work. tolerance: of the comparison; None:
    exact, or `TOLERANCE` where the log's numbers were computed on another kind of machine. script_of: as for `replay`;
    a recording without a log needs it. stretch: the part that is compared and reported; watch sees all from the
    beginning of the log on. by_frames: decode the frames and compare each state with the log's. Raises LogError if the
    source can't be read, or no cycle of the stretch can be replayed; ConfigError if a device can't be loaded.
    """
    bounds_ns = EVER_NS if stretch.is_whole else stretch.bounds_ns(source.start_ns)
    if tolerance is None:
        tolerance = TOLERANCE if different_arithmetic(source.metadata) else 0.0
    is_scripted = source.metadata.get("operator", SCRIPTED if not source.metadata else "") == SCRIPTED
    players = []
    for settings in variants:
        comparison = SchemeComparison(settings, tolerance, shown) if settings == source.settings else None
        asking = Asking(settings, script_of) if is_scripted and script_of is not None else None
        players.append(_Player(settings, truth, comparison, asking, by_frames))
    reader = _ArmReader(source, variants, by_frames)
    if reader.needs_frames and not (by_frames or source.is_recording):
        progress(_OTHER_FRAMES if source.has_arms else _NO_ARM)
    done = 0
    milestones = Milestones(lambda count: progress(f"{count} cycles replayed"), _PROGRESS_CYCLES)
    for part in _one_ahead(_decoded(source, reader, bounds_ns[1])):
        done += _replay_part(part, players, bounds_ns, watch)
        milestones.reach(done)
    if not stretch.is_whole and not players[0].cycles:
        raise LogError(f"the log has no cycle {stretch.text} that can be replayed")
    notes = [*source.notes(), *remarks]
    if by_frames and not source.has_arms:
        notes.append("the log has no /arm: what its frames were taken for can't be compared, only the decisions")
    return [_result(player, source, notes, tolerance, bounds_ns[0]) for player in players]


def _decoded(source: ReplaySource, reader: "_ArmReader", end_ns: int) -> Generator[_DecodedPart]:
    """Yield the parts of a source with the arm's states, up to the stretch that reaches end_ns."""
    for part in source.parts(reader.needs_frames):
        stretches: list[CycleStretch] = []
        arms: list[list[ArmBatch]] = []
        is_over = False
        for stretch in part.stretches:
            stretches.append(stretch)
            arms.append(reader.read(stretch))
            is_over = bool(stretch.ticks.t_ns[-1] >= end_ns)
            if is_over:
                break
        yield part._replace(stretches=stretches), arms
        if is_over:
            return


def _one_ahead(parts: Generator[_DecodedPart]) -> Iterator[_DecodedPart]:
    """Yield the items of a generator that a thread runs one part ahead; most work of both needs no Python lock.

    That thread opens chunks, too: a third thread would take a twentieth more of two processors' time.
    """
    with closing(parts), ThreadPoolExecutor(1, "replay-reader") as thread:
        coming = thread.submit(next, parts, None)
        while (part := coming.result()) is not None:
            coming = thread.submit(next, parts, None)
            yield part


def _replay_part(
    decoded: _DecodedPart,
    players: Sequence[_Player],
    bounds_ns: tuple[int, int],
    watch: Watch | None,
) -> int:
    """Replay the cycles of a piece of the log with each player; return their number.

    bounds_ns: begin and end of the reported time, on the run's clock; cycles from the end on are not replayed, but
    count in the number. watch: called with each player's decisions.
    """
    cycles, (part, arms_of_part) = 0, decoded
    for stretch, all_arms in zip(part.stretches, arms_of_part, strict=True):
        for mine, rows, is_told in _split(stretch, bounds_ns):
            for place, (player, arms) in enumerate(zip(players, all_arms, strict=True)):
                batch = player.play(mine, _arms_of(arms, rows), part, is_told)
                if watch is not None:
                    watch(place, mine.ticks, batch)
        cycles += len(stretch.ticks.cycle)
    return cycles


def _known(requests: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return requests (n,), in which a value that isn't a Request has become NONE."""
    return np.where(requests <= max(Request), requests, np.uint8(Request.NONE))


def _arms_of(arms: ArmBatch, rows: slice) -> ArmBatch:
    """Return the arm's states in the cycles of a slice."""
    columns: tuple[NDArray[Any], ...] = arms
    return ArmBatch(*(column[rows] for column in columns))


def _split(stretch: CycleStretch, bounds_ns: tuple[int, int]) -> Iterator[tuple[CycleStretch, slice, bool]]:
    """Split a stretch at the beginning of the reported time; yield each part, its slice, and whether it is reported.

    bounds_ns: begin and end of that time, on the run's clock. Cycles from its end on are left out, and so is an empty
    part. Each part keeps all frames of the stretch.
    """
    first, end = np.searchsorted(stretch.ticks.t_ns, bounds_ns).tolist()
    for rows, is_told in ((slice(0, first), False), (slice(first, end), True)):
        if rows.start < rows.stop:
            yield _rows_of(stretch, rows), rows, is_told


def _rows_of(stretch: CycleStretch, rows: slice) -> CycleStretch:
    """Return the cycles of a stretch in a slice, with all its frames. They begin the attempt only from index 0 on."""
    scheme, requests = stretch.scheme, stretch.requests
    return stretch._replace(
        is_begin=stretch.is_begin and rows.start == 0,
        ticks=Ticks(*(column[rows] for column in stretch.ticks)),
        arms=None if stretch.arms is None else _arms_of(stretch.arms, rows),
        requests=None if requests is None else requests[rows],
        scheme=None if scheme is None else scheme.part(rows),
    )


class _ArmReader:
    """Gives the arm's states: the log's, or decoded from frames, once for all settings that decode alike.

    needs_frames: whether frames are decoded for any of them.
    """

    def __init__(self, source: ReplaySource, variants: Sequence[Settings], by_frames: bool) -> None:
        self._source = source
        self._keys = [_decoding_key(settings) for settings in variants]
        self._settings = dict(zip(self._keys, variants, strict=True))
        self._logged_key: Any = None
        if source.has_arms and not (source.is_recording or by_frames):
            self._logged_key = _decoding_key(source.settings)
            self._settings.pop(self._logged_key, None)
        self.needs_frames = bool(self._settings)
        self._devices = {key: source.devices(settings) for key, settings in self._settings.items()}
        self._arms: dict[Any, RecordedArm] = {}

    def read(self, stretch: CycleStretch) -> list[ArmBatch]:
        """Return the arm's states in a stretch, for each of the variants.

        Variants that decode as the log's settings get its own states, unless those are to be decoded or it has none.
        Call it for all stretches in the order of the log.
        """
        if stretch.is_begin:
            self._arms = {
                key: RecordedArm(settings, self._source.codec, self._devices[key])
                for key, settings in self._settings.items()
            }
        batches = {key: arm.read(stretch.ticks, stretch.frames) for key, arm in self._arms.items()}
        if self._logged_key is not None and stretch.arms is not None:
            batches[self._logged_key] = stretch.arms
        return [batches[key] for key in self._keys]


def _decoding_key(settings: Settings) -> Any:
    """Return the settings that determine how frames become the arm's states."""
    arm = settings.arm
    shape = (arm.sign, arm.zero_deg, arm.torque_offset_Nm, settings.safety.tolerated_emergencies)
    return (*shape, settings.bus, settings.devices, settings.realtime)


def _result(
    player: _Player, source: ReplaySource, source_notes: Sequence[str], tolerance: float, first_ns: int
) -> Replay:
    """Return a player's outcome, with notes on all that was not compared or judged; end its last attempt first.

    Requests that the script doesn't explain are counted as mismatches. first_ns: contacts, changes of state and
    adaptations before this time are left out.
    """
    gatherer, comparison, notes = player.gatherer, player.comparison, list(source_notes)
    gatherer.end_attempt()
    score = gatherer.score()
    score = None if score is None else score.since(first_ns)
    if in_loop := source.metadata.get("detectors", ""):
        notes.append(f"the run had detectors in its loop, which a replay leaves out: {in_loop}")
    unjudged = () if score is None else score.unjudged
    behind_gap = sum(alarm.t_ns in gatherer.behind_gap_ns for alarm in unjudged)
    if untold := unjudged_sentence(len(unjudged) - behind_gap):
        notes.append(untold)
    elif player.uncovered:
        uncovered_s = player.uncovered * player.settings.bus.period_s
        notes.append(f"the truth doesn't cover {uncovered_s:.2f} s of MONITOR: contacts then are not counted")
    if behind_gap:
        notes.append(f"{number_of(behind_gap, 'detection')} behind missing cycles may stem from them, not judged")
    if comparison is not None:
        for cycle, t_ns, logged, asked in comparison.unexplained:
            comparison.add_mismatch(Mismatch(SCHEME.name, "request", "", cycle, t_ns, str(logged), str(asked)))
        if comparison.missing_fields:
            notes.append(f"{SCHEME.name} lacks {', '.join(comparison.missing_fields)}, an older format")
    threshold_Nm, push_Nm = gatherer.sensitivity_Nm()
    return Replay(
        settings=player.settings,
        cycles=player.cycles,
        monitored_s=player.monitored * player.settings.bus.period_s,
        compared=0 if comparison is None else comparison.cycles,
        arms_compared=0 if comparison is None else comparison.arms,
        attempts=player.attempts,
        states=tuple(each for each in gatherer.transitions if each.t_ns >= first_ns),
        adaptation_s=tuple(took_s for t_ns, took_s in gatherer.adaptations if t_ns >= first_ns),
        parameters=dict(zip(player.settings.estimator.parameter_names, gatherer.theta_hat, strict=False)),
        score=score,
        detections_ns=tuple(t_ns for t_ns in gatherer.detections_ns if t_ns >= first_ns),
        mismatches=() if comparison is None else comparison.first(),
        mismatch_count=0 if comparison is None else comparison.count,
        mismatched_fields={} if comparison is None else dict(comparison.fields),
        tolerance=tolerance,
        zero_ns=next((each.t_ns for each in gatherer.transitions if each.state is MOTION_START), 0),
        ending=gatherer.transitions[-1] if gatherer.transitions else None,
        threshold_Nm=threshold_Nm,
        push_Nm=push_Nm,
        notes=tuple(notes),
    )
