"""Recognition of devices that a survey has found: the profile of each, and the arm's ratings.

Sends SDO uploads only. Sources: CiA 301 (0x1000, 0x1018), CiA 402-2 (0x6072, 0x6076, 0x607D, 0x6080, 0x608F, 0x6091),
CiA 404 (0x6131, 0x6132).
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from adacd_hil.clock import Clock
from adacd_hil.device.canopen_bus import CanopenBus, DeviceError, read_object
from adacd_hil.device.contract import compose
from adacd_hil.device.device_files import load_profile, place_devices
from adacd_hil.lab.commission.profile_draft import (
    DRIVE,
    KINDS,
    SENSOR,
    DeviceRatings,
    identity_of,
    is_of,
    shipped_profiles,
)
from adacd_hil.lab.commission.survey import BETWEEN_READS_S, Node
from adacd_hil.records import JOINTS
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.bus import Bus, Tap
from adacd_hil.wire.codec import CodecError


class RecognisedDevice(NamedTuple):
    """A drive or a sensor on the bus. kind: "drive" or "sensor". ratings: values read from it.

    profiles: names of built-in ones of its vendor and product, shortest first; () for an unknown device.
    """

    node: Node
    kind: str
    profiles: tuple[str, ...]
    ratings: DeviceRatings

    @property
    def title(self) -> str:
        """Name, vendor, product and serial number as one line; "?" for a number that is unknown."""
        node = self.node
        identity = (("vendor", node.vendor), ("product", node.product))
        numbers = (f"{what} {'?' if value is None else f'0x{value:X}'}" for what, value in identity)
        return f"{node.name or 'a device without a name'}, {', '.join(numbers)}, serial {node.serial or '?'}"


def recognise(bus: Bus, clock: Clock, nodes: Sequence[Node], kinds: Mapping[int, str]) -> list[RecognisedDevice]:
    """Return the drives and sensors among a survey's nodes that answer, with ratings read from them.

    `kinds`: "drive" or "sensor" by node id, for nodes whose 0x1000 names neither. Reads `layout_digest` into a node if
    a profile of its vendor and product has 0x2000. Raises BusError if the bus fails.
    """
    canopen = CanopenBus(Tap(bus, clock))
    found = []
    for node in nodes:
        kind = KINDS.get((node.device_type or 0) & 0xFFFF) or kinds.get(node.node_id)
        if kind is not None and node.answers:
            remote = canopen.add_node(node.node_id, None, pause_s=BETWEEN_READS_S)
            profiles = fitting_profiles(node, kind)
            if any(load_profile(name, kind).settings.contract_object for name in profiles):
                node.layout_digest = _number(remote, 0x2000, 2)
            found.append(RecognisedDevice(node, kind, profiles, _read_ratings(remote, kind)))
    return found


def fitting_profiles(node: Node, kind: str) -> tuple[str, ...]:
    """Return the names of the built-in profiles whose EDS is of this node's vendor and product, shortest name first.

    An EDS without a product number fits all products of its vendor. () if there is none.
    """
    identities = ((name, identity_of(profile.eds)) for name, profile in shipped_profiles(kind))
    its = node.vendor, node.product
    return tuple(sorted((name for name, eds in identities if eds[0] is not None and is_of(eds, its)), key=len))


_SIGNED = ((0x607D, 1), (0x607D, 2))
_RATINGS = {
    DRIVE: (
        (0x6076, 0),
        (0x6072, 0),
        (0x608F, 1),
        (0x608F, 2),
        (0x6091, 1),
        (0x6091, 2),
        (0x6092, 1),
        (0x6092, 2),
        (0x60A8, 0),
        (0x60A9, 0),
        *_SIGNED,
        (0x6080, 0),
        (0x6502, 0),
    ),
    SENSOR: ((0x6131, 1), (0x6132, 1)),
}


def _number(remote: Any, index: int, sub: int = 0, is_signed: bool = False) -> int | None:
    """Read an object of a node as a number; None if it is missing, refused, not answered, empty or longer than 8 bytes.

    is_signed: it is in two's complement. Raises BusError if the bus fails.
    """
    try:
        data = read_object(remote, index, sub)
    except DeviceError:  # it refuses the upload, or answers with another type
        return None
    return None if not data or len(data) > 8 else int.from_bytes(data, "little", signed=is_signed)


def _read_ratings(remote: Any, kind: str) -> DeviceRatings:
    read = {place: _number(remote, *place, is_signed=place in _SIGNED) for place in _RATINGS[kind]}
    return DeviceRatings({place: value for place, value in read.items() if value is not None})


def choose_family(
    drives: Sequence[RecognisedDevice], sensors: Sequence[RecognisedDevice]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the profiles of two drives and of two sensors, by the layout digest that the devices report.

    Both drives get one profile, and both sensors: those that all of them may have, and whose contract has this digest.
    Devices without a digest don't count. If the devices report no digest, several, or that of no profiles: the first
    profile of each device; "" if it has none.
    """
    digests = {device.node.layout_digest for device in (*drives, *sensors)} - {None}
    combinations = itertools.product(drives[0].profiles or ("",), sensors[0].profiles or ("",))
    for drive, sensor in combinations if len(digests) == 1 else ():
        if not all(drive in device.profiles for device in drives):
            continue
        if not all(sensor in device.profiles for device in sensors):
            continue
        nodes = [tuple(device.node.node_id for device in group) for group in (drives, sensors)]
        if _digest_of(drive, sensor, nodes[0], nodes[1]) in digests:
            return (drive,) * JOINTS, (sensor,) * JOINTS
    first = [tuple((device.profiles or ("",))[0] for device in group) for group in (drives, sensors)]
    return first[0], first[1]


def _digest_of(drive: str, sensor: str, drive_nodes: tuple[int, ...], sensor_nodes: tuple[int, ...]) -> int | None:
    """Return the layout digest of the contract composed of one drive's and one sensor's profile, for both joints.

    None if the profiles can't be composed with these nodes.
    """
    settings = load_settings("certified")
    devices = dataclasses.replace(
        settings.devices,
        drive=(drive, drive),
        sensor=(sensor, sensor),
        drive_node=(drive_nodes[0], drive_nodes[1]),
        sensor_node=(sensor_nodes[0], sensor_nodes[1]),
        contract="",
        data_bitrate=8_000_000,
    )
    settings = dataclasses.replace(settings, devices=devices)
    try:
        return compose(settings, place_devices(settings)).layout_digest
    except (ConfigError, CodecError):
        return None
