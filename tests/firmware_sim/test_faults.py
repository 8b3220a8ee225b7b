"""Faults in a scenario: which keys a kind has, what is refused and how, and which devices have a wrong node id."""

import tomllib

import pytest

from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_text import to_toml
from adacd_hil.wire.dbc_contract import load_codec
from firmware_sim.scenario.faults import KINDS, MOST_ROWS, FaultSettings, device_ids, own_messages
from firmware_sim.scenario.scenario import Scenario

AT = {"at_s": 1.0}
EXAMPLES = {
    "lose": {"node": "sensor1", "frame": "torque", "probability": 0.1, "duration_s": 2.0},
    "duplicate": {"node": "drive1", "frame": "feedback", "count": 3},
    "delay": {"node": "drive2", "frame": "command", "delay_us": 300.0, "jitter_us": 100.0},
    "reorder": {"node": "all", "frame": "torque", "count": 1},
    "corrupt": {"node": "sensor2", "frame": "torque", "mask": "0001"},
    "freeze_counter": {"node": "sensor1", "frame": "torque"},
    "stick": {"node": "drive1", "signal": "position"},
    "jump": {"node": "sensor1", "signal": "torque", "step": -2.0},
    "saturate": {"node": "sensor1", "signal": "torque"},
    "reboot": {"node": "drive1"},
    "emcy_storm": {"node": "sensor1", "code": 0x1000, "rate_Hz": 500.0},
    "babble": {"node": "drive1", "can_id": 0x7F, "rate_Hz": 2000.0, "data": "0102"},
    "bus_off": {"node": "drive2"},
    "wrong_node_id": {"node": "drive1", "node_id": 9},
    "duplicate_node_id": {"node": "drive2", "same_as": "drive1"},
    "late_sync": {"delay_us": 0.0, "jitter_us": 200.0},
    "clock_drift": {"node": "drive1", "drift_ppm": 100.0},
    "power_loss": {"duration_s": 0.5},
    "silence": {"node": "sensor2"},
    "drive_fault": {"node": "drive1", "code": 0x2310},
    "sensor_error": {"node": "sensor1", "status": 1},
    "object_value": {"node": "sensor1", "index": 0x2111, "raw": -2000},
}
UNTIMED = ("wrong_node_id", "duplicate_node_id")


def example(kind: str, /, **changes: object) -> dict[str, object]:
    """A row that can be, with changes; None takes a key away."""
    row = {"kind": kind, **({} if kind in UNTIMED else AT), **EXAMPLES[kind], **changes}
    return {key: value for key, value in row.items() if value is not None}


def scenario_of(*rows: dict[str, object]) -> Scenario:
    return parse(Scenario, {"faults": list(rows)})


