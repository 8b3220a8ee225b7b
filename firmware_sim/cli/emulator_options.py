"""Options that the commands on a bus share."""

from collections.abc import Callable
from typing import Any, get_args

import click

from adacd_hil.wire.node_offset import HOST_NODE
from firmware_sim.bench.bench import ClockMode
from firmware_sim.canopen.contracts import CONTRACTS
from firmware_sim.canopen.pdo_record import LAST_NODE

_DEVICES = 4
_OPTIONS = (  # last first: click lists them the other way round
    click.option(
        "--clock",
        "clock_mode",
        type=click.Choice(get_args(ClockMode)),
        default="sync",
        show_default=True,
        help="sync: the arm's time goes by SYNC. wall: by the clock, and the drives watch for SYNC.",
    ),
    click.option(
        "--host-node",
        type=click.IntRange(1, 127),
        default=HOST_NODE,
        show_default=True,
        help="Node id of the arm's host: bus.host_node of its configuration.",
    ),
    click.option(
        "--node-offset",
        type=click.IntRange(0, LAST_NODE - _DEVICES),
        default=0,
        show_default=True,
        help="Added to the devices' node ids: another arm on the bus.",
    ),
    click.option(
        "--contract",
        type=click.Choice(list(CONTRACTS)),
        default="arm",
        show_default=True,
        help="Which devices: DBC and EDS files of this name.",
    ),
    click.option("-c", "--channel", required=True, help="Channel of the interface, such as vcan0."),
    click.option("-i", "--interface", required=True, help="python-can interface, such as socketcan."),
)


def on_bus(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options of the bus and of the devices on it."""
    for option in _OPTIONS:
        command = option(command)
    return command
