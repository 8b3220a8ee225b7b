"""Shows that other programs' players drive our host: the same states in order, the same contacts.

    python tools/play_into_host.py LOG CONFIG PLAYER FILE --folder FOLDER

LOG: of a run, 10 ms periods are realistic in user-mode Linux. CONFIG: of the host. PLAYER: canplayer, can_player or
adacd-hil. FILE: what it plays, the cyclic frames of LOG's devices only:

    adacd-hil log export LOG --format candump --only devices --id 181 --id 182 --id 183 --id 184 --out cyclic.log
    can_logconvert cyclic.log cyclic.mcap

The player starts with the host's first SYNC after NMT start; SDO, NMT and heartbeats are answered by
`firmware-sim play LOG --answers-only`. Needs vcan0, as `tools/with-vcan` gives.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from adacd_hil.clock import MonotonicClock
from adacd_hil.log.reader import RunLog, read_log
from adacd_hil.wire.socketcan import SocketCanBus

CHANNEL = "vcan0"
NMT, SYNC = 0x000, 0x080
LIMIT_S = 120


def tool(name: str, *arguments: object) -> list[str]:
    """Return the command line of a program beside this interpreter."""
    return [str(Path(sys.executable).parent / name), *map(str, arguments)]


def player(name: str, file: Path) -> list[str]:
    """Return the command line of a player."""
    if name == "canplayer":
        return ["canplayer", "-I", str(file), f"{CHANNEL}=embedded"]
    if name == "can_player":
        return tool("can_player", "-i", "socketcan", "-c", CHANNEL, file)
    return tool("adacd-hil", "play", file, "-i", "socketcan", "-c", CHANNEL)


def await_first_sync(bus: SocketCanBus) -> None:
    """Wait until the host has started the nodes and asks for their first cycle."""
    is_started = False
    while (frame := bus.receive(LIMIT_S)) is not None:
        is_started = is_started or (frame.can_id == NMT and frame.data[:1] == b"\x01")
        if is_started and frame.can_id == SYNC:
            return
    raise SystemExit("the host has not started")


def decisions(log: RunLog) -> tuple[list[str], list[tuple[int, tuple[int, int]]]]:
    """List the transitions, and link and direction of each final contact report."""
    transitions = [e.event.message for e in log.events if e.event.name == "supervisor"]
    contacts = [(c.report.link, tuple(map(int, c.report.direction))) for c in log.contacts if c.report.is_final]
    return transitions, contacts


def main() -> None:
    """Play, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("config", type=Path)
    parser.add_argument("player", choices=["canplayer", "can_player", "adacd-hil"])
    parser.add_argument("file", type=Path)
    parser.add_argument("--folder", type=Path, required=True)
    options = parser.parse_args()
    recorded = decisions(read_log(options.log))
    devices = tool("firmware-sim", "play", options.log, "-i", "socketcan", "-c", CHANNEL, "--answers-only")
    host = tool("adacd-hil", "run", "-i", "socketcan", "-c", CHANNEL, "--config", options.config, "--clock", "realtime")
    bus = SocketCanBus(CHANNEL, MonotonicClock(), (NMT, SYNC))
    with subprocess.Popen([*devices, "--clock", "wall"], stderr=subprocess.PIPE, text=True) as arm:
        assert arm.stderr is not None
        while arm.stderr.readline().strip() not in ("ready", ""):
            pass
        command = [*host, "--out", str(options.folder), "--json"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as run:
            await_first_sync(bus)
            with subprocess.Popen(player(options.player, options.file), stdout=subprocess.DEVNULL) as played:
                stdout, _ = run.communicate(timeout=LIMIT_S)
                played.terminate()
        arm.terminate()
    ours = decisions(read_log(options.folder / "run.mcap"))
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
