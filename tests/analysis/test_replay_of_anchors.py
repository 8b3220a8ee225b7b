"""A replay comes to what the log says of a certificate and of one that was withheld."""

from pathlib import Path

import pytest

from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.log.reader import read_log
from adacd_hil.records import CERTIFICATE_EVENTS
from adacd_hil.replay.replay import replay, replay_many
from adacd_hil.replay.replayed_outcome import side_by_side
from adacd_hil.scheme.identify import anchor
from adacd_hil.scheme.pipeline.certificate_watch import THIS_RUN_ONLY
from adacd_hil.settings.setting_keys import apply_settings

pytestmark = [pytest.mark.slow, pytest.mark.long]

LEAN = """
lasts_s = 6.0
start_deg = [-30.0, -60.0]

[[contacts]]
at_s = 0.0
link = 1
point_m = 0.25
force_N = 2.0
duration_s = 2.0
angle_deg = 90.0
"""


TILT = """
lasts_s = 12.0

[mechanics]
tilt_deg = 2.0
holding_brake_Nm = [5.0, 2.0]
"""


def log_of(folder: Path, scenario: str) -> Path:
    (folder / "scenario.toml").write_text(scenario)
    plan = resolve("certified", str(folder / "scenario.toml"), None, None)
    summary, _ = run_embedded(plan, "lockstep", folder / "out")
    return summary.log.path


@pytest.fixture(scope="module")
def leant_on(tmp_path_factory) -> Path:
    """The log of an arm that somebody leans on for the first 2 s."""
    return log_of(tmp_path_factory.mktemp("leant_on"), LEAN)


def events_of(path: Path) -> list[str]:
    names = (logged.event.name for logged in read_log(path).events)
    return [name for name in names if name in CERTIFICATE_EVENTS]


def test_the_log_says_that_a_certificate_was_withheld_and_what_anchors_the_one_that_was_not(leant_on):
    assert events_of(leant_on) == ["anchor", "certificate"]
    found = replay(leant_on, script_of=ScriptedOperator)
    assert found.mismatches == ()
    assert found.is_identical


def test_a_certificate_that_a_torque_by_place_withholds_is_withheld_again(tmp_path):
    log = log_of(tmp_path, TILT)
    assert "position" in events_of(log)
    assert replay(log, script_of=ScriptedOperator).is_identical


def test_another_word_about_a_certificate_is_a_difference(leant_on, monkeypatch):
    monkeypatch.setattr(anchor, "describe", lambda k, m: "something else")
    (mismatch,) = replay(leant_on, script_of=ScriptedOperator).mismatches
    assert (mismatch.topic, mismatch.field) == ("/events", "certificate")
    assert mismatch.replayed.startswith("'info: something else; a push of ")
    assert mismatch.replayed.endswith(f"; {THIS_RUN_ONLY}'")


def test_threshold_and_smallest_push_are_rows_that_follow_the_settings(leant_on):
    own = replay(leant_on, script_of=ScriptedOperator).settings
    louder = apply_settings(own, {"certified.noise_sigmas": "12"})
    rows = {row[0]: row[1:] for row in side_by_side(replay_many(leant_on, [own, louder]))}
    for name in ("threshold, Nm", "smallest push in 100 ms, Nm"):
        mine, other = ([float(value) for value in cell.split(" / ")] for cell in rows[name])
        assert len(mine) == 2
        assert all(more > less > 0.0 for less, more in zip(mine, other, strict=True))
