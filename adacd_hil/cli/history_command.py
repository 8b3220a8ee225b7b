"""`adacd-hil history`: what an arm's runs have certified."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from adacd_hil.cli.exit_codes import EPILOG, ExitCode
from adacd_hil.cli.options import explained, json_option

if TYPE_CHECKING:
    from adacd_hil.control.history_file import History


@click.command(epilog=EPILOG)
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--plot", type=click.Path(path_type=Path, dir_okay=False), help="Draw it, as PNG.")
@json_option
@explained
def history(file: Path, plot: Path | None, as_json: bool) -> ExitCode:
    """List what an arm's runs have certified: friction, inertia, torque offsets, and what they are known by.

    `adacd-hil run --history FILE` makes the file. A file that is not as it was written is refused.
    """
    from adacd_hil.control.history_file import read_history

    found = read_history(file)
    if plot is not None:
        plot.write_bytes(_as_png(found))
    print(json.dumps(dataclasses.asdict(found), indent=2) if as_json else _as_text(found))
    return ExitCode.OK


def _as_png(found: "History") -> bytes:
    import numpy as np

    from adacd_hil.analysis.history_figure import Panel, history_figure

    shown = found.certificates
    friction, friction_std = (
        np.array([values[1::3] for values in column])
        for column in ([each.friction_Nm for each in shown], [each.friction_std_Nm for each in shown])
    )
    joints = tuple(f"joint {number}" for number in range(1, friction.shape[1] + 1))
    inertia, inertia_std = np.array([[each.inertia_kgm2, each.inertia_std_kgm2] for each in shown]).swapaxes(0, 1)
    offset, offset_std = np.array([[each.offset_Nm, each.offset_std_Nm] for each in shown]).swapaxes(0, 1)
    panels = (
        Panel("Friction at 0.6 rad/s, Nm", joints, friction, friction_std),
        Panel("Inertia, kg m²", ("a1", "a2", "a3"), inertia, inertia_std),
        Panel("Torque offset, Nm", joints, offset, offset_std),
    )
    return history_figure([each.date_utc for each in shown], panels).png()


def _as_text(found: "History") -> str:
    from adacd_hil.cli.table import format_table

    devices = ", ".join(f"{device.name} {device.serial}" for device in found.devices)
    head = ("certified", "F1 Nm", "F2 Nm", "a1 kg m²", "a2 kg m²", "a3 kg m²", "offset Nm", "payload", "known by")
    rows = []
    for certificate in found.certificates:
        _, f1, _, _, f2, _ = certificate.friction_Nm
        rows.append(
            [
                certificate.date_utc,
                f"{f1:.3f}",
                f"{f2:.3f}",
                *(f"{value:.4f}" for value in certificate.inertia_kgm2),
                ", ".join(f"{value:.3f}" for value in certificate.offset_Nm),
                "yes" if certificate.is_payload else "",
                certificate.text,
            ]
        )
    table = format_table(head, rows, right=(1, 2, 3, 4, 5))
    return f"devices by serial number: {devices}\nfriction F at 0.6 rad/s\n{table}"
