"""Frames of a recording that `play` chooses."""

import numpy as np
from recorded_run import CODEC, make_run, record
from test_can_io import write

from adacd_hil.lab.logs.frame_choice import FrameChoice, sides
from adacd_hil.lab.logs.python_can_files import TimedMessage
from adacd_hil.log.frames.frame_log import open_frames, read_frames


def test_frames_are_chosen_by_side_identifier_and_time(tmp_path):
    log = tmp_path / "run.mcap"
    record(log, make_run(60, start_ns=5_000_000_000), epoch_ns=1_790_000_000_123_456_789)
    host_ids, device_ids = sides(CODEC)
    frames = read_frames(log).frames

    def chosen(**choice):
        return np.concatenate(
            list(FrameChoice(host_ids=host_ids, device_ids=device_ids, **choice).pieces(open_frames(log)))
        )

    hosts = chosen(only="host")
    assert set(hosts["can_id"].tolist()) == {0x080, 0x201, 0x202}  # one of which the run says that it was received
    assert len(chosen(only="devices")) + len(hosts) == len(frames)
    assert set(chosen(can_ids=frozenset({0x181, 0x182}))["can_id"].tolist()) == {0x181, 0x182}
    part = chosen(start_ns=10_000_000, end_ns=20_000_000)
    assert (part["t_ns"].min() - frames["t_ns"][0], len(np.unique(part["cycle_t_ns"]))) == (10_000_000, 10)


def test_whose_a_frame_is_says_the_contract_and_else_its_direction(tmp_path):
    kinds = [(0x080, True), (0x181, False), (0x7A5, True), (0x7A6, False)]  # identifier, received
    messages = [TimedMessage(1, arbitration_id=can_id, is_extended_id=False, is_rx=is_rx) for can_id, is_rx in kinds]
    messages.append(TimedMessage(2, arbitration_id=0x080, is_error_frame=True))
    write(tmp_path / "x.mcap", messages)
    host_ids, device_ids = sides(CODEC)
    choice = FrameChoice("host", host_ids, device_ids)
    (frames,) = choice.pieces(open_frames(tmp_path / "x.mcap"))
    assert frames["can_id"].tolist() == [0x080, 0x7A6]
