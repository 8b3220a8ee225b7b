"""The budget command: its verdict as exit status, its table, its JSON, its complaints."""

import json
from pathlib import Path

import pytest
from called import called
from click.testing import Result

CONTRACTS = Path(__file__).parent.parent / "wire" / "contracts"
FITS, DOES_NOT_FIT, USAGE = 0, 1, 2


def budget(*arguments: str) -> Result:
    return called("budget", *arguments)


@pytest.mark.parametrize(
    ("words", "status"),
    [
        (("--dbc", "arm"), FITS),
        (("--dbc", str(CONTRACTS / "naive_cia402.dbc")), DOES_NOT_FIT),
        (("--period-us", "900"), DOES_NOT_FIT),
        (("--dbc", str(CONTRACTS / "fd_500us.dbc")), FITS),
        (("--dbc", str(CONTRACTS / "fd_1ms.dbc"), "--data-bitrate", "1000000"), DOES_NOT_FIT),
    ],
)
def test_the_exit_status_is_the_verdict(words, status):
    ran = budget(*words, "--json")
    assert (ran.exit_code, json.loads(ran.stdout)["is_fit"]) == (status, status == FITS)


@pytest.mark.parametrize(("dbc", "period_us", "status"), [("arm", 1000, DOES_NOT_FIT), ("arm_fd", 2000, FITS)])
def test_two_arms_on_one_bus_have_one_sync(dbc, period_us, status):
    ran = budget("--dbc", dbc, "--arms", "2", "--period-us", str(period_us), "--json")
    found, one = json.loads(ran.stdout), json.loads(budget("--dbc", dbc, "--json").stdout)
    assert (ran.exit_code, found["arms"]) == (status, 2)
    assert found["worst_bits"] == 2 * one["worst_bits"] - 65
    assert len(found["messages"]) == 2 * len(one["messages"]) - 2  # NMT and SYNC are there once


def test_the_configuration_says_how_many_arms_share_the_bus(tmp_path):
    config = tmp_path / "two.toml"
    config.write_text("[bus]\narms = 2\nperiod_us = 2000\n")
    said = budget("--config", str(config), "--period-us", "2000").stdout
    assert said.splitlines()[-1] == (
        "verdict       2 × arm.dbc at 2000 µs fits: 1525 µs of cyclic frames, 475 µs left for the host"
    )


def test_the_text_has_table_phases_and_verdict_within_120_columns():
    lines = budget().stdout.splitlines()
    assert max(len(line) for line in lines) <= 120
    table = lines[2 : lines.index("", 2)]
    assert len(table) == 1 + 29
    assert table[0].split()[:4] == ["id", "message", "bytes", "trigger"]
    # numbers end where their heading ends
    (command,) = [line for line in table if "Drive2Command" in line]
    assert command.split() == ["0x202", "Drive2Command", "6", "command", "1", "115", "115", "920", "2830", "1000"]
    assert len(command) == len(table[0])
    assert "phases        feedback in after 565 µs, commands need 230 µs, left for the host 205 µs" in lines
    assert "0x2000        wire version 1, layout digest 0xF80FDAE0" in lines
    assert lines[-1] == "verdict       arm.dbc at 1000 µs fits: 795 µs of cyclic frames, 205 µs left for the host"


def test_json_has_every_message_with_its_response_times():
    found = json.loads(budget("--json").stdout)
    assert (found["wire_version"], found["layout_digest"]) == (1, "0xF80FDAE0")
    (command,) = [message for message in found["messages"] if message["name"] == "Drive1Command"]
    response_us = {"operation": 805.0, "requests": 815.0, "emergencies": 1920.0}
    assert command.pop("response_us") == {
        load: {"time": time, "is_bounded": True} for load, time in response_us.items()
    }
    assert command == {
        "name": "Drive1Command", "id": 0x201, "is_extended": False, "bytes": 6, "trigger": "command",
        "interval_us": 1000.0, "unstuffed_bits": 95, "worst_bits": 115, "worst_data_rate_bits": 0, "worst_us": 115.0,
        "deadline_us": 1000.0, "late_us": 0.0,
    }  # fmt: skip


def test_the_period_is_the_options_else_the_dbcs_else_the_configurations(tmp_path):
    config = tmp_path / "slow.toml"
    config.write_text("[bus]\nperiod_us = 2000\n[devices]\nbitrate = 500000\n")
    without = tmp_path / "without.dbc"
    arm = (CONTRACTS / "stock.dbc").read_text()
    without.write_text(arm.replace('BA_ "BusPeriod_us" 1000;', ""))

    def period(*arguments: str) -> int:
        found: int = json.loads(budget("--json", "--config", str(config), *arguments).stdout)["period_us"]
        return found

    assert period("--dbc", str(without), "--period-us", "4000") == 4000
    assert period("--dbc", str(CONTRACTS / "stock.dbc")) == 1000
    assert period("--dbc", str(without)) == 2000
    said = budget("--config", str(config)).stdout
    assert "configuration slow has bus.period_us = 2000, the DBC 1000" in said
    assert "configuration slow has devices.bitrate = 500000, the DBC 1000000" in said


STOCK = 'drive = ["stock-drive", "stock-drive"]\nsensor = ["int32-sensor", "int32-sensor"]\ncontract = ""'


@pytest.mark.parametrize(
    ("devices", "name", "bits"), [("", "arm", 795), ('contract = ""', "contract", 795), (STOCK, "contract", 715)]
)
def test_without_a_dbc_it_is_the_contract_of_the_configured_devices(tmp_path, devices, name, bits):
    config = tmp_path / "mine.toml"
    config.write_text(f"[devices]\n{devices}\n")
    found = json.loads(budget("--config", str(config), "--json").stdout)
    assert found["contract"].startswith(name)
    assert found["worst_bits"] == bits