def test_there_is_an_example_of_every_kind():
    assert sorted(EXAMPLES) == sorted(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_can_be_said_in_toml_and_read_back(kind):
    scenario = scenario_of(example(kind))
    table = to_toml(scenario)
    assert parse(Scenario, tomllib.loads(table)) == scenario


@pytest.mark.parametrize("kind", KINDS)
def test_every_key_that_a_kind_needs_is_missed(kind):
    for key in (*KINDS[kind].required, *(() if kind in UNTIMED else ("at_s",))):
        with pytest.raises(ConfigError, match=rf"faults\[1\]: .*lacks the key `{key}`"):
            scenario_of(example("power_loss"), example(kind, **{key: None}))


FOREIGN = {"node_id": 5, "code": 1, "step": 1.0, "frame": "status", "can_id": 1, "same_as": "drive1", "status": 1}


@pytest.mark.parametrize("kind", KINDS)
def test_every_key_that_a_kind_has_not_is_refused(kind):
    foreign = {key: value for key, value in FOREIGN.items() if key not in KINDS[kind].keys}
    assert len(foreign) >= 5
    for key, value in foreign.items():
        with pytest.raises(ConfigError, match=rf"faults\[0\]: kind '{kind}' has no key `{key}`"):
            scenario_of(example(kind, **{key: value}))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (example("lose", kind="loose"), "did you mean 'lose'?"),
        (example("lose", node=None), "faults[0]: frame 'torque' lacks the key `node`"),
        (
            example("lose", node="drive1"),
            "node = 'drive1' can't be with frame 'torque', which takes sensor1, sensor2, all",
        ),
        (example("lose", frame="command"), "node = 'sensor1' can't be with frame 'command', which takes drive1"),
        (example("lose", count=3), "`duration_s` and `count` can't both end it"),
        (example("delay", frame="sync", node=None), "frame = 'sync' can't be with kind 'delay'"),
        (example("reorder", frame="nmt"), "frame = 'nmt' can't be with kind 'reorder'"),
        (example("freeze_counter", frame="status"), "frame = 'status' can't be with kind 'freeze_counter'"),
        (example("corrupt", bits=2), "`bits` and `mask` can't both be flipped"),
        (example("corrupt", mask="0x1"), "mask = '0x1' is not a row of hex bytes"),
        (example("corrupt", mask=""), "mask has 0 bytes, 1 to 64 expected"),
        (example("babble", data="00" * 65), "data has 65 bytes, 1 to 64 expected"),
        (example("stick", node="sensor1"), "node = 'sensor1' can't be with signal 'position', which takes drive1"),
        (example("jump", node="drive1"), "node = 'drive1' can't be with signal 'torque', which takes sensor1"),
        (example("saturate", node="drive1", signal="velocity"), "saturate of velocity lacks the key `value`"),
        (example("drive_fault", node="sensor1"), "node = 'sensor1' can't be with kind 'drive_fault'"),
        (example("reboot", node="all"), "node = 'all' can't be with kind 'reboot'"),
        (example("wrong_node_id", at_s=1.0), "kind 'wrong_node_id' has no key `at_s`"),
        (example("reboot", count=2), "kind 'reboot' has no key `count`; its keys: at_s, since, node, duration_s"),
        (example("delay", node_id=2), "kind 'delay' has no key `node_id`; did you mean `node`?"),
        (example("duplicate_node_id", same_as="drive2"), "same_as = 'drive2' is the node itself"),
        (example("object_value", index=0x0FFF), "`faults[0].index` = 0xFFF is below 0x1000"),
        (example("babble", can_id=0x800), "`faults[0].can_id` = 0x800 is above 0x7FF"),
        (example("lose", duration_s=0.0), "`faults[0].duration_s` = 0"),
        (example("lose", probability=0.0), "probability = 0 has no effect"),
        (example("delay", delay_us=0.0, jitter_us=0.0), "delay_us = 0 has no effect"),
        (example("jump", step=0.0), "step = 0 has no effect"),
        (example("clock_drift", drift_ppm=0.0), "drift_ppm = 0 has no effect"),
        (example("corrupt", mask="0000"), "mask = '0000' has no effect"),
    ],
)
def test_a_fault_that_cannot_be_is_refused_in_one_line(row, message):
    with pytest.raises(ConfigError) as refusal:
        scenario_of(row)
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_node_has_one_wrong_id_only():
    rows = [example("wrong_node_id", node="drive2"), example("duplicate_node_id")]
    with pytest.raises(ConfigError, match=r"`faults\[1\]` gives drive2 another node id, as `faults\[0\]`"):
        scenario_of(*rows)


def test_there_are_no_more_faults_than_the_truth_has_bits_for():
    assert len(scenario_of(*[example("lose")] * MOST_ROWS).faults) == 53
    with pytest.raises(ConfigError, match="`faults` has 54 rows, 53 at most"):
        scenario_of(*[example("lose")] * 54)


@pytest.mark.parametrize(
    ("row", "ids"),
    [
        (example("lose"), (1, 2, 3, 4)),
        (example("wrong_node_id"), (9, 2, 3, 4)),
        (example("wrong_node_id", node="sensor2", node_id=1), (1, 2, 3, 1)),
        (example("duplicate_node_id"), (1, 1, 3, 4)),
        (example("duplicate_node_id", node="sensor1", same_as="drive2"), (1, 2, 2, 4)),
    ],
)
def test_devices_get_the_ids_that_the_rows_say(row, ids):
    assert device_ids(scenario_of(row).faults, (1, 2, 3, 4)) == ids


def test_a_device_with_a_wrong_id_keeps_its_own_messages_at_other_identifiers():
    codec = load_codec()
    messages = own_messages(codec.by_id, 1, 3)
    assert messages[0x203].name == "Drive1Command"
    assert messages[0x183].name == "Drive1Feedback"
    assert 0x201 not in messages
    assert messages[0x202].name == "Drive2Command"
    assert own_messages(codec.by_id, 1, 1) is codec.by_id


@pytest.mark.parametrize(
    ("row", "text"),
    [
        (example("lose"), "lose torque of sensor1, duration_s 2, probability 0.1"),
        (example("power_loss"), "power_loss of all, duration_s 0.5"),
        (example("emcy_storm"), "emcy_storm of sensor1, rate_Hz 500, code 0x1000"),
        (example("jump"), "jump torque of sensor1, step -2"),
    ],
)
def test_a_fault_says_in_one_line_what_happens_to_whom(row, text):
    assert parse(FaultSettings, row).text == text
