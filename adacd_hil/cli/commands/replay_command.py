"""`adacd-hil replay`: feeds a log to arm and scheme again; compares the result with the log or other settings."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adacd_hil.cli.completion import complete_setting
from adacd_hil.cli.options import (
    FiniteRange,
    json_option,
    logs_argument,
    profile_option,
    set_option,
    stretch_options,
    typed_again,
)
from adacd_hil.cli.output import (
    CommandError,
    ExitCode,
    answer,
    complain_of,
    explain_statuses,
    explained,
    format_table,
    one_by_one,
)
from adacd_hil.given_path import GIVEN_FILE, GivenPath
from adacd_hil.log.log_files import SHOWN, SUFFIX
from adacd_hil.log.log_parts import log_in
from adacd_hil.printable import in_line, number_of
from adacd_hil.progress_lines import Progress

if TYPE_CHECKING:
    from adacd_hil.log.time_window import TimeWindow
    from adacd_hil.replay.replay import ReplaySource
    from adacd_hil.replay.replayed_outcome import Replay
    from adacd_hil.settings.configuration import Settings

_EPILOG = explain_statuses(
    OK="identical, or other settings were replayed",
    FAILURE="something differs, or a log can't be read",
    USAGE="wrong usage or configuration",
    PARTIAL="all compared cycles are identical, but part of the log can't be compared",
    INTERRUPTED="interrupted",
)
_MOST_COLUMNS = 6
"""Most variants that are printed as columns beside the log's own; more are printed as rows."""


@click.command(epilog=_EPILOG)
@logs_argument
@set_option
@click.option(
    "--vary",
    multiple=True,
    metavar="KEY=A,B,C",
    help="Replay once for each value; of several, every pair.",
    shell_complete=complete_setting,
)
@click.option("--config", metavar="NAME|FILE", help="Settings as a whole; needed for recordings without a log.")
@profile_option
@click.option("--dbc", type=GIVEN_FILE, help="Contract of a recording without a log.")
@click.option("--against", type=GivenPath(), help="Log of the run that a recording is of, to compare with.")
@click.option("--frames", "by_frames", is_flag=True, help="Decode the frames, and compare the arm's states, too.")
@click.option(
    "--tolerance",
    type=FiniteRange(0.0, 1.0),
    help="Relative tolerance of real values; default: 0 on the same machine.",
)
@click.option("--shown", type=click.IntRange(min=0), default=SHOWN, show_default=True, help="Mismatches to print.")
@json_option
@explained
@stretch_options
def replay(logs: tuple[Path, ...], shown: int, as_json: bool, stretch: "TimeWindow", **options: Any) -> ExitCode:
    """Replay logs: what the arm reported once more through the scheme.

    Without other settings, every field of /scheme and every contact report is compared with the log, bit for bit; a
    folder stands for the run log in it. With --set, --vary or --config, the result stands beside the original: contacts
    that would have been detected, when, false alarms, parameters. The truth.mcap beside a log is joined to it.

    With --frames, the raw frames go through codec and arm once more, and what the arm makes of them in each cycle is
    compared with what the log says that it did (/arm), bit for bit, before the scheme gets it. Logs of earlier versions
    lack /arm: there the frames are decoded, too, and the decisions alone are compared.

    Frames that others recorded (candump .log, BLF, ASC, MF4, TRC) are replayed --against the log of their run, or with
    --config alone, where the configuration's script plays the user.

    With --from and --until, only that stretch is compared and printed. The replay still begins with the log, because
    filters and model depend on earlier cycles.
    """
    with Progress() as progress:
        results, refused = one_by_one(
            logs, lambda path: _replay_one(path, progress, shown=shown, stretch=stretch, **options)
        )
    if results:
        described = [_as_json(*result, shown, stretch) for result in results]
        text = "\n\n".join(_as_text(*result, shown, stretch) for result in results)
        _, (own, *_), names = results[0]
        answer(as_json, described, text, *_next(own, has_changes=bool(names)))
    codes = [_code(replays) for _, replays, _ in results]
    order = [ExitCode.OK, ExitCode.PARTIAL, ExitCode.FAILURE]
    return complain_of(refused) or max(codes, key=order.index)


