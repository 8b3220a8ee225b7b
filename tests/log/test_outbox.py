"""Packets that are handed over together: all of them arrive, once, also when the control process dies."""

import os
import select

import pytest
from mcap.records import Message
from mcap.stream_reader import StreamReader
from recorded_run import feed, make_run, start, wait_until_taken

from adacd_hil.log.outbox import OUTBOX_BYTES, Outbox, read_outbox, split
from adacd_hil.log.reader import read_log
from adacd_hil.records import Event


@pytest.fixture
def outbox():
    outbox = Outbox()
    yield outbox
    outbox.close()


def test_what_is_put_in_is_sent_in_order(outbox):
    packets = [bytes([number]) * number for number in range(50)]
    assert all(outbox.put(packet) for packet in packets)
    assert outbox.count == 50
    assert split(outbox.batch()) == (1, packets)


def test_what_waits_can_be_read_from_the_shared_memory(outbox):
    outbox.put(b"first")
    outbox.put(b"second")
    assert split(read_outbox(outbox.descriptor)) == (1, [b"first", b"second"])


def test_a_packet_without_room_changes_nothing(outbox):
    outbox.put(b"first")
    assert not outbox.put(bytes(OUTBOX_BYTES - 20))
    assert split(outbox.batch()) == (1, [b"first"])
    assert outbox.count == 1


def test_a_packet_may_fill_the_outbox(outbox):
    assert not outbox.put(bytes(OUTBOX_BYTES - 15))
    assert outbox.put(bytes(OUTBOX_BYTES - 16))
    assert len(outbox.batch()) == OUTBOX_BYTES


def test_after_it_was_sent_a_batch_is_empty_and_has_the_next_number(outbox):
    outbox.put(b"first")
    outbox.clear()
    assert outbox.count == 0
    assert split(read_outbox(outbox.descriptor)) == (2, [])
    outbox.put(b"second")
    assert split(outbox.batch()) == (2, [b"second"])


def end_of(recorder):
    """End the connection as the death of the control process does, and wait for the writer's end."""
    descriptor = os.pidfd_open(recorder.pid)
    recorder._socket.close()
    ended, _, _ = select.select([descriptor], [], [], 30)
    os.close(descriptor)
    recorder._process.wait()
    recorder._outbox.close()
    return bool(ended)


@pytest.mark.slow
@pytest.mark.parametrize("is_sent", [False, True], ids=["before it was sent", "before it was cleared"])
def test_a_batch_is_written_once_though_the_control_process_dies(is_sent, tmp_path):
    run = make_run(12)
    recorder = start(tmp_path / "run.mcap", run)
    feed(recorder, run.cycles[:7])
    recorder.flush()
    feed(recorder, run.cycles[7:])
    if is_sent:
        recorder._hand_over(recorder._outbox.batch(), recorder._outbox.count)
    assert end_of(recorder)
    log = read_log(tmp_path / "run.mcap")
    assert log.summary["ending"] == "control process died"
    assert log.scheme.block.tobytes() == run.blocks.tobytes()
    assert log.is_complete


@pytest.mark.slow
def test_packets_that_do_not_fit_together_keep_their_order(tmp_path):
    recorder = start(tmp_path / "run.mcap", make_run(0))
    large = [(6, bytes(65000)), (6, bytes(65000))]
    for number in range(6):
        recorder.cycle(number, large if number % 2 else [(6, bytes(100))])
        recorder.event(number, Event("info", "n", str(number)))
    assert recorder.close().is_complete
    with (tmp_path / "run.mcap").open("rb") as file:
        times = [record.publish_time for record in StreamReader(file).records if isinstance(record, Message)]
    assert times == [0, 0, 1, 1, 1, 2, 2, 3, 3, 3, 4, 4, 5, 5, 5]


@pytest.mark.slow
def test_cycles_go_together_in_lockstep_and_alone_in_real_time(tmp_path):
    run = make_run(3)
    sizes = {}
    for blocking in (True, False):
        recorder = start(tmp_path / f"{blocking}.mcap", run, blocking=blocking)
        sent = []
        hand_over = recorder._hand_over
        recorder._hand_over = lambda data, count, hand_over=hand_over, sent=sent: (
            sent.append(count),
            hand_over(data, count),
        )
        feed(recorder, run.cycles)
        wait_until_taken(recorder)
        sizes[blocking] = sent
        assert recorder.close().is_complete
    assert sizes == {True: [3], False: [1, 1, 1]}
