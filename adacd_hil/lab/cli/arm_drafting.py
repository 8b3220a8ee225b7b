"""The draft of an arm's configuration for `init`: scans the bus, asks the user, derives the other values."""

import math
import os
import tempfile
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from adacd_hil import __version__
from adacd_hil.cli.connection import Connection
from adacd_hil.cli.output import CommandError, ExitCode, quoted, tell
from adacd_hil.clock import MonotonicClock, wall_ns
from adacd_hil.control.configuration_check import ConfigurationFindings, examine_configuration
from adacd_hil.dates import format_date
from adacd_hil.device.device_files import load_profile, profile_names
from adacd_hil.device.device_setup import TORQUE_UNITS_NM
from adacd_hil.device.drive_units import RPM
from adacd_hil.device.profile import ProfileSettings, ScaleSettings
from adacd_hil.file_access import read_input
from adacd_hil.file_replacement import replace_files
from adacd_hil.lab.cli.interview import Interview
from adacd_hil.lab.commission.arm_draft import (
    LEVEL_DEG,
    ArmFacts,
    Fact,
    PlanarArm,
    draft_arm,
    draft_as_toml,
    draw_arm,
    planar_from_urdf,
    uniform_rods,
)
from adacd_hil.lab.commission.device_recognition import RecognisedDevice, choose_family, recognise
from adacd_hil.lab.commission.host_checks import Status, look_for_socketcan
from adacd_hil.lab.commission.profile_draft import (
    DRIVE,
    SENSOR,
    TORQUE_KEYS,
    DeviceRatings,
    ProfileDraft,
    describe_kind,
    draft_profile,
    identity_of,
    is_of,
    kind_of,
)
from adacd_hil.lab.commission.survey import survey
from adacd_hil.lab.serial_arm.urdf import UrdfError
from adacd_hil.log.recording.run_folder import is_there
from adacd_hil.printable import in_line
from adacd_hil.settings.arm_settings import SLIGHT_TILT_DEG, ArmSettings, DevicesSettings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import bounds_of, parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.setting_keys import known_keys
from adacd_hil.settings.toml_text import toml_value
from adacd_hil.wire.can_interface import can_interfaces, read_link

Pair = tuple[float, float]
_PERIODS_US = (1000, 2000, 4000, 5000, 10_000)
_NO_BUS = "none"
_SHOWN_SHARE = 1e-5
"""Relative difference of a value as it was given and as a profile has it, by the digits that are written."""


@dataclass
class DraftFiles:
    """Files to be written all together. Existing files stay unless `--force` is given, `is_forced`.

    out: the configuration. contents: of the other files, by path. named: paths of the given profiles, by their names in
    the configuration.
    """

    out: Path
    is_forced: bool
    contents: dict[Path, bytes] = field(default_factory=dict)
    named: dict[str, str] = field(default_factory=dict)

    def require_free(self, path: Path) -> None:
        """Raise CommandError if a file, folder or link is at the path, unless `--force` is given."""
        if is_there(path) and not self.is_forced:
            raise CommandError(f"{path} exists; give another name, or --force to replace it", ExitCode.USAGE)

    def add_file(self, path: Path, content: str | bytes) -> None:
        """Add a file to those that `write_files` writes.

        Raises CommandError if the path has other content already: added before or, unless `--force` is given, on the
        disk.
        """
        data = content.encode() if isinstance(content, str) else content
        if self.contents.get(path, data) != data:
            raise CommandError(f"{path} would get two contents, of files with one name: rename one", ExitCode.USAGE)
        if not (path.is_file() and path.read_bytes() == data):
            self.require_free(path)
        self.contents[path] = data

    def beside(self, name: str, kind: str) -> str:
        """Return a profile's name as the configuration states it: a built-in name, or a path relative to its folder.

        A path without suffix, which no configuration looks for there, becomes absolute. If profile or EDS are in that
        folder, they are added unchanged to the files to be written. Raises ConfigError if the profile can't be read.
        """
        profile = load_profile(name, kind)
        if name in profile_names():
            return name
        folder = self.out.parent.resolve()
        for path in (Path(name), profile.eds):
            if path.resolve().parent == folder:
                self.contents[path] = path.read_bytes()
        place = Path(name).parent.resolve() / Path(name).name
        stated = os.path.relpath(place, folder) if place.suffix else str(place)
        self.named[stated] = str(place)
        return stated

    def examine(self, text: str) -> ConfigurationFindings:
        """Check a configuration's text together with the added files, as `config check`; return the findings.

        Given profiles are read where they are. Likely mistakes name the files as the configuration will. Raises
        CommandError if it has errors. Writes to a temporary folder only.
        """
        for name, place in self.named.items():
            text = text.replace(toml_value(name), toml_value(place))
        with tempfile.TemporaryDirectory() as folder:
            for path, data in (self.contents | {self.out: text.encode()}).items():
                (Path(folder) / path.name).write_bytes(data)
            found = examine_configuration(str(Path(folder) / self.out.name))

        def as_stated(line: str) -> str:
            for name, place in self.named.items():
                line = line.replace(place, name)
            return line.replace(f"{folder}/", "")

        if found.errors:
            line = as_stated(found.errors[0])
            raise CommandError(f"{self.out} is not written, as it could not be used: {line}", ExitCode.USAGE)
        return found._replace(mistakes=[as_stated(line) for line in found.mistakes])

    def write_files(self, text: str) -> None:
        """Write the configuration, `text`, to `out`, and the added files, by name, into its folder, which is made.

        Existing files are replaced, as by `replace_files`. Raises CommandError if one can't be written.
        """
        self.contents[self.out] = text.encode()
        try:
            replace_files(self.out.parent, {path.name: data for path, data in self.contents.items()})
        except OSError as error:
            failed = next((path for path in self.contents if str(path) == error.filename), self.out)
            raise CommandError(f"{failed} can't be written: {error.strerror}") from error


