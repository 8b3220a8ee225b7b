"""A known arm by the commands, on real SocketCAN: what is stored of its run, the files included."""

import pytest
from experiment_runs import Played
from reference_runs import (
    CYCLES,
    SHARE,
    Reference,
    bit_differences,
    decision_differences,
    known_arm,
    play_on_vcan,
)

from adacd_hil.control.history_file import read_history
from adacd_hil.log.log_parts import parts_of
from adacd_hil.log.reader import read_log

pytestmark = [pytest.mark.vcan, pytest.mark.slow]

NAME = "certified-known"


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return play_on_vcan(NAME, tmp_path_factory.mktemp("known"))


def test_the_commands_come_to_the_stored_decisions_and_bits(played: Played) -> None:
    """To the bits where the numbers are computed as they were stored."""
    stored, now = Reference.stored(NAME), Reference.of(read_log(played.log))
    assert (played.status, played.error_lines) == (0, [])
    assert len(parts_of(played.log)) == 3
    is_same = stored.arithmetic == now.arithmetic
    assert decision_differences(stored, now, *((0, 0.0) if is_same else (CYCLES, SHARE))) == []
    assert (bit_differences(stored, now) if is_same else []) == []


def test_they_add_the_certificate_to_the_history(played: Played) -> None:
    _, history = known_arm(NAME)
    before, after = read_history(history), read_history(played.folder / history.name)
    assert after.certificates[:-1] == before.certificates
    assert after.last.text.endswith(f"within what the certificate of {before.last.date_utc} allows")
