"""The scenarios that come with the package: each says what it is about and expects, and some are played."""

from pathlib import Path

import pytest
from long_cases import long_but
from mcap.reader import make_reader
from played_outcome import deviations, expected_of, outcome_of

from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.clock import REALTIME, wall_ns
from adacd_hil.log.reader import read_log
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.toml_text import to_short_toml, to_toml
from firmware_sim.scenario.faults import KINDS
from firmware_sim.scenario.scenario import Scenario, builtin_scenarios, load_scenario

NAMES = builtin_scenarios()
GROUPS = {"experiment", "people", "mechanics", "measurement", "faults", "minutes"}
PLAYED = (
    "blow-chest",
    "wrong-node-id",
    "clamped-lower-arm-link1",
    "dropped-payload",
    "power-loss-and-return",
    "one-percent-loss",
)
"""One of each way to end that a short run can have."""
SHORT_TOML = """
lasts_s = 0.4

[expect]
adaptations = 0
contacts = 0
"""


@pytest.mark.parametrize("name", NAMES)
def test_a_scenario_says_what_happens_and_what_a_host_makes_of_it_and_survives_being_written(
    name: str, tmp_path: Path
) -> None:
    scenario = load_scenario(name)
    assert scenario.name == name
    assert scenario.about.endswith(".")
    assert scenario.group in GROUPS
    assert scenario.expect is not None
    assert scenario.expect_certified != scenario.expect  # it is there because it is another
    things = (*scenario.contacts, *scenario.bodies, *scenario.hands, *scenario.walls, *scenario.payloads)
    assert [thing.at_s for thing in things if thing.at_s >= scenario.lasts_s] == []
    path = tmp_path / "written.toml"
    for write in (to_toml, to_short_toml):
        path.write_text(write(scenario), encoding="utf-8")
        assert load_scenario(str(path)) == scenario


def test_awkward_text_survives_being_written(tmp_path: Path) -> None:
    scenario = parse(Scenario, {"about": 'tab\t, "quotes", back\\slash, \x01, ²'})
    path = tmp_path / "written.toml"
    path.write_text(to_short_toml(scenario), encoding="utf-8")
    assert load_scenario(str(path)).about == scenario.about


def test_every_kind_of_fault_befalls_some_scenario() -> None:
    assert {row.kind for name in NAMES for row in load_scenario(name).faults} >= set(KINDS)


@pytest.mark.slow
@pytest.mark.parametrize("name", long_but(2, PLAYED))
def test_a_run_of_it_comes_to_what_it_expects(name: str, tmp_path: Path) -> None:
    cast = resolve("paper", name, None, None)
    outcome = outcome_of(*run_embedded(cast, "lockstep", tmp_path))
    assert cast.scenario.expect is not None
    assert deviations(cast.scenario.expect, outcome) == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", long_but(1, ["push-during-adaptation", "payload-fitted-in-motion", "hand-helps-and-lets-go"])
)
def test_a_certified_host_comes_to_what_is_expected_of_it(name: str, tmp_path: Path) -> None:
    cast = resolve("certified", name, None, None)
    outcome = outcome_of(*run_embedded(cast, "lockstep", tmp_path))
    expected = expected_of(cast.scenario, "certified")
    assert expected is not None
    assert expected != cast.scenario.expect
    assert deviations(expected, outcome) == ()


def test_the_user_of_a_scenario_only_acknowledges_and_finishes() -> None:
    settings, scenario, *_ = resolve("paper", "power-loss-and-return", None, None)
    assert [(entry.at_s, entry.request) for entry in settings.operator.script] == [(scenario.lasts_s, "finish")]
    assert (settings.operator.acknowledge_after_s, settings.operator.acknowledge_faults) == (0.6, 1)


def test_the_papers_experiment_keeps_the_script_of_the_configuration() -> None:
    settings, *_ = resolve("paper", "paper", None, None)
    assert [entry.request for entry in settings.operator.script] == ["payload", "payload_changed", "finish"]


@pytest.mark.parametrize(
    ("scenario", "profile", "expected"),
    [("geared-arm", None, "M"), ("geared-arm", "S", "S"), ("idle", None, "P"), ("idle", "M", "M")],
)
def test_host_and_arm_are_of_one_profile(scenario: str, profile: str | None, expected: str) -> None:
    cast = resolve("paper", scenario, profile, None)
    assert (cast.settings.arm.profile, cast.scenario.profile) == (expected, expected)


def test_a_configuration_of_another_profile_counts_where_the_scenario_names_none(tmp_path: Path) -> None:
    config = tmp_path / "mine.toml"
    config.write_text("[arm]\nprofile = 'S'\n")
    assert resolve(str(config), "idle", None, None).scenario.profile == "S"
    assert resolve(str(config), "geared-arm", None, None).settings.arm.profile == "M"


@pytest.mark.slow
def test_the_logs_of_a_short_scenario_name_it_and_its_faults(tmp_path: Path) -> None:
    path = tmp_path / "short.toml"
    path.write_text(
        f"{SHORT_TOML}\n[[faults]]\nkind = 'emcy_storm'\nnode = 'sensor1'\ncode = 4096\nrate_Hz = 100.0\nat_s = 0.1\n"
    )
    summary, truth_path = run_embedded(resolve("paper", str(path), None, None), "lockstep", tmp_path)
    assert read_log(summary.log.path).metadata["scenario"] == "short"
    events = [entry.event.message for entry in read_log(truth_path).events]
    assert [text for text in events if text.startswith("begins: emcy_storm of sensor1")] != []


@pytest.mark.slow
@pytest.mark.wallclock
def test_both_logs_of_a_run_in_real_time_have_the_date(tmp_path: Path) -> None:
    path = tmp_path / "short.toml"
    path.write_text("lasts_s = 0.1\n")
    begun_ns = wall_ns()
    summary, truth_path = run_embedded(resolve("paper", str(path), None, None), REALTIME, tmp_path)
    for log in (summary.log.path, truth_path):
        with log.open("rb") as file:
            _, _, first = next(make_reader(file).iter_messages())
        assert begun_ns <= first.log_time <= wall_ns()