class Drafting:
    """One draft of an arm's configuration: answers, devices found, drafted profiles.

    options: values of `init`'s options by their names, pairs for joint 1 and 2; None, () or False: not given. bus: that
    of the arm with the drafted configuration, None without a bus. warnings: a line each. bitrate: of the bus, None if
    unknown.
    """

    def __init__(self, options: SimpleNamespace, interview: Interview, writing: DraftFiles) -> None:
        self.options, self.interview, self.writing = options, interview, writing
        self.warnings: list[str] = []
        self.bus: Connection | None = None
        self.bitrate = options.bitrate
        self.guessed: set[str] = set()
        """Profiles in which the scale of a count is a guess."""
        self._answers: dict[str, tuple[Any, str]] = {}
        self._drafts: dict[tuple[str, int], ProfileDraft] = {}
        """Drafted and completed profiles, by kind and joint."""
        self._files: dict[str, dict[str, str]] = {}
        """Names of added profiles by stem and text."""

    def draft(self) -> tuple[str, dict[str, Any]]:
        """Scan the bus, ask the user, derive the other values; return the text of a configuration, and a summary.

        The summary is for JSON, but for the `Connection` under "bus". The period is the first of `_PERIODS_US` in which
        the frames meet their deadlines, else the last; profiles for 500 µs keep theirs. Writes no file; adds device
        profiles to `writing`. Raises CommandError without an answer, for options that exclude each other, if the
        configuration would have errors, or if the bus fails; ConfigError for a URDF, EDS or value that can't be used,
        BusMissingError if the bus can't be opened.
        """
        facts = self._gather()
        title = f"Written by `adacd-hil init` {__version__} on {format_date(wall_ns())[:10]}"
        title += f" from {self.bus.interface} {self.bus.channel}." if self.bus else " without hardware."
        for period_us in _PERIODS_US if facts.period_us in _PERIODS_US else (facts.period_us,):
            entries, warnings = draft_arm(facts._replace(period_us=period_us))
            text = draft_as_toml(entries, title, quoted(self.writing.out))
            found = self.writing.examine(text)
            if not found.is_late:
                break
        summary: dict[str, Any] = {
            "bus": self.bus,
            "drive": list(facts.drive.value),
            "drive_node": list(facts.drive_node.value),
            "sensor": list(facts.sensor.value),
            "sensor_node": list(facts.sensor_node.value),
            "assumed": list(found.guesses),
            "warnings": [*self.warnings, *warnings, *found.mistakes],
        }
        return text, summary

    def _gather(self) -> ArmFacts:
        """Return devices, profiles, geometry and limits of the arm: by options, bus and URDF, else by the user."""
        options = self.options
        devices = self._find_devices()
        names = self._profiles(devices)
        profiles = [self._profile(DRIVE, names[DRIVE].value[joint], joint) for joint in range(2)]
        self._check_used(names)
        geometry, length_source, mass_source, gravity_source = self._ask_geometry()
        ratings = [device.ratings for device in devices[DRIVE]]
        rated = self._rated(ratings, profiles, geometry)
        torque = self._limit("torque_limit_Nm", _torque_proposals(rated, ratings, geometry))
        scaled = [(rating, profile.scale) for rating, profile in zip(ratings, profiles, strict=False)]
        by_drives = _both(rating.position_limit_deg(scale) for rating, scale in scaled)
        proposal = _limit_proposal("position_limit_deg", geometry, by_drives, "0x607D of the drives")
        position = self._limit("position_limit_deg", proposal)
        by_drives = _both(rating.velocity_limit_deg_s(scale) for rating, scale in scaled)
        proposal = _limit_proposal("velocity_limit_deg_s", geometry, by_drives, "0x6080 of the drives, by their gears")
        velocity = self._limit("velocity_limit_deg_s", proposal)
        usual = DevicesSettings()
        nodes = [
            Fact(tuple(device.node.node_id for device in found), "found on the bus")
            if found
            else Fact(given or default, "given" if given else "")
            for found, given, default in (
                (devices[DRIVE], options.drive_node, usual.drive_node),
                (devices[SENSOR], options.sensor_node, usual.sensor_node),
            )
        ]
        half = load_settings("fd_500us")
        is_half = all(name.endswith("-500us") for fact in names.values() for name in fact.value)
        return ArmFacts(
            geometry,
            length_source,
            mass_source,
            gravity_source,
            rated,
            torque,
            position,
            velocity,
            names[DRIVE],
            names[SENSOR],
            nodes[0],
            nodes[1],
            half.bus.period_us if is_half else _PERIODS_US[0],
            half.devices.data_bitrate if is_half else None,
            self.bitrate,
        )

    def _check_used(self, names: Mapping[str, Fact]) -> None:
        """Raise CommandError if an option gives a value of `scale` other than a joint's profile has.

        The option would be without effect. names: profiles by kind. A unit may differ in one of both profiles; that of
        velocity counts as used once a draft has taken it.
        """
        for question in _QUESTIONS:
            if (given := question.given(self.options)) is None:
                continue
            named = names[question.kind].value
            owned = [getattr(self._profile(question.kind, named[i], i).scale, question.name) for i in range(2)]
            wrong = [
                joint
                for joint, value in enumerate(question.read(given))
                if not math.isclose(value, owned[joint], rel_tol=_SHOWN_SHARE)
            ]
            if question.answer == "velocity_unit" and question.option in self._answers:
                wrong = []
            if len(wrong) > (1 if question.units else 0):
                joint = wrong[0]
                raise CommandError(
                    f"{question.option}: profile {named[joint]} of joint {joint + 1} has its "
                    f"own `{question.key}` = {owned[joint]:g}; correct it in a profile that `extends` that one, or "
                    f"give the EDS, --{question.kind}-eds FILE",
                    ExitCode.USAGE,
                )

    def _profile(self, kind: str, name: str, joint: int) -> ProfileSettings:
        """Return the settings of a joint's profile: of its draft, else the built-in one, else the given file.

        joint: 0 or 1. name: as in the configuration.
        """
        draft = self._drafts.get((kind, joint))
        if draft is not None:
            return draft.settings
        return load_profile(self.writing.named.get(name, name), kind).settings

    # -- devices

    def _find_devices(self) -> dict[str, list[RecognisedDevice]]:
        """Scan the bus, if there is one; return the devices of joint 1 and 2 by kind, [] without a bus.

        Sets `bus` and `bitrate`; prints a line per node. Raises CommandError if fewer than two of a kind answer, an
        option is missing or excludes another, or the bus fails; ConfigError for a wrong option, BusMissingError if the
        bus can't be opened.
        """
        channel = self._ask_channel()
        if channel is None:
            return {DRIVE: [], SENSOR: []}
        interface = self.options.interface or "socketcan"
        clock = MonotonicClock()
        connection = Connection(interface, channel, self.options.bitrate, str(self.writing.out), None, None)
        with connection.bus(clock, is_fd=False) as bus:
            found = survey(bus, clock, progress=tell)
            kinds = dict.fromkeys(self.options.drive_node or (), DRIVE)
            kinds |= dict.fromkeys(self.options.sensor_node or (), SENSOR)
            devices = recognise(bus, clock, found.nodes, kinds)
        self.bus = connection
        link = read_link(channel) if interface == "socketcan" else None
        self.bitrate = (None if link is None else link.bitrate) or self.bitrate
        for device in devices:
            what = " or ".join(device.profiles) or "no built-in profile"
            tell(f"node {device.node.node_id}: {device.kind}, {device.title}: {what}")
        for node in found.nodes:
            if all(device.node is not node for device in devices):
                tell(
                    f"node {node.node_id}: {node.device_text}, neither drive nor sensor by 0x1000; give --drive-node "
                    "or --sensor-node for such a node"
                )
        return {kind: self._choose_two(devices, kind, channel) for kind in (DRIVE, SENSOR)}

    def _ask_channel(self) -> str | None:
        """Return the channel of the arm's bus, by option or user; None for an arm without hardware.

        Raises CommandError for options that exclude each other, or without an answer.
        """
        options = self.options
        if options.is_busless and (options.channel or options.interface):
            raise CommandError("--no-bus and --interface or --channel exclude each other", ExitCode.USAGE)
        if options.is_busless:
            return None
        if options.channel is not None:
            return str(options.channel)
        if options.interface not in (None, "socketcan"):
            raise CommandError(f"--interface {options.interface} needs --channel", ExitCode.USAGE)
        present = can_interfaces()
        kernel = look_for_socketcan()
        if kernel.status is not Status.OK:
            line = f"{kernel.reason} ({kernel.remedy}); an arm without hardware can be rehearsed"
        else:
            line = f"CAN interfaces: {', '.join(present) or 'none is there'}"
        if self.interview.is_asking:
            tell(line)
        proposal = Fact(present[0] if self.interview.is_asking and present else _NO_BUS)
        question = f"CAN interface of the arm, `{_NO_BUS}` for an arm without hardware"

        def read(text: str) -> str:
            if text != _NO_BUS and present and text not in present:
                raise ConfigError(f"no CAN interface {text!r}; there are {', '.join(present)}")
            return text

        channel, _ = self.interview.ask("--channel or --no-bus", None, question, read, proposal)
        return None if channel == _NO_BUS else channel

    def _choose_two(self, devices: Sequence[RecognisedDevice], kind: str, channel: str) -> list[RecognisedDevice]:
        """Return the drives, or the sensors, of joint 1 and 2: as given, as the user answers, or by ascending node id.

        kind: "drive" or "sensor". channel: of the bus, for the error. A proposal that was taken is added to `warnings`.
        Raises CommandError if fewer than two answer, if nobody chooses among more than two, or for two without option,
        terminal and `--yes`; ConfigError for a wrong option.
        """
        known = {device.node.node_id: device for device in devices if device.kind == kind}
        option, nodes = f"--{kind}-node", " ".join(map(str, known)) or "none"
        if len(known) < 2:
            raise CommandError(
                f"{channel}: {kind}s that answer: {nodes}; an arm has two. Check power, wiring and node ids; --no-bus "
                "writes a file without them",
                ExitCode.BUS_MISSING,
            )

        def read(value: Any) -> list[RecognisedDevice]:
            chosen = _numbers(value, int, option)
            for number in chosen:
                if number not in known:
                    raise ConfigError(f"node {number} of {option} is no {kind} that answers; there are {nodes}")
            if chosen[0] == chosen[1]:
                raise ConfigError(f"{option} {chosen[0]} {chosen[1]}: the node ids must differ")
            return [known[number] for number in chosen]

        # Of more than two, as of two arms, only the user can choose.
        proposal = Fact(tuple(known) if len(known) == 2 else None, "in the order of the node ids")
        given = getattr(self.options, f"{kind}_node")
        answer, source = self.interview.ask(option, given, f"Node ids of the {kind}s of joint 1 and 2", read, proposal)
        if source != "given":
            self.warnings.append(f"{kind}s of joint 1 and 2 are nodes {nodes}, {source}: `doctor --move` checks it")
        return answer

    def _profiles(self, found: Mapping[str, Sequence[RecognisedDevice]]) -> dict[str, Fact]:
        """Return the names of both joints' profiles by kind: given, else drafted from an EDS or recognised on the bus.

        On a terminal the user is asked for the EDS of an unknown device. Without a bus, an EDS or given profiles, they
        are the emulated devices' profiles, a guess. Raises CommandError if a device has neither a profile nor an EDS.
        """
        drafted = self._draft_profiles(found)
        families = choose_family(*found.values()) if found[DRIVE] else (("",) * 2, ("",) * 2)
        facts: dict[str, Fact] = {}
        for (kind, devices), names in zip(found.items(), families, strict=True):
            given = getattr(self.options, kind)
            if given is not None:
                named = tuple(self.writing.beside(name, kind) for name in given)
                facts[kind] = Fact(self._complete(kind, named, devices), "given")
                continue
            chosen = [drafted.get((kind, joint)) or names[joint] for joint in range(2)]
            for joint, device in enumerate(devices):
                if not chosen[joint] and self.interview.is_asking:
                    chosen[joint] = self._ask_eds(kind, joint, device)
            if not any(chosen) and not devices:
                facts[kind] = Fact((f"adacd-{kind}",) * 2)
            elif all(chosen):
                are_of_eds = all((kind, joint) in drafted for joint in range(2))
                source = "from the EDS" if are_of_eds else "recognised by vendor and product"
                completed = self._complete(kind, chosen, devices)
                facts[kind] = Fact(completed, "" if self.guessed & set(completed) else source)
            else:
                joint = chosen.index("")
                title = devices[joint].title if devices else "the device"
                raise CommandError(
                    f"{kind} of joint {joint + 1} ({in_line(title)}) has no built-in profile: give --eds FILE, its "
                    f"maker's, or --{kind} PROFILE PROFILE",
                    ExitCode.USAGE,
                )
        return facts

    def _ask_eds(self, kind: str, joint: int, device: RecognisedDevice) -> str:
        """Ask for the EDS of a device without a profile; draft that profile, and return its file name.

        joint: 0 or 1. The question is repeated while the EDS isn't there or can't be used.
        """

        def read(text: str) -> str:
            eds = Path(text)
            if not eds.is_file():
                raise ConfigError(f"EDS {eds} is not there")
            return self._add_drafts(eds, kind, {joint: device.ratings})[kind, joint]

        question = f"EDS of the {kind} of joint {joint + 1} ({in_line(device.title)})"
        return self.interview.ask("--eds FILE", None, question, read)[0]

    def _draft_profiles(self, devices: Mapping[str, Sequence[RecognisedDevice]]) -> dict[tuple[str, int], str]:
        """Draft profiles of each given EDS, beside the configuration; return their file names by kind and joint (0, 1).

        devices: found on the bus by kind; [] without a bus: of two EDS of a kind, the first is of joint 1. Raises
        CommandError for an EDS beside named profiles, or that fits no device, or a device that has another EDS already.
        """
        names: dict[tuple[str, int], str] = {}
        files = self._eds_files()
        for place, (eds, kind) in enumerate(files):
            if getattr(self.options, kind) is not None:
                raise CommandError(
                    f"EDS {eds} is of a {kind}, and --{kind} names the {kind}s' profiles: leave out one of them",
                    ExitCode.USAGE,
                )
            identity = identity_of(eds)
            same = devices[kind]
            fitting = [
                joint
                for joint in range(2)
                if not same or is_of(identity, (same[joint].node.vendor, same[joint].node.product))
            ]
            alike = [other for other, (_, its) in enumerate(files) if its == kind]
            if not same and len(alike) > 1:
                fitting = [alike.index(place)]
            if any(joint > 1 or (kind, joint) in names for joint in fitting):
                raise CommandError(
                    f"EDS {eds}: the {kind} of joint {fitting[0] % 2 + 1} has one already; give one EDS for each joint",
                    ExitCode.USAGE,
                )
            if not fitting:
                vendor, product = ("?" if number is None else f"0x{number:X}" for number in identity)
                raise CommandError(
                    f"EDS {eds} is of vendor {vendor}, product {product}, which is no {kind} on the bus: "
                    f"{'; '.join(in_line(device.title) for device in same)}",
                    ExitCode.USAGE,
                )
            names |= self._add_drafts(
                eds, kind, {joint: same[joint].ratings if same else DeviceRatings() for joint in fitting}
            )
        return names

    def _eds_files(self) -> list[tuple[Path, str]]:
        """Return the given EDS files, each once, with the kind, "drive" or "sensor"; ask if `kind_of` finds none.

        Raises CommandError without an answer, ConfigError for an EDS that can't be read.
        """
        options = self.options
        found = [(eds, DRIVE) for eds in options.drive_eds] + [(eds, SENSOR) for eds in options.sensor_eds]
        for eds in options.eds:
            kind = kind_of(eds)
            if not kind:
                kind, _ = self.interview.ask(
                    f"--drive-eds {eds} or --sensor-eds {eds} in place of --eds",
                    None,
                    f"{describe_kind(eds)}: which is it",
                    _drive_or_sensor,
                )
            found.append((eds, kind))
        return list(dict.fromkeys(found))

    def _add_drafts(self, eds: Path, kind: str, ratings: dict[int, DeviceRatings]) -> dict[tuple[str, int], str]:
        """Draft profiles of an EDS; add them and the EDS to the files to be written.

        Asks for values that the EDS leaves open; guesses and remarks become warnings, a profile with an `_ESSENTIAL`
        guess one of `guessed`. ratings: by joint (0, 1) to draft for. Return the profiles' file names by kind and
        joint; joints with equal drafts share one.
        """
        drafts = self._draft(eds, kind, ratings)
        self.writing.add_file(self.writing.out.parent / eds.name, eds.read_bytes())
        names: dict[tuple[str, int], str] = {}
        for joint, draft in drafts.items():
            name = names[kind, joint] = self._add_profile(draft.text, eds.stem)
            self._drafts[kind, joint] = draft
            for line in (*draft.guesses, *draft.remarks):
                if (warning := f"{name}: {line}") not in self.warnings:
                    self.warnings.append(warning)
            self.guessed |= {name} if _ESSENTIAL & draft.guessed.keys() else set()
        return names

    def _add_profile(self, text: str, stem: str) -> str:
        """Add the text of a joint's profile to the files to be written; return the file's name, with `stem` in it.

        Equal texts with the same stem share a file. Raises CommandError as `add_file` does.
        """
        files = self._files.setdefault(stem, {})
        name = files.setdefault(text, f"{self.writing.out.stem}-{stem}{f'-{len(files) + 1}' if files else ''}.toml")
        self.writing.add_file(self.writing.out.parent / name, text)
        return name

    def _draft(
        self, eds: Path, kind: str, ratings: dict[int, DeviceRatings], among: Collection[str] | None = None
    ) -> dict[int, ProfileDraft]:
        """Return drafts of an EDS's profile by joint; ask for each guess, or only for those with keys in `among`.

        ratings: by joint (0, 1) to draft for. A given option counts even where the EDS has a value. A question is asked
        once; later drafts take the same answer. Raises ConfigError for a wrong option or EDS, CommandError without an
        answer.
        """
        answers: dict[int, dict[str, float]] = {joint: {} for joint in ratings}

        def drafted() -> dict[int, ProfileDraft]:
            return {joint: draft_profile(eds, ratings[joint], kind, answers[joint]) for joint in ratings}

        drafts = drafted()
        for question in _QUESTIONS:
            if question.kind != kind or (among is not None and question.key not in among):
                continue
            guessed = {key: value for draft in drafts.values() for key, (value, _) in draft.guessed.items()}
            if question.given(self.options) is None and question.key not in guessed:
                continue
            if question.option not in self._answers:
                proposal = Fact(question.propose(guessed.get(question.key, 1.0)))
                self._answers[question.option] = self.interview.ask(
                    f"{question.option} {'UNIT' if question.units else 'A B'}",
                    question.given(self.options),
                    question.text,
                    question.read,
                    proposal,
                    question.explanation,
                )
            value, source = self._answers[question.option]
            if source == "given":
                for joint, known in answers.items():
                    known[question.answer] = value[joint]
                drafts = drafted()
        return drafts

    def _complete(self, kind: str, names: Sequence[str], devices: Sequence[RecognisedDevice]) -> tuple[str, ...]:
        """Return the profiles' names; a shipped one with guesses is replaced by an extension if answers replace some.

        An extension is a profile that `extends` it by the answers. The extensions are added to the files to be written.
        A shipped profile whose guesses all stay is added to `guessed`.
        """
        completed = list(names)
        for joint, name in enumerate(names):
            if name not in profile_names():
                continue
            profile = load_profile(name, kind)
            if not profile.settings.assumed:
                continue
            ratings = devices[joint].ratings if devices else DeviceRatings()
            (draft,) = self._draft(profile.eds, kind, {joint: ratings}, profile.settings.assumed).values()
            left = [key for key in draft.guessed if key in profile.settings.assumed]
            if len(left) < len(profile.settings.assumed):
                text = _extension(name, profile.settings.scale, draft.settings.scale, left)
                completed[joint] = self._add_profile(text, name)
                self._drafts[kind, joint] = draft
            else:
                self.guessed.add(name)
        return tuple(completed)

    # -- the arm

    def _ask_geometry(self) -> tuple[PlanarArm, str, str, str]:
        """Return the geometry, and the sources of lengths, masses and gravity's direction, "" for a guess.

        It is the URDF's, else that of given or asked lengths and masses; without masses `cad_theta` is (). Raises
        CommandError for options that exclude each other, or without an answer; ConfigError for a URDF or an option that
        can't be used.
        """
        options, interview = self.options, self.interview
        if options.urdf is not None:
            if options.length_m is not None or options.mass_kg is not None:
                raise CommandError(
                    "--urdf gives lengths and masses: leave out --length-m and --mass-kg", ExitCode.USAGE
                )
            if options.at_zero is not None or options.is_upright is not None:
                raise CommandError(
                    "--urdf gives the direction of gravity; --mounting floor, wall or ceiling gives that of its root",
                    ExitCode.USAGE,
                )

        def read(path: Path | str) -> tuple[Path, PlanarArm] | None:
            return None if path == "-" else (Path(path), _read_urdf(Path(path), options.locked))

        described = None
        if options.urdf is not None or (options.length_m is None and interview.is_asking):
            described, _ = interview.ask("--urdf", options.urdf, "URDF of the arm, - for none", read, Fact("-"))
        if described is not None:
            urdf, arm = described
            if not arm.is_tip_known:
                self.warnings.append(f"{urdf} has no frame at the tip: the length of link 2 is a guess")
            source = f"URDF {urdf.name}"
            arm, mounted = self._mount(urdf, arm)
            tell(draw_arm(arm.mounting_deg))
            return arm, source if arm.is_tip_known else "", source, f"{source}, {mounted}"
        if options.locked:
            raise CommandError("--lock names a joint of --urdf", ExitCode.USAGE)
        length_m, length_source = interview.ask(
            "--length-m L1 L2 or --urdf FILE",
            options.length_m,
            "Lengths in m, joint to joint and joint to tip",
            lambda value: _checked("link_length_m", _numbers(value, float, "--length-m")),
            Fact((0.35, 0.30)),
        )
        mounting_deg, gravity_source = self._ask_mounting()
        mass_kg = None
        if options.mass_kg is not None or interview.is_asking:
            question = "Masses of the links in kg, - for unknown"
            mass_kg, _ = interview.ask("--mass-kg", options.mass_kg, question, _masses, Fact("-"))
        if mass_kg is None:
            return PlanarArm(length_m, (), mounting_deg), length_source, "", gravity_source
        arm = uniform_rods(length_m, mass_kg, mounting_deg)
        self.warnings.append("inertia is that of uniform rods, without motors and gears")
        return arm, length_source, "given masses, as uniform rods", gravity_source

    def _ask_mounting(self) -> tuple[Pair, str]:
        """Return the tilt of the plane of motion and the q1 at which link 1 hangs down, deg, and their source.

        Options give them, else the user; a slight tilt gives `LEVEL_DEG`. The source is "" for a guess. Raises
        CommandError for options that exclude each other, or without an answer; ConfigError for a wrong option.
        """
        options, interview = self.options, self.interview
        given = options.mounting
        if options.is_upright is not None:
            if given is not None:
                raise CommandError(
                    "--mounting and --upright or --flat state the same: give one of them", ExitCode.USAGE
                )
            given = "wall" if options.is_upright else "flat"
        (mounting, tilt_deg), source = interview.ask(
            "--mounting or --flat",
            given,
            "Mounting of the base: flat (joint axes vertical), floor, wall, ceiling, or the tilt of the plane in deg",
            lambda text: (text.casefold(), _word_or_deg("--mounting", text, _TILTS_DEG, 0.0, 90.0)),
            Fact("flat"),
            "on floor, wall and ceiling the joint axes are level and all of gravity acts; a tilt of 0 is flat",
        )
        if tilt_deg <= SLIGHT_TILT_DEG:
            if options.at_zero is not None:
                raise CommandError(
                    "--at-zero is of an arm that gravity reaches: give --mounting floor, wall, ceiling, or a tilt "
                    f"above {SLIGHT_TILT_DEG:g} deg, too",
                    ExitCode.USAGE,
                )
            return LEVEL_DEG, source
        usual = _USUAL_POSES.get(mounting)
        hangs_deg, at_zero_source = interview.ask(
            "--at-zero",
            options.at_zero,
            "Link 1 at q1 = 0 points down, up, level (+q1 lifts it), or down only at q1 = (deg)",
            lambda text: _word_or_deg("--at-zero", text, _HANGING_DEG, -180.0, 180.0),
            Fact(usual or "level", f"as usual of an arm on {mounting}" if usual else ""),
            "q1 = 0 is where the drive reads 0, or `arm.zero_deg`; 90: level, and +q1 lowers it",
        )
        tell(draw_arm((tilt_deg, hangs_deg)))
        return (tilt_deg, hangs_deg), source if at_zero_source else ""

    def _mount(self, urdf: Path, arm: PlanarArm) -> tuple[PlanarArm, str]:
        """Ask how a URDF's root is mounted, and read the URDF again with its root so turned.

        arm: read with the root's z axis up. Return the arm as mounted, and a phrase on the mounting; the given arm if
        neither option nor user answers. Raises ConfigError for a wrong option.
        """
        interview, given = self.interview, self.options.mounting
        if given is None and not interview.is_asking:
            return arm, "its root's z axis up"
        question = "Mounting of the URDF's root: floor (z up), wall (x down), ceiling (z down), or its pitch in deg"
        pitch_deg, _ = interview.ask(
            "--mounting",
            given,
            question,
            lambda text: _word_or_deg("--mounting", text, _PITCHES_DEG, -180.0, 180.0),
            Fact("floor"),
        )
        mounted = "its root's z axis up" if pitch_deg == 0.0 else f"its root pitched by {pitch_deg:g} deg"
        return _read_urdf(urdf, self.options.locked, pitch_deg), mounted

    def _rated(
        self, ratings: Sequence[DeviceRatings], profiles: Sequence[ProfileSettings], geometry: PlanarArm
    ) -> Fact:
        """Return the rated torque at both joints, Nm, and its source: the option or user, drives, or their EDS.

        0x6076 of drives or EDS is taken only if no guess went into it; else it is a proposal, as is the effort of
        `geometry`. `--yes` or Enter takes the proposal, else the default, as a guess with the source "". Raises
        ConfigError for a wrong value, CommandError without an answer.
        """
        scales = [profile.scale for profile in profiles]
        drafts = [draft for joint in range(2) if (draft := self._drafts.get((DRIVE, joint))) is not None]
        by_drives = _both(rating.rated_torque_Nm(scale) for rating, scale in zip(ratings, scales, strict=False))
        by_eds = _both(draft.rated_torque_Nm for draft in drafts)
        is_known = not any(TORQUE_KEYS & set(profile.assumed) for profile in profiles)
        if self.options.rated_torque_nm is None and is_known:
            behind = " behind their gears" if any(scale.gear_ratio != 1.0 for scale in scales) else ""
            if by_drives is not None:
                return Fact(_checked("rated_torque_Nm", by_drives), f"0x6076 of the drives{behind}")
            if by_eds is not None and all(draft.is_rated_known for draft in drafts):
                return Fact(_checked("rated_torque_Nm", by_eds), f"0x6076 of their EDS{behind}")
        proposal = Fact(ArmSettings().rated_torque_Nm)
        if geometry.effort_Nm is not None and min(geometry.effort_Nm) > 0.0:
            proposal = Fact(geometry.effort_Nm)  # a URDF's effort is a limit, no rating
        for pair in (by_eds, by_drives):
            with suppress(ConfigError):  # out of bounds: no proposal
                proposal = proposal if pair is None else Fact(_checked("rated_torque_Nm", pair))
        return self._limit("rated_torque_Nm", proposal)

    def _limit(self, key: str, proposal: Fact) -> Fact:
        """Return the two values of `arm.KEY`, within its bounds, by option or user, with their source.

        proposal: for the user, or taken with `--yes`. An answer above a proposal that is no guess, and not just the
        rated torque, is added to the warnings. Raises ConfigError for a wrong option, CommandError without an answer.
        """
        given = getattr(self.options, key.lower())
        option = f"--{key.lower().replace('_', '-')}"
        meaning = known_keys()[f"arm.{key}"].meaning
        value, source = self.interview.ask(
            f"{option} A B",
            given,
            f"{meaning[0].upper()}{meaning[1:]}: joint 1 and 2 (`arm.{key}`)",
            lambda value: _checked(key, _numbers(value, float, option)),
            proposal,
        )
        for joint, (limit, known) in enumerate(zip(value, proposal.value, strict=True)):
            if limit > known and proposal.source not in ("", _BY_RATED):
                self.warnings.append(f"`arm.{key}[{joint}]` = {limit:g} is above {known:g}, {proposal.source}")
        return Fact(value, source)


