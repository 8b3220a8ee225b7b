"""The commands that look at an arm, each as a process, against the emulator on real SocketCAN."""

import contextlib
import json
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from experiment_runs import BIN, Played, adacd_hil, emulator
from hang import HANG_S

pytestmark = [pytest.mark.vcan, pytest.mark.slow]

ON_VCAN = ("-i", "socketcan", "-c", "vcan0")
CONTROLWORD = slice(2, 4)
SO_RCVBUFFORCE = 33  # asm-generic/socket.h; the socket module has no name for it


def command(folder: Path, *arguments: str) -> Played:
    return adacd_hil(folder, arguments[0], *ON_VCAN, *arguments[1:])


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Run one emulated arm for all tests of this file that don't need their own."""
    folder = tmp_path_factory.mktemp("arm")
    with emulator(folder, "--scenario", "idle"):
        yield folder


@contextlib.contextmanager
def other_program(sends: str, every_s: float) -> Iterator[None]:
    """Run a program with a raw socket `can` on vcan0 while the block lasts that `sends` at a rate."""
    program = (
        "import socket, struct, time\n"
        "can = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)\n"
        "can.bind(('vcan0',))\n"
        "def send(can_id, data): can.send(struct.pack('=IB3x8s', can_id, len(data), data))\n"
        "print('begins', flush=True)\n"
        f"while True:\n {sends}\n time.sleep({every_s})\n"  # the sender's rate; no test waits for it
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"begins\n"
            yield
        finally:
            process.kill()


@contextlib.contextmanager
def listening() -> Iterator[list[tuple[int, bytes]]]:
    """Collect what is on vcan0 during the block; filled when it ends."""
    frames: list[tuple[int, bytes]] = []
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as can:
        try:
            can.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, 1 << 28)
        except PermissionError:  # as much as anybody gets
            can.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 23)
        can.bind(("vcan0",))
        yield frames
        can.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                packed = can.recv(16)
                frames.append((int.from_bytes(packed[:4], sys.byteorder), packed[8 : 8 + packed[4]]))


def test_scan_finds_the_arm_sends_uploads_only_and_lists_strangers(arm: Path) -> None:
    with other_program("send(0x055, b'abc')", 0.01), listening() as frames:
        scanned = command(arm, "scan", "--json")
    assert scanned.status == 0, scanned.stderr
    nodes = [(node["node"], node["device"], node["serial"], node["verdict"]) for node in scanned.json["nodes"]]
    assert nodes == [
        (1, "CiA 402 drive", 1, ""),
        (2, "CiA 402 drive", 2, ""),
        (3, "CiA 404 measuring device", 3, ""),
        (4, "CiA 404 measuring device", 4, ""),
    ]
    (stranger,) = scanned.json["others"]
    assert (stranger["id"], stranger["message"], stranger["length"]) == (0x055, "unknown", "3")
    requests = [(can_id, data[0] & 0xEF) for can_id, data in frames if can_id & 0x780 == 0x600]
    assert {code for _, code in requests} == {0x40, 0x60}
    assert {can_id & 0x780 for can_id, _ in frames if can_id != 0x055} <= {0x580, 0x600, 0x700}


@pytest.mark.wallclock
def test_doctor_passes_the_arm_and_leaves_it_pre_operational(arm: Path, tmp_path: Path) -> None:
    with listening() as frames:
        done = command(tmp_path, "doctor", "--json")
    found = {check["name"]: check for check in done.json["checks"]}
    failures = [name for name, check in found.items() if check["status"] == "failed"]
    assert failures in ([], ["rate"])  # the machine may stall
    assert done.status == (1 if failures else 0)
    assert found["interface"]["reason"] == "vcan0 is up, vcan: virtual, without bit rate and arbitration"
    assert found["PDO map"]["status"] == "ok"
    assert [data for can_id, data in frames if can_id == 0x000][-1] == b"\x80\x00"
    assert {data[CONTROLWORD] for can_id, data in frames if can_id in (0x201, 0x202)} == {b"\x00\x00"}


@pytest.mark.long
def test_an_interrupted_doctor_leaves_the_nodes_pre_operational(arm: Path) -> None:
    with listening() as frames:
        process = subprocess.Popen(
            [BIN / "adacd-hil", "doctor", *ON_VCAN], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert process.stderr is not None
        assert any(line == "PDO map: ok\n" for line in process.stderr)
        process.send_signal(signal.SIGTERM)
        stdout, stderr = process.communicate(timeout=HANG_S)
    assert (process.returncode, stdout) == (130, "")
    assert stderr.splitlines()[-1] == "adacd-hil: interrupted"
    assert [data for can_id, data in frames if can_id == 0x000][-1] == b"\x80\x00"


def test_monitor_with_json_ends_with_one_snapshot_at_ctrl_c(tmp_path: Path) -> None:
    with other_program("send(0x709, b'\\5')", 0.01):
        process = subprocess.Popen(
            [BIN / "adacd-hil", "monitor", *ON_VCAN, "--seconds", "600", "--node", "9", "--json"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stderr is not None
        assert process.stderr.readline() == "listening on vcan0\n"
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as can:
            can.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", 0x709, 0x7FF))
            can.bind(("vcan0",))
            can.recv(16)  # the other program has begun
        process.send_signal(signal.SIGINT)
        stdout, _ = process.communicate(timeout=HANG_S)
    (node,) = json.loads(stdout)["nodes"]
    assert (process.returncode, node["state"]) == (0, "operational")
