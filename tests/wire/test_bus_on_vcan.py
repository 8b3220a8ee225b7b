"""Real SocketCAN: what crosses, what is filtered, and how each way of failing shows and is recovered from."""

import contextlib
import itertools
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator

import pytest
from hang import HANG_S

from adacd_hil.clock import MonotonicClock
from adacd_hil.wire.bus import BusError, BusMissingError, BusOffError, Frame, InterfaceDownError, TransmitQueueError
from adacd_hil.wire.can_interface import CanInterface
from adacd_hil.wire.error_frames import TroubleKind, decode_error
from adacd_hil.wire.open_bus import open_bus
from adacd_hil.wire.socketcan import SocketCanBus

pytestmark = pytest.mark.vcan

CHANNEL = "vcan1"  # vcan0 is left as it is for those who share it
CLASSIC = struct.Struct("=IB3x8s")
OLD_DATA, NEW_DATA = b"old", b"new"


Ends = tuple[SocketCanBus, SocketCanBus]


def open_end(can_ids: list[int] | None = None, is_fd: bool = False) -> SocketCanBus:
    return SocketCanBus(CHANNEL, MonotonicClock(), can_ids, is_fd)


@pytest.fixture
def ends() -> Iterator[Ends]:
    near, far = open_end(), open_end()
    yield near, far
    near.close()
    far.close()


@pytest.fixture
def fd_ends() -> Iterator[Ends]:
    near, far = open_end(is_fd=True), open_end(is_fd=True)
    yield near, far
    near.close()
    far.close()