def _numbers(value: Any, kind: type, option: str) -> tuple[Any, Any]:
    """Return two numbers of type `kind`, from words parted by spaces or a comma, or from an option's values.

    option: its name, for the error. Raises ConfigError if they aren't two numbers.
    """
    words = value.replace(",", " ").split() if isinstance(value, str) else list(value)
    try:
        first, second = (kind(word) for word in words)
    except ValueError:
        raise ConfigError(f"{option}: {value!r} must be two numbers, of joint 1 and 2") from None
    return first, second


def _checked(key: str, value: tuple[Any, Any]) -> Any:
    """Return a pair if it is within the bounds of `arm.KEY`. Raises ConfigError otherwise."""
    return getattr(parse(ArmSettings, {key: list(value)}, "arm."), key)


_PITCHES_DEG = {"floor": 0.0, "wall": 90.0, "ceiling": 180.0}
"""Rotation of a URDF's root about its y axis, by mounting of the base."""
_TILTS_DEG = {"flat": 0.0, "floor": 90.0, "wall": 90.0, "ceiling": 90.0}
"""Tilt of the plane of motion, by mounting of the base of an arm with level axes."""
_HANGING_DEG = {"down": 0.0, "up": 180.0, "level": -90.0}
"""The q1 at which link 1 hangs down, by its direction at q1 = 0."""
_USUAL_POSES = {"floor": "up", "wall": "level", "ceiling": "down"}


