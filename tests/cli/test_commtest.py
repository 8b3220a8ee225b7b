"""What `commtest` prints, from a test against the emulator in virtual time."""

import json
import re

from rig import Rig

from adacd_hil.cli.connection import Connection
from adacd_hil.lab.cli.commtest_command import as_text, describe, open_log, write_page
from adacd_hil.lab.cli.log_command import find_dbc
from adacd_hil.lab.commission.communication_test import CommunicationTest, ZeroTorqueLoop
from adacd_hil.lab.score.report_wording import number_text
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.dbc_contract import contract_folder, load_codec


def played(rig: Rig, scheduler: str = "SCHED_FIFO 80") -> tuple[dict, CommunicationTest]:
    rig.start()
    rig.tap.take_passed()
    loop = ZeroTorqueLoop(rig.settings, rig.tap, rig.clock, rig.arm, rig.master)
    test = CommunicationTest(rig.settings, rig.arm, 1_000_000)
    loop.run(0.2, test.observe_cycle)
    described = describe(test, rig.settings, scheduler)
    return described | {"fault": "NONE", "device_faults": [], "events": []}, test


def test_the_report_shows_shares_ages_times_and_the_verdict():
    described, _ = played(Rig(is_wall=True))
    lines = as_text(described).splitlines()
    assert lines[0].startswith("cycles 200, complete 200, overruns 0, period 1000 µs, SCHED_FIFO 80, bus load ")
    assert lines[1] == "Drive1: fresh in 100.00 % of the periods; unprotected, 0 implausible"
    assert lines[3].startswith("Sensor1: fresh in 100.00 % of the periods; 220 OK")
    assert "Lateness, µs (wake-up after the grid point): p50 0, p99 0, p99.9 0, max 0" in lines
    assert lines[-1] == "good: 100.00 % of the periods brought complete fresh data (good from 95 %)"
    assert not any(line.startswith("warning") for line in lines)
    assert "Slack, µs (last command to the next grid point; negative: overrun): " in "\n".join(lines)
    assert "overruns 0, frames lost 0, frames missing 0, commands late 0, in 200 cycles" in lines
    # 657 bits without stuffing, 795 at worst, of 1000 per period; status frames and heartbeats every 100 ms
    assert 65.0 < described["load_percent"] < 81.0
    assert json.loads(json.dumps(described)) == described


def test_a_silent_device_and_a_missing_priority_are_warned_of():
    rig = Rig(is_wall=True)
    rig.tamper = lambda cycle, can_id, data: None if can_id == 0x184 else data
    described, _ = played(rig, "SCHED_OTHER")
    assert described["warnings"] == [
        "without real-time priority (SCHED_OTHER) the times are those of a busy desktop",
        "never a cyclic frame from Sensor2",
    ]
    sensor = described["devices"]["Sensor2"]
    assert (sensor["never"], sum(sensor["ages"])) == (200, 0)
    lines = as_text(described).splitlines()
    assert "overruns 0, frames lost 0, frames missing 200, commands late 0, in 200 cycles" in lines
    assert lines[4].startswith("Sensor2: fresh in 0.00 % of the periods; ")
    assert "SYNC → feedback, µs (SYNC sent to last frame decoded): no value" in lines
    assert lines[-1].startswith("not sufficient: 0.00 %")


def test_the_page_has_the_curves_of_the_report_with_the_numbers_of_the_test(tmp_path):
    described, report = played(Rig(is_wall=True))
    paths = write_page(tmp_path, report, described)
    assert [path.name for path in paths] == ["commtest.html"]
    page = paths[0].read_text(encoding="utf-8")
    slack = number_text(described["timing"]["times_us"]["slack"]["min"], 1)
    assert re.search(rf"<b>Slack</b>.*?<td[^>]*>{slack}</td></tr>", page)
    assert re.findall(r'id="panel-([^"]*)"', page)[:2] == ["time-lateness", "time-compute"]
    assert "<h1>good: 100.00\u00a0% of the periods" in page


def test_a_test_without_a_cycle_has_no_pictures(tmp_path):
    rig = Rig(is_wall=True)
    test = CommunicationTest(rig.settings, rig.arm, 1_000_000)
    assert write_page(tmp_path, test, {}) == []


def test_a_log_of_another_contract_is_decoded_by_that_contract(tmp_path):
    codec = load_codec(contract_folder() / "arm_fd.dbc")
    recorder = open_log(tmp_path, load_settings("fd", "P"), codec, Connection("", "", None, "fd", None, None), {})
    assert find_dbc(recorder.close().path, None)[0] == codec.text
