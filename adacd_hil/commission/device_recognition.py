"""Devices that a survey has found: which profile describes each, and the arm's ratings.

Sends SDO uploads only. Sources: CiA 301 (0x1000, 0x1018), CiA 402-2 (0x6072, 0x6076, 0x607D, 0x6080, 0x608F, 0x6091),
CiA 404 (0x6131, 0x6132).
"""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

from adacd_hil.clock import Clock
from adacd_hil.commission.profile_draft import KINDS, SENSOR, DeviceRatings, identity_of
from adacd_hil.device.canopen_bus import CanopenBus, DeviceError, read_object
from adacd_hil.device.contract import compose
from adacd_hil.device.device_setup import NEWTON_METRE, PREFIX_SHIFT
from adacd_hil.device.profile import load_profile, place_devices, profile_names
from adacd_hil.device.survey import Node
from adacd_hil.records import JOINTS
from adacd_hil.settings.configuration import load_settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.bus import Bus, Tap
from adacd_hil.wire.codec import CodecError

_DEG_S_PER_RPM = 6.0


class RecognisedDevice(NamedTuple):
    """A drive or a sensor on the bus. profiles: built-in ones with its vendor and product; none: another's device."""

    node: Node
    kind: str
    profiles: tuple[str, ...]
    ratings: DeviceRatings

    @property
    def title(self) -> str:
        """Name, vendor, product and serial number."""
        node = self.node
        identity = (("vendor", node.vendor), ("product", node.product))
        numbers = (f"{what} {'?' if value is None else f'0x{value:X}'}" for what, value in identity)
        return f"{node.name or 'a device without a name'}, {', '.join(numbers)}, serial {node.serial or '?'}"


def recognise(bus: Bus, clock: Clock, nodes: Sequence[Node]) -> list[RecognisedDevice]:
    """Tell the drives and sensors among the nodes of a survey, and read their ratings. Raises BusError."""
    canopen = CanopenBus(Tap(bus, clock))
    found = []
    for node in nodes:
        kind = KINDS.get((node.device_type or 0) & 0xFFFF)
        if kind is not None and node.answers:
            remote = canopen.add_node(node.node_id, None)
            profiles = fitting_profiles(node, kind)
            if any(load_profile(name, kind).settings.contract_object for name in profiles):
                node.layout_digest = _number(remote, 0x2000, 2)
            found.append(RecognisedDevice(node, kind, profiles, _read_ratings(remote, kind)))
    return found


def fitting_profiles(node: Node, kind: str) -> tuple[str, ...]:
    """Name the built-in profiles whose EDS has this node's vendor and product."""
    names = []
    for name in profile_names():
        try:
            profile = load_profile(name, kind)
        except ConfigError:  # of the other kind
            continue
        if identity_of(profile.eds) == (node.vendor, node.product):
            names.append(name)
    return tuple(sorted(names, key=len))


def _number(remote: Any, index: int, sub: int = 0, is_signed: bool = False) -> int | None:
    try:
        data = read_object(remote, index, sub)
    except DeviceError:  # it refuses, or tells it otherwise than by a number
        return None
    return None if not data or len(data) > 8 else int.from_bytes(data, "little", signed=is_signed)


def _read_ratings(remote: Any, kind: str) -> DeviceRatings:
    number = functools.partial(_number, remote)
    if kind == SENSOR:
        unit, digits = number(0x6131, 1), number(0x6132, 1)
        if unit is None or digits is None or unit & 0x00FFFFFF != NEWTON_METRE:
            return DeviceRatings()
        prefix = unit >> PREFIX_SHIFT
        exponent = (prefix - 256 if prefix > 127 else prefix) - digits
        return DeviceRatings(torque_Nm=10.0**exponent if abs(exponent) < 12 else None)
    rated_mNm, permille = number(0x6076), number(0x6072)
    increments, motor_revs = number(0x608F, 1), number(0x608F, 2) or 1
    gear_in, gear_out = number(0x6091, 1) or 1, number(0x6091, 2) or 1
    per_rev = increments * gear_in // (motor_revs * gear_out) if increments else None
    low, high = number(0x607D, 1, is_signed=True), number(0x607D, 2, is_signed=True)
    limit = min(-low, high) if low is not None and high is not None else 0
    rpm = number(0x6080)
    return DeviceRatings(
        rated_torque_Nm=rated_mNm * 1e-3 if rated_mNm else None,
        torque_share=permille * 1e-3 if permille else None,
        increments_per_rev=per_rev,
        position_limit_deg=_whole_turn(limit, per_rev),
        velocity_limit_deg_s=rpm * _DEG_S_PER_RPM * gear_out / gear_in if rpm else None,
    )


def _whole_turn(limit: int, per_rev: int | None) -> float | None:
    """Return a limit in degrees; None where it is none, as of a drive that has the whole range of its counter."""
    if not per_rev or limit <= 0:
        return None
    degrees = 360.0 * limit / per_rev
    return degrees if degrees <= 360.0 else None


def choose_family(
    drives: Sequence[RecognisedDevice], sensors: Sequence[RecognisedDevice]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Choose the profiles of two drives and two sensors: those whose frames the devices say they have (0x2000).

    Where none says so, the first that fits each; "" where none does.
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