def _word_or_deg(option: str, text: str, words: dict[str, float], low: float, high: float) -> float:
    """Return the angle, deg, that a text gives: by a word of `words`, or as a number from `low` to `high`.

    option: its name, for the error. Raises ConfigError for any other text.
    """
    if text.casefold() in words:
        return words[text.casefold()]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise ConfigError(f"{option} {text!r} must be {', '.join(words)}, or {low:g} to {high:g} deg")
    return value


def _masses(value: Any) -> Pair | None:
    """Return the masses of both links, kg, from text or a pair; None for "-". Raises ConfigError if out of bounds."""
    if value == "-":
        return None
    masses = _numbers(value, float, "--mass-kg")
    low, high = bounds_of(ArmSettings, "mass_kg")
    for mass in masses:
        if not low <= mass <= high:
            raise ConfigError(f"--mass-kg: {mass:g} kg must be within {low:g} kg to {high:g} kg")
    return masses


def _read_urdf(path: Path, locked: Sequence[str], pitch_deg: float = 0.0) -> PlanarArm:
    """Return the arm of a URDF. locked, pitch_deg: as of `planar_from_urdf`.

    Raises ConfigError if the file can't be read, or isn't of an arm that the host can drive.
    """
    try:
        return planar_from_urdf(read_input(path), locked, pitch_deg)
    except FileNotFoundError:
        raise ConfigError(f"URDF {path} does not exist") from None
    except OSError as error:
        raise ConfigError(f"URDF {path}: {error.strerror}") from None
    except UrdfError as error:
        raise ConfigError(f"URDF {path}: {error}") from None