def _next(own: "Replay", has_changes: bool) -> tuple[str, ...]:
    """Return the command to suggest after a replay; () if no cycle was replayed, or with other settings, too.

    own: the first log's replay with its own settings. has_changes: other settings were replayed, too.
    """
    if has_changes or not own.cycles:
        return ()
    key = "certified.noise_sigmas=8" if own.settings.scheme == "certified" else "filter.a_rad_s=20"
    return (f"{typed_again('--set', key)}   # and with another setting?",)


_Result = tuple[Path, "list[Replay]", list[str]]
"""A log, its replays (the log's own settings first), and the names of the variants."""


def _replay_one(
    given: Path,
    progress: Progress,
    changes: tuple[str, ...],
    vary: tuple[str, ...],
    config: str | None,
    profile: str | None,
    dbc: Path | None,
    against: Path | None,
    by_frames: bool,
    tolerance: float | None,
    shown: int,
    stretch: "TimeWindow",
) -> _Result:
    """Replay one log or recording with its own settings, and with each variant that the options ask for.

    Return its path, the replays (own settings first), and the variants' names. Parameters: as the options. Raises
    CommandError, ConfigError, CodecError or LogError for a wrong option, or a file that can't be read.
    """
    from adacd_hil.control.operator import ScriptedOperator
    from adacd_hil.replay.replay import replay_source
    from adacd_hil.score.emulator_truth import contacts_beside
    from adacd_hil.settings.configuration_files import load_settings
    from adacd_hil.settings.setting_keys import (
        apply_settings,
        keep_log_settings,
        parse_changes,
        parse_variations,
        refuse_log_settings,
    )

    source, is_alone = _open(given, config, profile, dbc, against)
    own = source.settings
    base = own
    if config is not None and not is_alone:
        base = keep_log_settings(own, load_settings(config, own.arm.profile))
    fixed, choices = parse_changes(changes), parse_variations(vary) if vary else []
    for asked in (fixed, *choices):
        refuse_log_settings(asked)
    for key in fixed.keys() & set(choices[0] if choices else ()):
        raise CommandError(f"{key} is both set and varied", ExitCode.USAGE)
    base = apply_settings(base, fixed)
    variants = {_name(choice): apply_settings(base, choice) for choice in choices}
    if not variants and base != own:
        variants = {", ".join(filter(None, [config or "", *changes])): base}
    progress(f"replaying {given}" + (f" with {number_of(len(variants), 'other setting')}" if variants else ""))
    remarks: list[str] = []
    truth = contacts_beside(log_in(against or given), remarks.append)
    settings: list[Settings] = [own, *variants.values()]
    replays = replay_source(
        source,
        settings,
        truth,
        progress,
        tolerance,
        ScriptedOperator,
        shown,
        stretch=stretch,
        by_frames=by_frames,
        remarks=remarks,
    )
    return given, replays, list(variants)


def _open(
    given: Path, config: str | None, profile: str | None, dbc: Path | None, against: Path | None
) -> "tuple[ReplaySource, bool]":
    """Return a log or a recording, and whether it is a recording without a log.

    A missing file counts as a log. against: log of the run that a recording is of. Raises CommandError for a recording
    without a log and without --config, and for --profile or --dbc where a log has its own; LogError, ConfigError or
    CodecError if one can't be read or used.
    """
    from adacd_hil.device.contract import load_contract
    from adacd_hil.device.device_files import place_devices
    from adacd_hil.replay.can_recording import RecordingAgainstLog, RecordingAlone
    from adacd_hil.replay.log_source import LogSource
    from adacd_hil.settings.configuration_files import load_settings
    from adacd_hil.wire.dbc_contract import load_codec

    path = log_in(given)
    if against is not None or path.suffix.lower() == SUFFIX or not path.exists():
        if unused := [name for name, value in (("--profile", profile), ("--dbc", dbc)) if value is not None]:
            raise CommandError(f"{unused[0]} is for a recording without a log: a log has its own", ExitCode.USAGE)
        return (LogSource(path) if against is None else RecordingAgainstLog(path, log_in(against))), False
    if config is None:
        raise CommandError(f"{path} holds no settings: give --against the log of its run, or --config", ExitCode.USAGE)
    settings = load_settings(config, profile)
    codec = load_codec(dbc) if dbc else load_contract(settings, place_devices(settings))
    return RecordingAlone(path, settings, codec), True


