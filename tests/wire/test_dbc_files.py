"""The attributes of the DBC files of CAN FD, as cantools sees them: bit rates, and when each message is sent."""

import cantools
import pytest

from adacd_hil.wire.contract_attributes import read_bitrates
from adacd_hil.wire.dbc_contract import contract_folder, load_codec, parse_codec

FD_FILES = pytest.mark.parametrize(
    ("name", "data_rate", "period_us"), [("arm_fd", 5_000_000, 1000), ("arm_fd_500us", 8_000_000, 500)]
)


@FD_FILES
def test_bit_rates_of_a_contract_are_those_it_states_else_its_defaults(
    name: str, data_rate: int, period_us: int
) -> None:
    codec = load_codec(contract_folder() / f"{name}.dbc")
    attributes = cantools.database.load_file(codec.path).dbc.attributes
    found = [attributes[key].value for key in ("Baudrate", "BaudrateCANFD", "BusPeriod_us")]
    assert found == [1_000_000, data_rate, period_us]
    assert read_bitrates(codec) == (1_000_000, data_rate)
    text = codec.text.decode()
    unsaid = text.replace(f'BA_ "BaudrateCANFD" {data_rate};', "").replace('BA_ "Baudrate" 1000000;', "")
    unsaid = unsaid.replace('BA_DEF_DEF_ "Baudrate" 1000000', 'BA_DEF_DEF_ "Baudrate" 500000')
    assert read_bitrates(parse_codec(unsaid.encode(), codec.path)) == (500_000, 0)


@FD_FILES
def test_every_message_of_the_fd_contracts_says_when_it_is_sent(name: str, data_rate: int, period_us: int) -> None:
    triggers: dict[str, set[str]] = {}
    for message in cantools.database.load_file(contract_folder() / f"{name}.dbc").messages:
        attributes = message.dbc.attributes
        trigger = attributes["Trigger"]
        triggers.setdefault(trigger.definition.choices[trigger.value], set()).add(message.name)
        interval = [attributes[key].value if key in attributes else 0 for key in ("GenMsgCycleTime", "GenMsgDelayTime")]
        if message.name.endswith("Heartbeat"):
            assert interval == [100, 100]
        elif message.name.endswith("Emcy"):
            assert interval == [0, 10]
        else:
            assert interval == [0, 0]
    nodes = ("Drive1", "Drive2", "Sensor1", "Sensor2")
    assert triggers == {
        "sync": {"Sync", "Drive1Feedback", "Drive2Feedback", "Sensor1Torque", "Sensor2Torque"},
        "command": {"Drive1Command", "Drive2Command"},
        "event": {f"{node}{what}" for node in nodes for what in ("Emcy", "Heartbeat")} | {"HostHeartbeat"},
        "request": {"Nmt"} | {f"{node}Sdo{what}" for node in nodes for what in ("Request", "Response")},
    }