_BY_RATED = "the rated torque"
"""Source of a torque limit above which `config check` doubts it, too."""


def _torque_proposals(rated: Fact, ratings: Sequence[DeviceRatings], geometry: PlanarArm) -> Fact:
    """Return as proposed torque limits, Nm, the smallest of 0x6072, the URDF's effort and the rated torque, per joint.

    Its source is "", a guess, if the rated torque's is.
    """
    shares = [min(rating.torque_share or 1.0, 1.0) for rating in ratings] or [1.0, 1.0]
    efforts = geometry.effort_Nm or rated.value
    limit = tuple(min(rated.value[joint] * shares[joint], efforts[joint]) for joint in range(2))
    source = _BY_RATED if limit == tuple(rated.value) else "the least of 0x6072 and the URDF's effort"
    return Fact(limit, source if rated.source else "")


def _limit_proposal(key: str, geometry: PlanarArm, by_drives: Pair | None, source: str) -> Fact:
    """Return as proposed `arm.KEY` the URDF's, else that of both drives, from `source`, else the default, a guess."""
    by_urdf = getattr(geometry, key)
    if by_urdf is not None:
        return Fact(by_urdf, "the URDF's")
    return Fact(getattr(ArmSettings(), key)) if by_drives is None else Fact(by_drives, source)


