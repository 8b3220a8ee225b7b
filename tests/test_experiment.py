"""The experiment in one process with the paper's scheme: the figures it must reach, and that it can be repeated bit for
bit."""

from pathlib import Path

import numpy as np
import pytest
from experiment_runs import Played, demo

from adacd_hil.log.reader import read_log

pytestmark = [pytest.mark.slow, pytest.mark.long]

SEED = "7"
TIMES = {
    "P": {"A": pytest.approx(5.20, abs=0.02), "D": pytest.approx(5.28, abs=0.02)},
    "S": {"A": pytest.approx(5.26, abs=0.35), "D": pytest.approx(5.25, abs=0.02)},
    "M": {"A": pytest.approx(7.5, abs=0.5), "D": pytest.approx(5.25, abs=0.03)},
}
"""How long both adaptations take, by profile."""


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Played]:
    return {name: demo(tmp_path_factory.mktemp(name), "--profile", name, "--seed", SEED) for name in TIMES}


@pytest.mark.parametrize("profile", TIMES)
def test_both_adaptations_take_their_time(played: dict[str, Played], profile: str) -> None:
    assert played[profile].json["adaptation_s"] == TIMES[profile]


@pytest.mark.parametrize("profile", TIMES)
def test_every_contact_is_detected_in_time_with_its_link_and_direction_and_none_is_false(
    played: dict[str, Played], profile: str
) -> None:
    report = played[profile].json
    contacts = report["contacts"]
    assert (len(contacts), report["missed"], report["false_alarms"]) == (8, 0, 0)
    assert [contact["link_detected"] for contact in contacts] == [contact["link"] for contact in contacts]
    assert all(contact["direction_ok"] for contact in contacts)
    assert max(contact["delay_ms"] - contact["law_ms"] for contact in contacts) <= 2.5 + 1.0
    residuals = report["frozen_residual_max_Nm"]
    assert max(*residuals["B"]["identified"], *residuals["E"]["identified"]) <= 0.07


def test_the_identified_inertia_follows_the_payload(played: dict[str, Played]) -> None:
    parameters = played["P"].json["parameters"]
    true, identified = zip(*[parameters["D"][name] for name in ("a1", "a2", "a3")], strict=True)
    np.testing.assert_allclose(identified, true, rtol=0.12)


def test_the_experiment_ends_well_and_its_log_is_whole(played: dict[str, Played]) -> None:
    assert {profile: run.status for profile, run in played.items()} == {"P": 0, "S": 0, "M": 0}
    assert played["P"].json["log"]["dropped"] == 0
    names = {path.name for path in played["P"].folder.iterdir()}
    assert names >= {"run.mcap", "truth.mcap", "report.html", "report.json"}


@pytest.mark.parametrize("seed", [SEED, "8"])
def test_a_seed_gives_its_own_numbers_bit_for_bit(played: dict[str, Played], tmp_path: Path, seed: str) -> None:
    (tmp_path / "short.toml").write_text('[operator]\nscript = [{ at_s = 0.5, request = "finish" }]\n')
    other = demo(tmp_path, "--seed", seed, "--config", str(tmp_path / "short.toml"))
    ours, theirs = (read_log(one.log).scheme.records[:600] for one in (played["P"], other))
    assert len(ours) == len(theirs) == 600
    assert (ours.tobytes() == theirs.tobytes()) == (seed == SEED)
