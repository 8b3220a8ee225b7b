"""`adacd-hil history`: the certificates of an arm's runs."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adacd_hil.cli.options import json_option
from adacd_hil.cli.output import EPILOG, CommandError, ExitCode, answer, explained, format_table
from adacd_hil.file_replacement import has_other_head, replace_file
from adacd_hil.given_path import GIVEN_FILE, WRITTEN_FILE
from adacd_hil.printable import in_line

if TYPE_CHECKING:
    from adacd_hil.control.history_file import History

_PNG = b"\x89PNG\r\n\x1a\n"


@click.command(epilog=EPILOG)
@click.argument("file", type=GIVEN_FILE)
@click.option("--plot", type=WRITTEN_FILE, help="Draw it, as PNG.")
@json_option
@explained
def history(file: Path, plot: Path | None, as_json: bool) -> ExitCode:
    """List the certificates of an arm's runs: friction, inertia, torque offsets, and the sources of each.

    `adacd-hil run --history FILE` makes the file. A file that was damaged or edited is refused.
    """
    from adacd_hil.control.history_file import read_history

    found = read_history(file)
    if plot is not None:
        if plot.exists() and plot.samefile(file):
            raise CommandError(f"--plot {plot} is the history itself; give another name", ExitCode.USAGE)
        if has_other_head(plot, _PNG):
            raise CommandError(f"--plot {plot} is there already and no PNG; give another name", ExitCode.USAGE)
        replace_file(plot, _as_png(found))
    answer(as_json, found, _as_text(found))
    return ExitCode.OK


def _as_png(found: "History") -> bytes:
    import numpy as np

    from adacd_hil.lab.drawing import HistoryPanel, history_figure
    from adacd_hil.records import FRICTION_AT, FRICTION_AT_RAD_S

    shown = found.certificates
    joints = tuple(f"joint {number}" for number in range(1, len(found.last.offset_Nm) + 1))

    def panel(title: str, names: tuple[str, ...], values: str, std: str, at: Any = slice(None)) -> HistoryPanel:
        found, deviations = (np.array([getattr(each, name)[at] for each in shown]) for name in (values, std))
        return title, names, found, deviations

    title = f"Friction at {FRICTION_AT_RAD_S:g} rad/s, Nm"
    panels = (
        panel(title, joints, "friction_Nm", "friction_std_Nm", FRICTION_AT),
        panel("Inertia, kg m²", ("a1", "a2", "a3"), "inertia_kgm2", "inertia_std_kgm2"),
        panel("Torque offset, Nm", joints, "offset_Nm", "offset_std_Nm"),
    )
    return history_figure([certificate.date_utc for certificate in shown], panels).png()


def _as_text(found: "History") -> str:
    from adacd_hil.records import FRICTION_AT, FRICTION_AT_RAD_S

    devices = ", ".join(f"{device.name} {device.serial}" for device in found.devices)
    head = ("certified", "F1 Nm", "F2 Nm", "a1 kg m²", "a2 kg m²", "a3 kg m²", "offset Nm", "payload", "known by")
    rows = []
    for certificate in found.certificates:
        rows.append(
            [
                certificate.date_utc,
                *(f"{value:.3f}" for value in certificate.friction_Nm[FRICTION_AT]),
                *(f"{value:.4f}" for value in certificate.inertia_kgm2),
                ", ".join(f"{value:.3f}" for value in certificate.offset_Nm),
                "yes" if certificate.is_payload else "",
                certificate.text,
            ]
        )
    table = format_table(head, rows, right=(1, 2, 3, 4, 5))
    return f"{in_line(f'devices by serial number: {devices}')}\nfriction F at {FRICTION_AT_RAD_S:g} rad/s\n{table}"
