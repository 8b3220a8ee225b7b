"""`adacd-hil identify`: a model of another lab's arm from its recordings, and contacts in them."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from adacd_hil.cli.options import json_option, stretch_options, typed_again
from adacd_hil.cli.output import CommandError, ExitCode, answer, explain_statuses, explained, format_table, quoted, show
from adacd_hil.file_access import write_new_file
from adacd_hil.file_replacement import replace_file
from adacd_hil.given_path import WRITTEN_FILE, WRITTEN_FOLDER, GivenPath
from adacd_hil.log.log_files import failing_as
from adacd_hil.plain_values import json_text
from adacd_hil.printable import in_line
from adacd_hil.progress_lines import Progress
from adacd_hil.settings.toml_files import parse_toml
from adacd_hil.settings.toml_text import toml_value

if TYPE_CHECKING:
    from adacd_hil.lab.offline.recording_identification import Identified, Watched
    from adacd_hil.lab.offline.recording_import import ForeignRecording
    from adacd_hil.log.time_window import TimeWindow


_RECORDING = GivenPath()
"""Path of a file, or of a rosbag's folder."""


@click.command(
    epilog=explain_statuses(
        OK="done",
        FAILURE="a recording can't be read",
        USAGE="wrong usage or map",
        PARTIAL="the model doesn't explain the test; the verdict gives the reason",
    )
)
@click.argument("recordings", nargs=-1, required=True, type=_RECORDING)
@click.option("--map", "map_path", type=WRITTEN_FILE, help="TOML: meaning of the columns, and the arm.")
@click.option("--init", "is_init", is_flag=True, help="Write that map: --init RECORDING URDF.")
@click.option("--test", type=_RECORDING, help="Recording to test on; default: the last part of the last one fitted.")
@click.option("--watch", multiple=True, type=_RECORDING, help="Recording in which to look for contacts; repeatable.")
@click.option("--out", type=WRITTEN_FOLDER, help="Folder for pictures and identify.json.")
@json_option
@explained
@stretch_options
def identify(
    recordings: tuple[Path, ...],
    map_path: Path | None,
    is_init: bool,
    test: Path | None,
    watch: tuple[Path, ...],
    out: Path | None,
    as_json: bool,
    stretch: "TimeWindow",
) -> ExitCode:
    """Identify an arm from RECORDINGS of positions, torques and, if there are some, velocities: CSV, MCAP, rosbags.

    RECORDINGS are of free motion; --from and --until choose a stretch of each. The verdict tells whether the model
    explains their torque, the reasons if not, and the next step. With the model frozen, contacts are detected in the
    recordings of --watch. With --init a recording and a URDF make a map; its guesses are listed.
    """
    from adacd_hil.lab.offline.recording_identification import identify as run
    from adacd_hil.lab.offline.recording_import import read_recording
    from adacd_hil.lab.offline.recording_map import read_map

    if is_init:
        return _init(recordings, map_path)
    if map_path is None:
        raise CommandError("--map is missing; `adacd-hil identify --init RECORDING URDF` writes one", ExitCode.USAGE)
    described = read_map(map_path)
    with Progress() as progress:
        read: list[ForeignRecording] = []
        for place, path in enumerate((*recordings, *((test,) if test else ()), *watch)):
            progress(f"reading {path}")
            span = stretch if place < len(recordings) else None
            read.append(read_recording(path, described, read[0].period_s if read else 0.0, span))
        fitted = [recording.between(*stretch) for recording in read[: len(recordings)]]
        tested = read[len(recordings)] if test else None
        progress(f"fitting {sum(recording.duration_s for recording in fitted):.1f} s")
        found = run(described, fitted, tested, read[len(recordings) + bool(test) :])
    answer(as_json, found.by_key(), _as_text(found), *_next(found, recordings[0]))
    if out is not None:
        with Progress() as progress, failing_as(f"pictures in {out} can't be written"):
            _write(found, out)
            progress(f"pictures in {out}")
    is_judged = found.is_explained and not any(watched.faults for watched in found.watched)
    return ExitCode.OK if is_judged else ExitCode.PARTIAL


