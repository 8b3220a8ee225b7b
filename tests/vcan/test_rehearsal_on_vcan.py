"""The arm of `init` on vcan: the emulator plays it, the host rehearses with the same file."""

import pytest
from experiment_runs import Played, adacd_hil, emulator, run_on_vcan
from own_arm import EIGHT_TOUCHES, describe_arm, describe_geared_arm

from adacd_hil.lab.report.run_reading import read_run
from adacd_hil.lab.score.evaluation import evaluate

pytestmark = [pytest.mark.vcan, pytest.mark.slow]


@pytest.fixture(scope="module", params=[describe_arm, describe_geared_arm])
def rehearsed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Played:
    """Write the arm's file with `init`, then play eight touches on vcan."""
    folder = tmp_path_factory.mktemp("rehearsal")
    written = adacd_hil(folder, "init", *request.param(folder))
    assert written.status == 0, written.stderr
    (folder / "touches.toml").write_text(EIGHT_TOUCHES)
    play = ("--config", str(folder / "my-arm.toml"), "--scenario", str(folder / "touches.toml"))
    with emulator(folder, *play):
        return run_on_vcan(folder, *play, "--clock", "lockstep")


def test_the_rehearsal_of_an_own_arm_certifies_it_and_finds_all_touches(rehearsed: Played) -> None:
    assert (rehearsed.status, rehearsed.json["state"]) == (0, "MONITOR"), rehearsed.stderr
    assert "model certified" in rehearsed.stderr
    run, gathered, _ = read_run(rehearsed.log, rehearsed.folder / "truth.mcap")
    judged = evaluate(run, gathered)
    assert (len(judged.contacts), judged.missed, judged.false_alarms) == (8, 0, 0)
    assert [contact.link_detected for contact in judged.contacts] == [1, 1, 2, 2, 1, 1, 2, 2]
    assert all(contact.direction_ok for contact in judged.contacts)
