"""Shows that other programs' players drive our host: the same states in order, the same contacts.

    python tools/play_into_host.py LOG CONFIG PLAYER FILE --folder FOLDER

LOG: of a run with the period PERIOD_MS. CONFIG: of the host. PLAYER: canplayer, can_player or
adacd-hil. FILE: what it plays, the cyclic frames of LOG's devices only:

    can_logconvert LOG all.log
    grep -E ' 18[1-4]#' all.log >cyclic.log
    can_logconvert cyclic.log cyclic.mcap

SDO, NMT and heartbeats are answered by `firmware-sim play LOG --answers-only`. A host takes frames that come early
enough after its SYNC, and a player knows no SYNC: one whose frames come at another time is started again,
later by what is missing, while the host waits in COMMISSION. CONFIG has `sample_period = "measured"`: what is played
goes by the clock. Needs vcan0, as `tools/with-vcan` gives.
"""

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path

from adacd_hil.clock import MonotonicClock
from adacd_hil.log.log_files import LOG_NAME
from adacd_hil.log.reader import RunLog, read_log
from adacd_hil.wire.socketcan import SocketCanBus

CHANNEL = "vcan0"
SYNC, FEEDBACK = 0x080, 0x181
LIMIT_S = 120
TRIES = 12
PERIOD_MS = 10.0
AIM_MS = 3.5
"""Of the first frame after SYNC."""
MOST_OFF_MS = 1.5
MEASURED = 15
"""Frames of which the median counts."""


def tool(name: str, *arguments: object) -> list[str]:
    """Return the command line of a program beside this interpreter."""
    return [str(Path(sys.executable).parent / name), *map(str, arguments)]


def player(name: str, file: Path) -> list[str]:
    """Return the command line of a player."""
    if name == "canplayer":
        return ["chrt", "-f", "70", "canplayer", "-I", str(file), f"{CHANNEL}=embedded"]
    if name == "can_player":
        return ["chrt", "-f", "70", *tool("can_player", "-i", "socketcan", "-c", CHANNEL, file)]
    return tool("adacd-hil", "play", file, "-i", "socketcan", "-c", CHANNEL)


def await_sync(bus: SocketCanBus) -> int:
    """Wait for the host's next SYNC; return its time."""
    while (frame := bus.receive(LIMIT_S)) is not None:
        if frame.can_id == SYNC:
            return frame.t_ns
    raise SystemExit("the host sends no SYNC")


def phase_ms(bus: SocketCanBus) -> float:
    """Measure how long after SYNC the player's frames come."""
    sync_ns, phases = 0, []
    while len(phases) < MEASURED and (frame := bus.receive(10.0)) is not None:
        if frame.can_id == SYNC:
            sync_ns = frame.t_ns
        elif frame.can_id == FEEDBACK and sync_ns:
            phases.append((frame.t_ns - sync_ns) * 1e-6)
    return statistics.median(phases) if phases else AIM_MS


def start_in_phase(bus: SocketCanBus, command: list[str]) -> "subprocess.Popen[bytes]":
    """Start a player whose frames come soon after SYNC."""
    clock = MonotonicClock()
    delay_ms = 0.0
    for _ in range(TRIES):
        while bus.receive(0.0) is not None:
            pass
        clock.sleep_until_ns(await_sync(bus) + round(delay_ms * 1e6))
        played = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        off_ms = phase_ms(bus) - AIM_MS
        if abs(off_ms) <= MOST_OFF_MS:
            return played
        played.terminate()
        played.wait()
        delay_ms = (delay_ms - off_ms) % PERIOD_MS
    raise SystemExit("the player was never in phase with the host")


def decisions(log: RunLog) -> tuple[list[str], list[tuple[int, tuple[int, int]]]]:
    """List the transitions, and link and direction of each final contact report."""
    transitions = [e.event.message for e in log.events if e.event.name == "supervisor"]
    contacts = [(each.link, tuple(map(int, each.direction))) for _, each in log.contacts if each.is_final]
    return transitions, contacts


def main() -> None:
    """Play, compare, print."""
    described = (__doc__ or "").replace("PERIOD_MS", f"{PERIOD_MS:g} ms")
    parser = argparse.ArgumentParser(description=described, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("config", type=Path)
    parser.add_argument("player", choices=["canplayer", "can_player", "adacd-hil"])
    parser.add_argument("file", type=Path)
    parser.add_argument("--folder", type=Path, required=True)
    options = parser.parse_args()
    recorded = decisions(read_log(options.log))
    devices = tool("firmware-sim", "play", options.log, "-i", "socketcan", "-c", CHANNEL, "--answers-only")
    host = tool("adacd-hil", "run", "-i", "socketcan", "-c", CHANNEL, "--config", options.config, "--clock", "realtime")
    bus = SocketCanBus(CHANNEL, MonotonicClock(), (SYNC, FEEDBACK))
    with subprocess.Popen(devices, stderr=subprocess.PIPE, text=True) as arm:
        assert arm.stderr is not None
        while arm.stderr.readline().strip() not in ("ready", ""):
            pass
        command = [*host, "--out", str(options.folder), "--json"]
        with (
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as run,
            start_in_phase(bus, player(options.player, options.file)) as played,
        ):
            stdout, _ = run.communicate(timeout=LIMIT_S)
            played.terminate()
        arm.terminate()
    ours = decisions(read_log(options.folder / LOG_NAME))
    result = {
        "player": options.player,
        "run": json.loads(stdout),
        "transitions": ours[0],
        "recorded_transitions": recorded[0],
        "contacts": ours[1],
        "recorded_contacts": recorded[1],
        "is_same": ours == recorded,
    }
    print(json.dumps(result, indent=2))
    raise SystemExit(0 if result["is_same"] else 1)


if __name__ == "__main__":
    main()
