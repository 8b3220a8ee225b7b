"""The host's heartbeat consumer."""

import pytest

from adacd_hil.device.arm_watch import HeartbeatWatch
from adacd_hil.records import Event
from adacd_hil.wire.bus import Frame

MS = 1_000_000
OPERATIONAL, PRE_OPERATIONAL, STOPPED, BOOT_UP = 5, 127, 4, 0


class Watched:
    """Two nodes, 100 ms."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.watch = HeartbeatWatch([("Drive1", 1), ("Sensor1", 3)], 100, self.events.append)

    def beat(self, t_ms: int, *nodes: int, state: int = OPERATIONAL) -> None:
        for node in nodes or (1, 3):
            self.watch.accept(Frame(0x700 + node, bytes((state,)), t_ms * MS))

    def at(self, t_ms: int) -> list[str]:
        return self.watch.judge_nodes(t_ms * MS)

    def run(self) -> "Watched":
        self.watch.start()
        self.at(0)
        self.beat(100)
        return self


def test_nodes_that_beat_are_fine() -> None:
    watched = Watched().run()
    for t_ms in range(200, 1000, 100):
        watched.beat(t_ms, state=OPERATIONAL | 0x80 * (t_ms == 500))  # node guarding's toggle bit is no part of it
        assert watched.at(t_ms + 99) == []
    assert watched.events == []


@pytest.mark.parametrize(
    ("t_ms", "said"), [(350, []), (351, ["Drive1 (node 1): no heartbeat for 251 ms, 250 ms allowed"])]
)
def test_a_node_is_silent_after_two_and_a_half_periods(t_ms: int, said: list[str]) -> None:
    watched = Watched().run()
    watched.beat(200, 3)
    watched.beat(300, 3)
    assert watched.at(t_ms) == said


def test_a_node_that_never_beat_is_silent_since_the_first_look() -> None:
    watched = Watched()
    watched.watch.start()
    assert watched.at(5000) == []
    assert watched.at(5250) == []
    assert len(watched.at(5251)) == 2


@pytest.mark.parametrize(
    ("state", "text"), [(PRE_OPERATIONAL, "is PRE-OPERATIONAL"), (STOPPED, "is STOPPED"), (BOOT_UP, "is boot-up")]
)
def test_a_node_that_is_not_operational_any_more_is_named(state: int, text: str) -> None:
    watched = Watched().run()
    watched.beat(200, 3)
    watched.beat(200, 1, state=state)
    assert watched.at(200) == [f"Drive1 (node 1): {text}, OPERATIONAL expected"]


def test_a_heartbeat_from_before_the_start_command_is_forgiven_for_a_while() -> None:
    watched = Watched()
    watched.watch.start()
    watched.at(0)
    watched.beat(10, state=PRE_OPERATIONAL)
    assert watched.at(11) == []


def test_a_node_that_never_became_operational_is_named() -> None:
    watched = Watched()
    watched.watch.start()
    for t_ms in range(0, 300, 50):
        watched.beat(t_ms, 1)
        watched.beat(t_ms, 3, state=PRE_OPERATIONAL)
        lines = watched.at(t_ms)
    assert lines == []
    watched.beat(300, 1)
    watched.beat(300, 3, state=PRE_OPERATIONAL)
    assert watched.at(300) == ["Sensor1 (node 3): is PRE-OPERATIONAL, OPERATIONAL expected"]


def test_a_node_that_left_operational_between_two_looks_is_named_once() -> None:
    watched = Watched().run()
    watched.beat(200, 3, state=PRE_OPERATIONAL)
    watched.beat(200)
    assert watched.at(201) == ["Sensor1 (node 3): is PRE-OPERATIONAL, OPERATIONAL expected"]
    assert watched.at(202) == []


def test_nothing_is_expected_but_between_start_and_stop_and_a_second_start_forgets_the_first() -> None:
    assert Watched().at(10_000) == []
    watched = Watched().run()
    watched.watch.stop()
    assert watched.at(10_000) == []
    watched.watch.start()
    assert watched.at(60_000) == []


def test_falling_out_and_returning_are_one_event_each() -> None:
    watched = Watched().run()
    for t_ms in (400, 450, 500):
        watched.beat(t_ms, 3)
        watched.at(t_ms)
    watched.beat(510)
    watched.at(520)
    watched.at(530)
    assert [(event.level, event.name, event.message) for event in watched.events] == [
        ("error", "Drive1", "heartbeat: no heartbeat for 300 ms, 250 ms allowed"),
        ("info", "Drive1", "heartbeat: OPERATIONAL again"),
    ]


@pytest.mark.parametrize(
    "frame",
    [
        Frame(0x702, b"\x05", 400 * MS),
        Frame(0x701, b"", 400 * MS),
        Frame(0x701, b"\x05\x05", 400 * MS),
        Frame(0x701, b"\x05", 400 * MS, is_error=True),
    ],
)
def test_what_is_no_heartbeat_of_a_watched_node_is_none(frame: Frame) -> None:
    watched = Watched().run()
    watched.beat(400, 3)
    watched.watch.accept(frame)
    assert len(watched.at(400)) == 1
