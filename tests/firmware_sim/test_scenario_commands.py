"""`firmware-sim list`, `show` and `check`: what they print, and what is wrong with a file."""

import json
import tomllib

import pytest
from served_bench import run_main

from firmware_sim.scenario.scenario import builtin_scenarios, load_scenario


def test_list_has_a_line_for_each_scenario_and_json_says_what_happens_and_is_expected(capsys):
    assert run_main("list") == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.split() == ["name", "group", "about"]
    assert sorted(line.split()[0] for line in lines) == builtin_scenarios()
    assert run_main("list", "--json") == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    paper = load_scenario("paper")
    expected = {"group": paper.group, "about": paper.about, "lasts_s": 51.0, "expect": "2 adapted, 8 detected"}
    assert rows["paper"] == {"name": "paper", **expected}


def test_show_takes_profile_and_seed_and_leaves_out_what_is_as_by_default(capsys):
    assert run_main("show", "idle", "--profile", "M", "--seed", "77") == 0
    shown = tomllib.loads(capsys.readouterr().out)
    assert (shown["profile"], shown["seed"], shown["start_deg"]) == ("M", 77, [-30.0, -60.0])
    assert not {"payload_kg", "mechanics"} & set(shown)
    assert run_main("show", "idle", "--seed", "77", "--json") == 0
    assert json.loads(capsys.readouterr().out)["seed"] == 77


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
    assert run_main("check", str(second), "idle", "nowhere.toml", "--json") == 2
    found = [(row["file"], len(row["problems"])) for row in json.loads(capsys.readouterr().out)]
    assert found == [(str(second), 1), ("idle", 0), ("nowhere.toml", 1)]


def test_check_names_what_begins_after_the_run(capsys, tmp_path):
    path = tmp_path / "mine.toml"
    touch = "[[contacts]]\nat_s = {}\nlink = 1\npoint_m = 0.3\nangle_deg = 90.0\nforce_N = 20.0\nduration_s = 0.1\n"
    fault = "[[faults]]\nkind = 'lose'\nframe = 'torque'\nnode = 'sensor1'\nat_s = {}\n"
    rows = [touch.format(4.0), touch.format(9.0), fault.format(5.0), fault.format(7.0) + "since = 'power_on'\n"]
    path.write_text("lasts_s = 5.0\n" + "".join(rows))
    assert run_main("check", str(path)) == 0
    late = capsys.readouterr().out.partition("`demo` ends before ")[2].partition(":")[0]
    assert late == "`contacts[1]` at 9 s, `faults[0]` at 5 s"
    assert run_main("check", "paper") == 0
    assert "ends before" not in capsys.readouterr().out


def test_check_knows_the_contract(capsys, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[[faults]]\nkind = 'freeze_counter'\nframe = 'torque'\nnode = 'sensor1'\nat_s = 1.0\n")
    assert run_main("check", str(path), "--contract", "arm") == 0
    assert run_main("check", str(path), "--contract", "arm_stock") == 2
    assert "faults[0]: Sensor1Torque has no counter" in capsys.readouterr().out.splitlines()[-1]
    value = "[[faults]]\nkind = 'object_value'\nnode = 'drive1'\nindex = {}\nraw = {}\nat_s = 1.0\n"
    for index, raw, status in ((0x6077, 32767, 0), (0x6077, 32768, 2), (0x9999, 1, 2)):
        path.write_text(value.format(index, raw))
        assert run_main("check", str(path)) == status
        assert f"0x{index:X}" in capsys.readouterr().out or status == 0