def _both(values: Iterable[float | None]) -> Pair | None:
    """Return the values of joint 1 and 2; None unless both are known."""
    known = [value for value in values if value is not None]
    return (known[0], known[1]) if len(known) == 2 else None


_ESSENTIAL = {"scale.increments_per_joint_rev", "scale.torque_Nm", "scale.rated_torque_count_Nm"}
"""Keys of a profile that, as guesses, make `devices` of the configuration a guess, too."""
_VELOCITY_UNITS: dict[str, float] = {
    "increment/s": 0x00B50300,
    "rpm": RPM,
    "0.1rpm": 0xFF << 24 | RPM,
    "mrpm": 0xFD << 24 | RPM,
    "deg/s": 0x00410300,
    "rad/s": 0x00100300,
}
_TORQUE_UNITS_NM = {**TORQUE_UNITS_NM, "0.01Nm": 0.01, "uNm": TORQUE_UNITS_NM["µNm"]}


@dataclass(frozen=True)
class ScaleQuestion:
    """A question about a value that an EDS may leave open. kind: of the device.

    name: in `scale` of its profile, such as "torque_Nm". option: that answers it. explanation: printed on `?`. units:
    for a question about a unit, the worth of each name.
    """

    kind: str
    name: str
    option: str
    text: str
    explanation: str
    units: dict[str, float] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Key of the value in the profile."""
        return f"scale.{self.name}"

    @property
    def answer(self) -> str:
        """Key of the answer in `answers` of `draft_profile`."""
        return "velocity_unit" if self.name == "velocity_rad_s" else self.name

    def given(self, options: SimpleNamespace) -> Any:
        """Return the value of the question's option, None if the option is absent."""
        return getattr(options, self.option.lstrip("-").replace("-", "_"))

    def propose(self, value: float) -> Any:
        """Return a guessed value as an answer to the question: for both joints, or as the name of its unit.

        A worth of no unit gives the first unit.
        """
        if self.units:
            return next((name for name, worth in self.units.items() if worth == value), next(iter(self.units)))
        return (value, value)

    def read(self, value: Any) -> tuple[float, float]:
        """Return an answer's values for joint 1 and 2; of a unit's name its worth, twice.

        Raises ConfigError for an unknown unit, no two numbers, or a value that a profile doesn't accept.
        """
        if not self.units:
            first, second = _numbers(value, float, self.option)
        elif value in self.units:
            first = second = self.units[value]
        else:
            raise ConfigError(f"{self.option}: {value!r} must be one of {', '.join(self.units)}")
        if self.answer != "velocity_unit":
            parse(ScaleSettings, {self.name: first})
            parse(ScaleSettings, {self.name: second})
        if min(first, second) <= 0.0:
            raise ConfigError(f"{self.option}: {min(first, second):g} must be above 0")
        return first, second


