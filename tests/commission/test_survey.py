"""The survey finds who is on the bus by SDO uploads and listening, and disturbs nobody."""

import dataclasses
from contextlib import nullcontext

import pytest
from rig import CODEC, Rig

from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.device.device_setup import Slave
from adacd_hil.lab.commission.survey import Survey, compare, function_name, message_name, survey


def look(rig: Rig, duration_s: float = 1.5) -> Survey:
    return survey(rig.bus, rig.clock, duration_s)


def verdicts(rig: Rig, found: Survey) -> dict[int, str]:
    return compare(found, rig.master.slaves)


def replace_profile(slave: Slave, **changes: object) -> None:
    profile = slave.device.profile
    settings = dataclasses.replace(profile.settings, **changes)
    slave.device = dataclasses.replace(slave.device, profile=profile._replace(settings=settings))


def test_every_node_is_found_with_its_identity_and_nothing_but_sdo_uploads_is_sent():
    rig = Rig(is_wall=True)
    found = look(rig)
    told = [(n.node_id, n.device_text, n.name, n.vendor, n.product, n.serial, n.error_register) for n in found.nodes]
    assert told == [
        (1, "CiA 402 drive", "adacd-hil torque drive", 0x41444143, 0x402, 1, 0),
        (2, "CiA 402 drive", "adacd-hil torque drive", 0x41444143, 0x402, 2, 0),
        (3, "CiA 404 measuring device", "adacd-hil joint torque sensor", 0x41444143, 0x404, 3, 0),
        (4, "CiA 404 measuring device", "adacd-hil joint torque sensor", 0x41444143, 0x404, 4, 0),
    ]
    assert verdicts(rig, found) == {1: "", 2: "", 3: "", 4: ""}
    assert {frame.can_id & 0x780 for frame in rig.sent} == {0x600}
    assert {frame.data[0] & 0xEF for frame in rig.sent} == {0x40, 0x60}  # initiate and segment, either toggle
    assert {frame.can_id & 0x7F for frame in rig.sent} == set(range(1, 128))


def test_an_operational_node_without_heartbeat_is_told_by_its_pdos():
    rig = Rig(is_wall=True)
    rig.start()
    rig.add_host()
    rig.tamper = lambda cycle, can_id, data: None if can_id & 0x780 == 0x700 else data
    rig.forget()
    assert {node.state_text for node in look(rig, 0.5).nodes} == {"operational (sends PDOs)"}


def test_who_is_found_is_compared_with_who_is_expected():
    rig = Rig(is_wall=True)
    found, slaves = look(rig), rig.master.slaves

    def compared(**changes: object) -> dict[int, str]:
        nodes = [dataclasses.replace(node, **changes) for node in found.nodes]
        return compare(dataclasses.replace(found, nodes=nodes), slaves)

    assert compared(product=0x403)[1] == "Drive1 expected; product code 0x403 is not the EDS's 0x402"
    assert compared(revision=0x20001)[1] == "Drive1 expected; revision 0x20001 is not of the EDS's 0x10001"
    assert compared(vendor=None)[1] == "Drive1 expected; tells no vendor"
    assert compared(device_type=0x20000 | 404)[1].endswith("device type 0x1000 = 0x00020194, 0x00020192 expected")
    assert compare(found, slaves[:1] + slaves[2:])[2] == "unexpected"
    for slave in slaves:
        replace_profile(slave, identity="any")
    assert set(compared(vendor=1, product=None, device_type=None).values()) == {""}  # not known, not compared


def test_a_device_of_the_other_joint_is_known_by_its_serial_number():
    rig = Rig(is_wall=True)
    for slave, serial, expected in zip(rig.master.slaves, (11, 12, 21, 22), ((12, 11),) * 2 + ((),) * 2, strict=True):
        rig.bench.devices[slave.node_id - 1].serve(0x1018, 4, lambda serial=serial: serial)
        replace_profile(slave, serial=expected)
    differing = {node: verdict for node, verdict in compare(look(rig), rig.master.slaves).items() if verdict}
    assert differing == {
        1: "Drive1 expected; serial number 0x1018:4 = 11, 12 expected",
        2: "Drive2 expected; serial number 0x1018:4 = 12, 11 expected",
    }


@pytest.mark.parametrize(("serial", "difference"), [((1, 2), ""), ((9, 2), "serial number 0x1018:4 = 1, 9 expected")])
def test_a_serial_number_that_the_eds_lacks_is_read_by_run_as_by_scan(monkeypatch, serial, difference):
    rig = Rig(is_wall=True)
    slave = rig.master.slaves[0]
    monkeypatch.delitem(slave._node.object_dictionary[0x1018].subindices, 4)
    replace_profile(slave, serial=serial)
    with pytest.raises(DeviceError, match=difference) if difference else nullcontext():
        assert rig.master.identify()[0].serial == 1
    assert verdicts(rig, look(rig))[1].endswith(difference)


def test_a_node_that_is_only_heard_is_found_and_does_not_answer():
    rig = Rig(is_wall=True)
    rig.bus.deliver(0x709, b"\x05")
    rig.bus.deliver(0x089, b"\x10\x83\x11\0\0\0\0\0")
    node = next(node for node in look(rig).nodes if node.node_id == 9)
    assert (node.answers, node.state_text, node.emergencies) == (False, "operational", [(0x8310, 0x11)])


def test_what_is_not_canopen_is_listed_by_identifier():
    rig = Rig(is_wall=True)
    rig.bus.deliver(0x055, b"\x01\x02\x03")
    rig.bus.deliver(0x055, b"\x01")
    (talk,) = look(rig).others
    assert (talk.can_id, talk.length, talk.count, message_name(CODEC, talk.can_id)) == (0x055, "1-3", 2, "unknown")


def test_an_abort_of_0x1000_still_shows_a_node():
    rig = Rig(is_wall=True)
    rig.bus.deliver(0x58A, bytes.fromhex("8000100000000206"))
    node = next(node for node in look(rig).nodes if node.node_id == 10)
    assert (node.device_type, node.device_text) == (None, "?")


@pytest.mark.parametrize("data", ["43001000", "43001000920000", ""])
def test_an_answer_that_is_too_short_is_none(data):
    rig = Rig(is_wall=True)
    rig.bus.deliver(0x58A, bytes.fromhex(data))
    assert [node.node_id for node in look(rig).nodes if node.answers] == [1, 2, 3, 4]


@pytest.mark.parametrize(
    ("can_id", "name"),
    [
        (0x000, "NMT"),
        (0x080, "SYNC"),
        (0x081, "EMCY"),
        (0x100, "TIME"),
        (0x181, "TPDO1"),
        (0x200, ""),
        (0x4FF, "TPDO4"),
        (0x581, "SDO response"),
        (0x67F, "SDO request"),
        (0x701, "heartbeat"),
        (0x7E5, ""),
        (0x18FF1234, ""),
    ],
)
def test_identifiers_are_named_as_in_the_predefined_connection_set(can_id, name):
    assert function_name(can_id) == name