def _name(choice: dict[str, str]) -> str:
    return ", ".join(f"{key}={value}" for key, value in choice.items())


def _code(replays: "list[Replay]") -> ExitCode:
    """Return the exit status of a log's replays, by that with its own settings.

    FAILURE: a mismatch, or no cycle. PARTIAL: parts of the log could not be compared. Else OK.
    """
    own = replays[0]
    if own.mismatch_count or not own.cycles:
        return ExitCode.FAILURE
    return ExitCode.OK if own.is_whole else ExitCode.PARTIAL


def _verdict(own: "Replay") -> str:
    """Return in words whether a replay with the log's own settings equals the log, or why it can't be compared."""
    if own.mismatch_count:
        return f"{own.mismatch_count} values differ from the log's"
    if not own.cycles:
        return "no cycle in it can be replayed"
    if own.compared == 0:
        return "nothing to compare with"
    exact = "bit for bit" if own.tolerance == 0.0 else f"within {own.tolerance:g} of each field's scale"
    return f"identical, {exact}"


def _as_text(path: Path, replays: "list[Replay]", names: list[str], shown: int, stretch: "TimeWindow") -> str:
    """Return a log's replays as text: the comparison with the log, then all replays side by side.

    names: of the variants; without any the second part is left out, unless no cycle was compared. shown: most
    mismatches that are listed. stretch: of the log, that was compared.
    """
    from adacd_hil.replay.replayed_outcome import NOTE, as_json, side_by_side

    own = replays[0]
    attempts = f" in {own.attempts} attempts" if own.attempts > 1 else ""
    where = "" if stretch.is_whole else f", {stretch.text}; replayed from the beginning of the log"
    states = f", {own.arms_compared} of them with the arm's states of the frames" if own.arms_compared else ""
    lines = [f"{path}: {_verdict(own)}: {own.compared} of {own.cycles} cycles{attempts} compared{states}{where}"]
    lines += [f"  {mismatch.line(own.zero_ns)}" for mismatch in own.mismatches[:shown]]
    if own.mismatch_count > shown:
        lines.append(f"  … {own.mismatch_count} in all: " + _counts(own))
    lines += [f"  {note}" for note in own.notes]
    alike = [name for name, found in zip(names, replays[1:], strict=True) if as_json(found) == as_json(own)]
    lines += [
        f"  every figure is the original's with {name}: scheme {own.settings.scheme} may not use it" for name in alike
    ]
    lines = [in_line(line) for line in lines]
    if not names and own.compared:
        return "\n".join(lines)
    head = ["", "original", *names]
    rows = [tuple(row) for row in side_by_side(replays)]
    if len(names) > _MOST_COLUMNS:
        turned = list(zip(*rows, strict=True))
        head, rows = ["", *turned[0]], [(name, *row) for name, row in zip(head[1:], turned[1:], strict=True)]
    return "\n".join([*lines, "", format_table(head, rows), "", NOTE])


def _counts(own: "Replay") -> str:
    return ", ".join(f"{count} of {field}" for field, count in own.mismatched_fields.items())


def _as_json(
    path: Path, replays: "list[Replay]", names: list[str], shown: int, stretch: "TimeWindow"
) -> dict[str, Any]:
    from adacd_hil.replay.replayed_outcome import as_json
    from adacd_hil.settings.setting_keys import changed_keys

    own = replays[0]
    return {
        "log": path,
        **stretch.named_bounds,
        "identical": own.is_identical,
        "cycles": own.cycles,
        "compared": own.compared,
        "arms_compared": own.arms_compared,
        "attempts": own.attempts,
        "tolerance": own.tolerance,
        "mismatch_count": own.mismatch_count,
        "mismatched_fields": own.mismatched_fields,
        "mismatches": own.mismatches[:shown],
        "notes": own.notes,
        "original": as_json(own),
        "variants": [
            {"name": name, "settings": changed_keys(own.settings, found.settings), **as_json(found)}
            for name, found in zip(names, replays[1:], strict=True)
        ],
    }
