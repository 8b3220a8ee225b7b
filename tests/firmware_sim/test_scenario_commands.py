"""`firmware-sim list`, `show` and `check`: what they print, and what is wrong with a file."""

import json

import pytest

from firmware_sim.cli.emulator_main import main
from firmware_sim.scenario.scenario import builtin_scenarios, load_scenario


def run_main(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    return int(ended.value.code)


def test_list_has_a_line_for_each_scenario(capsys):
    assert run_main("list") == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.split() == ["name", "group", "about"]
    assert sorted(line.split()[0] for line in lines) == builtin_scenarios()


def test_list_as_json_says_what_happens_and_what_is_expected(capsys):
    assert run_main("list", "--json") == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    paper = load_scenario("paper")
    assert rows["paper"] == {
        "name": "paper",
        "group": paper.group,
        "about": paper.about,
        "lasts_s": 51.0,
        "expect": "2 adapted, 8 detected",
    }


def test_show_leaves_out_what_is_as_by_default(capsys):
    assert run_main("show", "idle") == 0
    shown = capsys.readouterr().out
    assert "start_deg = [-30.0, -60.0]" in shown
    assert "payload_kg" not in shown
    assert "mechanics" not in shown


def test_show_takes_profile_and_seed(capsys):
    assert run_main("show", "idle", "--profile", "M", "--seed", "77", "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["profile"], shown["seed"]) == ("M", 77)


@pytest.mark.parametrize("option", [(), ("--all",)])
def test_what_show_prints_loads_to_the_same_scenario(capsys, tmp_path, option):
    assert run_main("show", "paper", *option) == 0
    path = tmp_path / "mine.toml"
    path.write_text(capsys.readouterr().out, encoding="utf-8")
    assert load_scenario(str(path)) == load_scenario("paper")
    assert run_main("check", str(path)) == 0


def test_check_has_a_line_for_each_problem_of_each_file(capsys, tmp_path):
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    first.write_text("seed = -1\npayload_kg = 21.0\nnoize = false\n[sensors]\ntorque_bits = [3, 16]\n")
    second.write_text("profile = 'X'\n")
    assert run_main("check", str(first), "idle", str(second)) == 2
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(": ")[0] for line in lines] == [str(first)] * 4 + ["idle", str(second)]
    assert [line.split("`")[1] for line in lines if "`" in line] == [
        "noize",
        "seed",
        "payload_kg",
        "sensors.torque_bits[0]",
        "profile",
    ]


def test_check_knows_the_contract(capsys, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[[faults]]\nkind = 'freeze_counter'\nframe = 'torque'\nnode = 'sensor1'\nat_s = 1.0\n")
    assert run_main("check", str(path), "--contract", "arm") == 0
    assert run_main("check", str(path), "--contract", "arm_stock") == 2
    assert "faults[0]: Sensor1Torque has no counter" in capsys.readouterr().out.splitlines()[-1]


def test_check_as_json_has_the_problems_of_each_file(capsys, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("seed = -1\n")
    assert run_main("check", str(path), "idle", "--json") == 2
    bad, good = json.loads(capsys.readouterr().out)
    assert (bad["file"], bad["problems"]) == (str(path), ["`seed` = -1 is below 0"])
    assert (good["file"], good["problems"]) == ("idle", [])


def test_a_missing_file_is_a_problem_of_its_own(capsys):
    assert run_main("check", "nowhere.toml") == 2
    assert capsys.readouterr().out == "nowhere.toml: does not exist\n"
