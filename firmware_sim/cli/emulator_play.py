"""`firmware-sim play`: the devices, with an arm that does again what a recording says."""

import json
import sys
from contextlib import ExitStack
from pathlib import Path

import click

from adacd_hil.clock import MonotonicClock
from adacd_hil.given_path import GivenPath
from adacd_hil.log.editing.attached import run_metadata
from adacd_hil.log.errors import LogError
from adacd_hil.scheduling import freeze_garbage, request_realtime
from adacd_hil.terminal import one_line
from adacd_hil.wire.codec import Codec, load_codec
from adacd_hil.wire.node_offset import move_contract
from firmware_sim.bench.bench import ClockMode
from firmware_sim.bench.recorded_bench import RecordedBench
from firmware_sim.bench.recorded_cycles import RecordedCycles
from firmware_sim.canopen.contracts import CONTRACTS
from firmware_sim.cli.departure import Departure
from firmware_sim.cli.emulator_options import on_bus
from firmware_sim.cli.service import Service, open_devices_end, stop_by_signal
from firmware_sim.scenario.scenario import load_scenario

_OK, _FAILURE = 0, 1
_QUIET_SCENARIO = "idle"


@click.command(
    "play",
    epilog="Exit status: 0 ended by SIGINT, SIGTERM, SIGHUP or --once; 1 failure (the bus failed, the recording is "
    "damaged or of another contract); 2 wrong usage; 5 bus missing.",
)
@click.argument("log", type=GivenPath(dir_okay=False))
@on_bus
@click.option(
    "--answers-only", is_flag=True, help="Leave the answers to SYNC to somebody else on the bus, such as canplayer."
)
@click.option("--once", "is_once", is_flag=True, help="End with the first host that starts the nodes and goes.")
@click.option("--json", "as_json", is_flag=True, help="Print how it went as JSON on stdout.")
def play(
    log: Path,
    interface: str,
    channel: str,
    contract: str,
    node_offset: int,
    host_node: int,
    clock_mode: ClockMode,
    answers_only: bool,
    is_once: bool,
    as_json: bool,
) -> int:
    """Play the devices of a recording: on each SYNC the frames that answered it then; all else is answered live.

    Reads MCAP, candump .log, BLF, ASC, MF4, TRC and CSV. What the host commands moves nothing. After the recording's
    last cycle SYNC is no longer answered. Prints "ready" on stderr once the nodes have announced themselves.
    """
    chosen = CONTRACTS[contract]
    codec = move_contract(load_codec(chosen.path), node_offset, host_node)
    _check_contract(log, codec)
    cycles = None if answers_only else RecordedCycles(log, codec)
    clock = MonotonicClock()
    with ExitStack() as stack:
        bus = open_devices_end(interface, channel, clock, codec)
        stack.callback(bus.close)
        stop = stack.enter_context(stop_by_signal())
        departure = Departure(bus)
        bench = RecordedBench(
            load_scenario(_QUIET_SCENARIO, None, None),
            codec,
            departure.send,
            cycles,
            clock_mode=clock_mode,
            contract=chosen,
            on_answer=departure.go,
        )
        service = Service(bench, bus, departure, clock, clock_mode, stop, is_once)
        for line in request_realtime().missing:
            print(f"firmware-sim: not granted: {line}", file=sys.stderr)
        freeze_garbage()
        service.boot()
        print("ready", file=sys.stderr, flush=True)
        service.run()
        return _report(bench, cycles, as_json)


def _check_contract(log: Path, codec: Codec) -> None:
    """Raise LogError when a log of ours says that it was recorded with another contract."""
    digest = run_metadata(log).get("layout_digest", "") if log.suffix.lower() == ".mcap" else ""
    own = f"0x{codec.layout_digest:08X}"
    if digest and digest.casefold() != own.casefold():
        raise LogError(
            f"{log} was recorded with another contract: layout digest {digest}, here {own}; "
            "see --contract, --node-offset and --host-node"
        )


def _report(bench: RecordedBench, cycles: RecordedCycles | None, as_json: bool) -> int:
    problem = "" if cycles is None else cycles.problem
    if problem:
        print(f"firmware-sim: {one_line(problem)}", file=sys.stderr)
    if as_json:
        described = {
            "cycles": bench.cycle + 1,
            "answered": 0 if cycles is None else cycles.answered,
            "is_over": cycles is not None and cycles.is_over,
            "drive_states": [drive.state.value for drive in bench.drives],
            "rejected_commands": [drive.rejected_commands for drive in bench.drives],
            "problem": problem,
        }
        print(json.dumps(described))
    return _FAILURE if problem else _OK
