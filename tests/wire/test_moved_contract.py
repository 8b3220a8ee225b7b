"""A contract at other node ids, against cantools and against the contract that the host composes."""

import cantools
import pytest

from adacd_hil.wire.codec import Codec, CodecError
from adacd_hil.wire.dbc_contract import contract_folder, load_codec, parse_codec
from adacd_hil.wire.moved_contract import move_contract

CONTRACTS = ("arm", "arm_fd", "arm_fd_500us", "arm_stock")


def contract(name: str) -> Codec:
    return load_codec(contract_folder() / f"{name}.dbc")


def moved_by_cantools(name: str, node_offset: int, host_node: int) -> cantools.database.can.Database:
    """Move the messages in cantools' own model and write that as a DBC."""
    database = cantools.database.load_file(contract_folder() / f"{name}.dbc")
    for message in database.messages:
        if message.name == "HostHeartbeat":
            message.frame_id = 0x700 + host_node
        elif message.frame_id & 0x7F:
            message.frame_id += node_offset
    return cantools.database.load_string(database.as_dbc_string(), "dbc")


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTRACTS)
def test_a_moved_contract_is_the_one_that_cantools_moves_with_attributes_comments_and_values(name: str) -> None:
    reference, codec = moved_by_cantools(name, 4, 126), move_contract(contract(name), 4, 126)
    moved = cantools.database.load_string(codec.text.decode(), "dbc")
    assert {m.name: m.can_id for m in codec.messages.values()} == {m.name: m.frame_id for m in reference.messages}
    for theirs in reference.messages:
        message, ours = codec.message(theirs.name), moved.get_message_by_name(theirs.name)
        data = bytes(range(1, 1 + message.length))
        values = dict(zip((signal.name for signal in message.signals), message.decode(data), strict=True))
        assert values == pytest.approx(theirs.decode(data, decode_choices=False), rel=1e-12)
        attributes = [{key: value.value for key, value in m.dbc.attributes.items()} for m in (ours, theirs)]
        assert attributes[0] == attributes[1]
        assert [s.choices for s in ours.signals] == [s.choices for s in theirs.signals]
        assert ours.comment == theirs.comment


def test_a_contract_that_stays_is_the_file_itself() -> None:
    codec = contract("arm")
    assert move_contract(codec, 0, 127) is codec


@pytest.mark.parametrize(
    ("node_offset", "host_node", "line"),
    [
        (123, 127, r"arm.dbc: Sensor2Emcy: node id 127 is none of 1 to 126"),
        (-1, 127, r"arm.dbc: Drive1Emcy: node id 0 is none of 1 to 126"),
        (4, 6, r"arm.dbc: Drive2Emcy: node id 6 is the host's"),
    ],
)
def test_node_ids_that_cant_be_are_refused(node_offset: int, host_node: int, line: str) -> None:
    with pytest.raises(CodecError, match=line):
        move_contract(contract("arm"), node_offset, host_node)


def test_an_identifier_without_node_id_is_refused() -> None:
    codec = contract("arm")
    text = codec.text.decode().replace("385 ", f"{0x80000000 | 0x18100000} ")
    with pytest.raises(CodecError, match="Drive1Feedback: identifier 0x18100000 has no node id"):
        move_contract(parse_codec(text.encode(), codec.path), 4)