@pytest.fixture
def raw() -> Iterator[socket.socket]:
    """A plain socket on the same interface, FD frames on."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as peer:
        peer.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        peer.settimeout(HANG_S)
        peer.bind((CHANNEL,))
        yield peer


def run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)


@contextlib.contextmanager
def plugged(frames: int) -> Iterator[None]:
    """Keep the interface from sending: `frames` classic frames wait in its queue, as with nobody to acknowledge."""
    run("tc", "qdisc", "add", "dev", CHANNEL, "root", "plug", "limit", str(16 * frames))
    try:
        yield
    finally:
        run("tc", "qdisc", "del", "dev", CHANNEL, "root")


def unplug() -> None:
    """Let out what waits and everything after it."""
    run("tc", "qdisc", "change", "dev", CHANNEL, "root", "plug", "release_indefinite")


@contextlib.contextmanager
def taken_down() -> Iterator[None]:
    run("ip", "link", "set", CHANNEL, "down")
    try:
        yield
    finally:
        run("ip", "link", "set", CHANNEL, "up")


def error_frame(error_class: int, data: str = "0000000000000000") -> bytes:
    return CLASSIC.pack(0x20000000 | error_class, 8, bytes.fromhex(data))


def received(bus: SocketCanBus, count: int) -> list[tuple[int, bytes]]:
    frames = [bus.receive(HANG_S) for _ in range(count)]
    return [(frame.can_id, frame.data) for frame in frames if frame]


def test_a_frame_crosses_vcan_and_does_not_echo(ends: Ends) -> None:
    near, far = ends
    near.send(0x201, b"\x01\x02\x03\x04\x05\x06")
    assert received(far, 1) == [(0x201, b"\x01\x02\x03\x04\x05\x06")]
    assert near.receive(0.01) is None


def test_the_kernel_filters_other_identifiers(raw: socket.socket) -> None:
    bus = open_end([0x181])
    for can_id in (0x182, 0x80000181, 0x40000181, 0x181):  # another, 29 bits, remote, ours
        raw.send(CLASSIC.pack(can_id, 1, can_id.to_bytes(8, "big")))
    frames = received(bus, 1)
    rest = bus.receive(0.01)
    bus.close()
    assert frames == [(0x181, b"\0")]
    assert rest is None


def test_without_a_filter_remote_and_ambiguous_frames_stay_out(raw: socket.socket) -> None:
    bus = open_end()
    extended = [0x80000040 | 1 << bit for bit in range(11, 29)]  # with the bit that means bus-off in an error frame
    for can_id in (0x40000181, 0x80000181, 0x800007FF, 0xC0001800, *extended, 0x7FF):
        raw.send(CLASSIC.pack(can_id, 0, b""))
    frames = received(bus, 19)
    rest = bus.receive(0.01)
    bus.close()
    assert [can_id for can_id, _ in frames] == [*(can_id & 0x1FFFFFFF for can_id in extended), 0x7FF]
    assert rest is None


@pytest.mark.parametrize("length", [0, 1, 8, 12, 24, 64])
def test_on_an_fd_bus_more_than_8_bytes_are_an_fd_frame_with_bit_rate_switch_and_fewer_a_classic_one(
    length: int, fd_ends: Ends, raw: socket.socket
) -> None:
    near, far = fd_ends
    data = bytes(range(1, length + 1))
    near.send(0x181, data)
    packed = raw.recv(72)
    if length <= 8:
        assert packed == CLASSIC.pack(0x181, length, data)
    else:
        can_id, count, flags, padded = struct.unpack("=IBB2x64s", packed)
        assert (can_id, count, padded) == (0x181, length, data.ljust(64, b"\0"))
        assert flags & 0x03 == 0x01  # CANFD_BRS without CANFD_ESI; newer kernels add CANFD_FDF
    assert received(far, 1) == [(0x181, data)]


def test_a_short_fd_frame_of_others_is_received(fd_ends: Ends, raw: socket.socket) -> None:
    raw.send(struct.pack("=IBB2x64s", 0x181, 4, 0, b"abcd"))
    assert received(fd_ends[0], 1) == [(0x181, b"abcd")]


def test_a_frame_of_no_valid_length_and_a_long_one_on_a_bus_opened_without_fd_are_refused(
    ends: Ends, fd_ends: Ends
) -> None:
    with pytest.raises(BusError, match=r"can't have 13 data bytes, only 12, 16, 20, 24, 32, 48, 64"):
        fd_ends[0].send(0x181, bytes(13))
    with pytest.raises(BusError, match="12 data bytes need CAN FD, and it was opened without"):
        ends[0].send(0x181, bytes(12))


def test_a_bus_opened_without_fd_receives_no_fd_frames(ends: Ends, raw: socket.socket) -> None:
    raw.send(struct.pack("=IBB2x64s", 0x181, 12, 1, bytes(12)))
    raw.send(CLASSIC.pack(0x182, 0, b""))
    assert received(ends[0], 1) == [(0x182, b"")]


@pytest.mark.slow
def test_an_interface_of_classic_frames_is_no_fd_bus_and_the_remedy_is_the_one_that_helps() -> None:
    with taken_down():
        run("ip", "link", "set", CHANNEL, "mtu", "16")
    try:
        open_bus("socketcan", CHANNEL, MonotonicClock()).close()
        with pytest.raises(BusMissingError) as caught:
            open_bus("socketcan", CHANNEL, MonotonicClock(), is_fd=True)
        text, remedy = str(caught.value).split("): ")
        run("sh", "-c", remedy)
        open_bus("socketcan", CHANNEL, MonotonicClock(), is_fd=True).close()
    finally:
        with taken_down():
            run("ip", "link", "set", CHANNEL, "mtu", "72")
    assert text == f"CAN interface {CHANNEL} carries classic frames only (MTU 16, CAN FD needs 72"


def test_an_interface_that_is_missing_or_down_is_not_opened() -> None:
    with pytest.raises(BusMissingError, match=r"CAN interface vcan9 does not exist; present: .*vcan0"):
        open_bus("socketcan", "vcan9", MonotonicClock())
    with taken_down(), pytest.raises(BusMissingError, match=f"is down; bring it up: ip link set {CHANNEL} up"):
        open_bus("socketcan", CHANNEL, MonotonicClock())


@pytest.mark.parametrize(
    ("error_class", "data", "kind"),
    [
        (0x020, "0000000000000000", TroubleKind.NO_ACKNOWLEDGE),
        (0x204, "0020000000008000", TroubleKind.ERROR_PASSIVE),
        (0x088, "0000040a00000000", TroubleKind.PROTOCOL),
        (0x100, "0000000000000000", TroubleKind.RESTARTED),
        (0x001, "0000000000000000", TroubleKind.TRANSMIT_TIMEOUT),
    ],
)
def test_trouble_on_the_bus_is_handed_out_though_other_identifiers_are_filtered(
    error_class: int, data: str, kind: TroubleKind, raw: socket.socket
) -> None:
    bus = open_end([0x181])
    raw.send(error_frame(error_class, data))
    frame = bus.receive(HANG_S)
    bus.close()
    assert frame is not None
    assert frame == Frame(error_class, bytes.fromhex(data), frame.t_ns, is_error=True)
    assert decode_error(frame)[0] is kind


def test_bus_off_is_an_error_that_carries_its_frame_and_the_bus_goes_on_when_the_controller_does(
    raw: socket.socket,
) -> None:
    bus = open_end([0x181])
    raw.send(error_frame(0x040))
    raw.send(error_frame(0x100))
    raw.send(CLASSIC.pack(0x181, 0, b""))
    with pytest.raises(BusOffError, match=f"{CHANNEL} is bus-off: .*restart-ms 100") as caught:
        bus.receive(HANG_S)
    restarted, frame = bus.receive(HANG_S), bus.receive(HANG_S)
    bus.close()
    assert caught.value.frame.can_id == 0x040
    assert "\n" not in str(caught.value)
    assert restarted is not None
    assert decode_error(restarted)[0] is TroubleKind.RESTARTED
    assert frame is not None
    assert (frame.can_id, frame.is_error) == (0x181, False)


@pytest.mark.parametrize("is_looked_at", [False, True])
def test_frames_that_the_kernel_dropped_are_known_by_the_next_frame_or_a_look_and_over_a_recovery_too(
    is_looked_at: bool, raw: socket.socket
) -> None:
    bus = open_end([0x181])
    sent = 2000
    for _ in range(sent):
        raw.send(CLASSIC.pack(0x181, 0, b""))
    waiting = bus.queue_bytes() if is_looked_at else None
    kept = 0
    while bus.receive(0.1) is not None:
        kept += 1
    if waiting is not None:
        assert waiting.received > 100_000
        assert bus.queue_bytes() == (0, 0)
    else:
        raw.send(CLASSIC.pack(0x181, 0, b""))
        assert bus.receive(HANG_S) is not None
    dropped = bus.frames_lost
    bus.recover()
    after = bus.frames_lost
    bus.close()
    assert 0 < kept < sent
    assert dropped == after == sent - kept


def test_what_was_lost_is_known_with_the_first_frame_after_it(raw: socket.socket) -> None:
    bus = open_end([0x181])
    numbers = iter(range(1 << 20))

    def send(count: int) -> None:
        for _ in range(count):
            raw.send(CLASSIC.pack(0x181, 4, next(numbers).to_bytes(4, "big")))

    seen: list[tuple[int, int]] = []

    def read(count: int) -> None:
        for _ in range(count):
            frame = bus.receive(0.1)
            if frame is None:
                return
            seen.append((int.from_bytes(frame.data, "big"), bus.frames_lost))

    send(2000)
    for _ in range(3):  # some room, a few frames, and again none: losses in the middle of what one system call takes
        read(70)
        send(150)
    read(2000)
    bus.close()
    jumps = [(after - before - 1, lost - known) for (before, known), (after, lost) in itertools.pairwise(seen)]
    assert sum(jump > 0 for jump, _ in jumps) >= 3
    assert [jump for jump, _ in jumps] == [lost for _, lost in jumps]


def test_who_hears_everything_has_room_for_what_it_reads_late(raw: socket.socket) -> None:
    bus = open_end()
    for _ in range(2000):
        raw.send(CLASSIC.pack(0x181, 0, b""))
    heard = 0
    while bus.receive(0.1) is not None:
        heard += 1
    bus.close()
    assert (heard, bus.frames_lost) == (2000, 0)


def test_what_waits_to_be_sent_shows_in_the_queue(ends: Ends) -> None:
    near, _ = ends
    with plugged(frames=10):
        near.send_all([(0x201, OLD_DATA)] * 4)
        few = near.queue_bytes().sent
        near.send_all([(0x201, OLD_DATA)] * 4)
        many = near.queue_bytes().sent
    assert few > 0
    assert many == 2 * few


def test_frames_without_room_are_waited_for_and_a_queue_that_stays_full_has_a_remedy(ends: Ends) -> None:
    near, _ = ends
    full = f"transmit queue of {CHANNEL} stayed full.*txqueuelen"
    with plugged(frames=3), pytest.raises(TransmitQueueError, match=full) as caught:
        near.send_all([(0x201, OLD_DATA)] * 5)
    assert "\n" not in str(caught.value)
    with plugged(frames=3):
        near.send_all([(0x201, OLD_DATA)] * 3)
        waiting = CanInterface(CHANNEL).waiting_frames()
    assert waiting == 3


@pytest.mark.slow
def test_a_queue_that_drains_in_time_is_no_error(ends: Ends) -> None:
    near, far = ends
    with plugged(frames=10):
        for _ in range(10):
            near.send(0x201, OLD_DATA)
        # released from another process while `send` waits for room; it may come late, so more than once
        release = subprocess.Popen(["tc", "qdisc", "change", "dev", CHANNEL, "root", "plug", "release_indefinite"])
        while True:
            with contextlib.suppress(TransmitQueueError):
                near.send(0x202, NEW_DATA)
                break
        assert release.wait(HANG_S) == 0
        frames = received(far, 11)
        rest = far.receive(0.05)
    assert rest is None
    assert frames == [(0x201, OLD_DATA)] * 10 + [(0x202, NEW_DATA)]


def fill_queue(bus: SocketCanBus) -> int:
    """Send until the queue stays full; return how many frames wait."""
    count = 0
    with contextlib.suppress(TransmitQueueError):
        while True:
            bus.send(0x201, OLD_DATA)
            count += 1
    return count


@pytest.mark.slow
def test_no_old_command_gets_out_after_a_recovery(ends: Ends) -> None:
    near, far = ends
    with plugged(frames=512):
        assert fill_queue(near) > 200
        near.recover()
        far.recover()  # it saw the interface go down
        unplug()
        near.send(0x202, NEW_DATA)
        frames = received(far, 1)
        rest = far.receive(0.05)
    assert frames == [(0x202, NEW_DATA)]
    assert rest is None


def test_a_recovery_drops_what_was_received_and_leaves_an_interface_alone_that_holds_nothing(
    ends: Ends, raw: socket.socket
) -> None:
    near, far = ends
    far.send(0x181, OLD_DATA)
    near.receive(0.0)
    far.send(0x181, OLD_DATA)
    near.recover()
    far.send(0x181, NEW_DATA)
    assert received(near, 1) == [(0x181, NEW_DATA)]
    near.send(0x202, NEW_DATA)
    assert received(far, 1) == [(0x202, NEW_DATA)]
    assert raw.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == 0


def test_a_recovery_keeps_filters_error_mask_and_fd(raw: socket.socket) -> None:
    bus = open_end([0x181], is_fd=True)
    bus.recover()
    raw.send(CLASSIC.pack(0x182, 0, b""))
    raw.send(error_frame(0x020))
    raw.send(struct.pack("=IBB2x64s", 0x181, 24, 1, bytes(range(24))))
    error, frame = bus.receive(HANG_S), bus.receive(HANG_S)
    bus.close()
    assert error is not None
    assert error.is_error
    assert frame is not None
    assert (frame.can_id, frame.data) == (0x181, bytes(range(24)))


@pytest.mark.slow
def test_a_recovery_that_is_not_permitted_names_the_command_and_leaves_the_bus_as_it_is() -> None:
    """In a process of its own, which gives CAP_NET_ADMIN up."""
    script = f"""