def _init(given: tuple[Path, ...], map_path: Path | None) -> ExitCode:
    """Write the map of a recording by a URDF, and print its guesses; return OK. given: recording and URDF.

    map_path: file to write; None: map.toml beside the recording. An equal map may be there already. Raises CommandError
    for other files, or if another map is in the way; ConfigError, LogError if recording and URDF don't give a map;
    OSError if it can't be written.
    """
    from adacd_hil.lab.offline.map_draft import draft_map, map_text
    from adacd_hil.lab.offline.recording_map import parse_map

    urdfs = [path for path in given if path.suffix.lower() in (".urdf", ".xml")]
    others = [path for path in given if path not in urdfs]
    if len(urdfs) != 1 or len(others) != 1:
        raise CommandError("--init takes one recording and one URDF, a file that ends in .urdf", ExitCode.USAGE)
    recording = others[0]
    target = map_path or recording.parent / "map.toml"
    keys = draft_map(recording, urdfs[0], target)
    text = map_text(recording, keys)
    parse_map(parse_toml(text), target)
    try:
        write_new_file(target, text.encode())
    except FileExistsError:
        line = f"{target} is another map already; --map names a file for this one"
        raise CommandError(line, ExitCode.USAGE) from None
    guesses = [(f"{key.section}.{key.key}", toml_value(key.value), key.reason) for key in keys if key.reason]
    table = format_table(("key", "value", "a guess, because"), guesses)
    written = f"{target} written" + (f"; look at these:\n{table}" if guesses else ", without guesses")
    show(written, f"adacd-hil identify {quoted(recording)} --map {quoted(target)}")
    return ExitCode.OK


def _next(found: "Identified", recording: Path) -> tuple[str, ...]:
    if found.verdict.remedy:
        return (f"{found.verdict.remedy}; then identify again",)
    if found.watched:
        return ()
    again = typed_again("--watch", str(recording))
    return (f"{again}   # contacts in it; or name a recording of a touched arm",)


def _write(found: "Identified", out: Path) -> None:
    from adacd_hil.lab.offline.recording_identification import draw_watched

    out.mkdir(parents=True, exist_ok=True)
    replace_file(out / "identify.json", json_text(found.by_key()))
    names = ["test", *(f"watch{index + 1}" for index in range(len(found.watched)))]
    for name, watched in zip(names, (found.test, *found.watched), strict=True):
        replace_file(out / f"{name}.png", draw_watched(found, watched, name).png())


def _as_text(found: "Identified") -> str:
    from adacd_hil.lab.offline.recording_verdict import percent

    certificate, verdict = found.certificate, found.verdict
    parameters = [
        (name, f"{value:.5g}", f"± {std:.2g}")
        for name, value, std in zip(found.model.parameter_names, found.estimate.theta, found.deviation, strict=True)
    ]
    joints = [
        (
            joint.name,
            *(f"{value:.3g}" for value in (noise, rms, largest)),
            f"{joint.margin:.2f}" if math.isfinite(joint.margin) else "-",
            percent(joint.share),
        )
        for joint, noise, rms, largest in zip(
            verdict.joints,
            found.settings.noise_Nm,
            certificate.residual_rms_Nm,
            certificate.residual_max_Nm,
            strict=True,
        )
    ]
    columns = ("joint", "noise, Nm", "residual rms, Nm", "largest, Nm", "margin", "torque explained")
    lines = [
        *(in_line(f"{path.name}: {note}") for path, notes in found.notes.items() for note in notes),
        f"fitted {found.fit_s:.1f} s at {found.settings.period_s * 1e3:g} ms",
        format_table(("parameter", "value", "std"), parameters, right=(1,)),
        "",
        f"tested on {found.test.recording.duration_s:.1f} s: {verdict.headline}",
        *(f"  because {reason}" for reason in map(in_line, verdict.reasons)),
        *(f"  note: {remark}" for remark in map(in_line, verdict.remarks)),
        format_table(columns, joints, right=(1, 2, 3, 4, 5)),
    ]
    return "\n".join([*lines, *(_describe(watched) for watched in found.watched)])


def _describe(watched: "Watched") -> str:
    name = in_line(str(watched.recording.path))
    if watched.faults:
        return "\n".join(["", f"{name}: not judged", *(f"  because {fault}" for fault in map(in_line, watched.faults))])
    lines = ["", f"{name}: {len(watched.contacts)} contacts in {watched.recording.duration_s:.1f} s"]
    if watched.touches is not None:
        found = watched.touches - (watched.missed or 0)
        lines[-1] += f"; {found} of {watched.touches} touches found, {watched.false_contacts} false"
    for contact in watched.contacts:
        signs = " ".join("0+-"[sign] for sign in contact.direction)
        truth = "  false" if contact.is_true is False else ""
        lines.append(f"  {contact.start_s:9.3f} s  link {contact.link}  {signs}{truth}")
    return "\n".join(lines)