_QUESTIONS = (
    ScaleQuestion(
        DRIVE,
        "gear_ratio",
        "--gear",
        "Gear of joint 1 and 2: motor revolutions per revolution of the joint",
        "0x6076 is the motor's torque, and velocities are the motor's; 1 without a gear",
    ),
    ScaleQuestion(
        DRIVE,
        "gear_efficiency",
        "--gear-efficiency",
        "Efficiency of these gears, 0 to 1; 1 where it is not known",
        "part of the motor's torque that leaves the gear, 0.6 to 0.9 mostly",
    ),
    ScaleQuestion(
        DRIVE,
        "increments_per_joint_rev",
        "--increments",
        "Position increments per revolution of joint 1 and 2",
        "counts of 0x6064: increments per motor revolution times the gear; turn the joint by hand and look",
    ),
    ScaleQuestion(
        DRIVE,
        "velocity_rad_s",
        "--velocity-unit",
        "Unit of the drives' velocity 0x606C: increment/s, rpm, 0.1rpm, mrpm, deg/s or rad/s, of the motor",
        "the drive's manual has it under 0x606C or 0x60A9",
        _VELOCITY_UNITS,
    ),
    ScaleQuestion(
        DRIVE,
        "rated_torque_count_Nm",
        "--rated-torque-unit",
        "Unit of the drives' rated torque 0x6076: mNm, µNm, Nm or 0.01Nm",
        "mNm by CiA 402-2; an EPOS4 has µNm",
        _TORQUE_UNITS_NM,
    ),
    ScaleQuestion(
        SENSOR,
        "torque_Nm",
        "--torque-count-nm",
        "One count of the torque sensors of joint 1 and 2, Nm",
        "in the sensor's data sheet, or by a known weight",
    ),
)


def _drive_or_sensor(text: str) -> str:
    if text.casefold() not in (DRIVE, SENSOR):
        raise ConfigError(f"{text!r} must be drive or sensor")
    return text.casefold()


def _extension(name: str, shipped: ScaleSettings, scale: ScaleSettings, left: Sequence[str]) -> str:
    """Return the text of a profile that extends the shipped one `name` by an arm's scale.

    shipped, scale: of that profile, and of the arm. Only values that differ are written. left: keys that are still
    guesses.
    """
    rows = [
        f"{key} = {value!r}" for key, value in vars(scale).items() if not math.isclose(value, getattr(shipped, key))
    ]
    head = [f"# {name} with gear and encoder of this arm, by `adacd-hil init`.", "", f'extends = "{name}"']
    return "\n".join([*head, f"assumed = {toml_value(tuple(left))}", "", "[scale]", *rows]) + "\n"