import ctypes, os
from adacd_hil.clock import MonotonicClock
from adacd_hil.wire.bus import BusError
from adacd_hil.wire.socketcan import SocketCanBus
bus = SocketCanBus({CHANNEL!r}, MonotonicClock())
bus.send(0x201, b"old")
os.setgroups([])
os.setresgid(65534, 65534, 65534)
os.setresuid(65534, 65534, 65534)
try:
    bus.recover()
except BusError as error:
    print(error)
bus.send(0x201, b"old")
"""
    if os.geteuid() != 0:
        pytest.skip("needs to be root, to stop being it")
    with plugged(frames=10):
        done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
        waiting = CanInterface(CHANNEL).waiting_frames()
    assert done.stdout == (
        f"old frames may wait in the transmit queue of {CHANNEL}, and dropping them needs CAP_NET_ADMIN; "
        f"run: sudo ip link set {CHANNEL} down && sudo ip link set {CHANNEL} up\n"
    )
    assert waiting == 2


@pytest.mark.slow
def test_an_interface_that_goes_down_has_a_remedy_and_frames_flow_again_after_a_recovery_and_not_before(
    ends: Ends,
) -> None:
    near, far = ends
    with taken_down():
        with pytest.raises(InterfaceDownError, match=f"is down; bring it up: ip link set {CHANNEL} up") as sending:
            near.send(0x80, b"\x01")
        with pytest.raises(InterfaceDownError, match=f"receiving on {CHANNEL}: .* is down") as receiving:
            far.receive(HANG_S)
        with pytest.raises(InterfaceDownError, match="is down; bring it up"):
            near.recover()
    assert "\n" not in str(sending.value) + str(receiving.value)
    for use in (lambda: near.send(0x80, b"\x01"), lambda: near.receive(0.01), lambda: near.receive(0.0)):
        with pytest.raises(InterfaceDownError, match="was down and is up again"):
            use()
    near.recover()
    far.recover()
    near.send(0x80, NEW_DATA)
    assert received(far, 1) == [(0x80, NEW_DATA)]
    far.send(0x81, NEW_DATA)
    assert received(near, 1) == [(0x81, NEW_DATA)]


@pytest.mark.slow
def test_an_interface_that_vanishes_and_returns_is_recovered_from() -> None:
    name = "vcan7"
    run("ip", "link", "add", "dev", name, "type", "vcan")
    run("ip", "link", "set", name, "up")
    bus = SocketCanBus(name, MonotonicClock())
    try:
        run("ip", "link", "del", name)
        with pytest.raises(InterfaceDownError, match=f"CAN interface {name} does not exist; present: "):
            bus.receive(HANG_S)
        with pytest.raises(InterfaceDownError, match=f"{name} does not exist"):
            bus.recover()
        run("ip", "link", "add", "dev", name, "type", "vcan")
        run("ip", "link", "set", name, "up")
        bus.recover()
        bus.send(0x201, NEW_DATA)
    finally:
        bus.close()
        run("ip", "link", "del", name)


def test_a_closed_end_says_so() -> None:
    bus = open_end()
    bus.close()
    bus.close()
    for use in (lambda: bus.send(0x80, b""), lambda: bus.receive(0.01), bus.recover):
        with pytest.raises(BusError, match=f"{CHANNEL}: closed"):
            use()
