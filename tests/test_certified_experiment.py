"""The demo as README and notebook have it: the certified scheme and, beside, the paper's, of the default seed."""

import copy
import json
import re
from pathlib import Path
from typing import Any

import pytest
from documents import ROOT
from experiment_runs import Played, adacd_hil
from notebook import pictures, printed, run_notebook

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    folder = tmp_path_factory.mktemp("certified") / "runs" / "demo"
    folder.mkdir(parents=True)
    played = adacd_hil(folder, "demo", "--out", str(folder), "--json")
    assert played.status == 0, played.stderr
    return played


@pytest.fixture(scope="module")
def report(played: Played) -> Any:
    return played.json


def test_detection_is_armed_with_a_certificate_before_the_papers_scheme_is(report: Any) -> None:
    armed_s, beside_s = report["adaptation_s"], report["certified"]["paper_beside"]["adaptation_s"]
    assert armed_s["A"] <= 2.5
    assert armed_s["D"] <= 1.0
    assert all(5.0 <= time_s <= 8.0 for time_s in beside_s.values())
    assert report["certified"]["tests"] == {"A": 1, "D": 1}


def test_every_contact_is_found_sooner_than_by_the_papers_scheme_and_none_is_false(report: Any) -> None:
    beside = report["certified"]["paper_beside"]
    assert (len(report["contacts"]), report["missed"], report["false_alarms"]) == (8, 0, 0)
    assert (len(beside["contacts"]), beside["missed"], beside["false_alarms"]) == (8, 0, 0)
    pairs = zip(report["contacts"], beside["contacts"], strict=True)
    assert all(ours["delay_ms"] < theirs["delay_ms"] for ours, theirs in pairs)


def test_link_direction_and_lever_arm_are_right(report: Any) -> None:
    contacts = report["contacts"]
    assert [contact["link_detected"] for contact in contacts] == [contact["link"] for contact in contacts]
    assert all(contact["direction_ok"] for contact in contacts)
    levers_m = [contact["lever_m"] for contact in contacts if contact["link"] == 2]
    assert levers_m == pytest.approx([0.2] * 4, abs=0.03)


def test_the_frozen_model_keeps_its_distance_from_every_threshold(report: Any) -> None:
    residuals = report["frozen_residual_max_Nm"]
    assert max(*residuals["B"]["identified"], *residuals["E"]["identified"]) <= 0.04
    assert report["certified"]["smallest_margin"] > 1.0


def test_the_readme_tells_the_figures_of_the_demo(report: Any) -> None:
    (told,) = re.findall(r"^> Demo, default seed: .*$", (ROOT / "README.md").read_text(), re.MULTILINE)
    certified_s, beside_s = report["adaptation_s"], report["certified"]["paper_beside"]["adaptation_s"]
    slowest_ms = max(contact["delay_ms"] for contact in report["contacts"])
    assert f"all {len(report['contacts'])} touches detected within {slowest_ms:.0f} ms; no false alarm" in told
    assert f"tested after {certified_s['A']:.2f} s, and again {certified_s['D']:.2f} s after 1 kg" in told
    assert f"took {beside_s['A']:.2f} s and {beside_s['D']:.2f} s" in told


def test_the_notebook_prints_what_is_stored_in_it(played: Played) -> None:
    path = ROOT / "docs" / "notebooks" / "a-run.ipynb"
    stored = json.loads(path.read_text())
    folder: Path = played.folder.parent.parent / "docs" / "notebooks"
    folder.mkdir(parents=True)
    run_notebook(now := copy.deepcopy(stored), folder, path.name)
    assert printed(now) == printed(stored)
    assert len(pictures(now)) == len(pictures(stored)) == 2
    assert (ROOT / "docs" / "figures" / "demo.png").read_bytes() == pictures(stored)[0]
