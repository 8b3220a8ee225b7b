"""The contract of one arm: the DBC that describes its frames, loaded, or composed from the devices' profiles.

A composed contract has the layout of a DBC written by hand for the same devices, bit for bit, and its layout digest.
Source: Vector DBC file format; CiA 301 clause 7.3.3 (predefined connection set).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from adacd_hil.device.canopen_bus import EdsVariable
from adacd_hil.device.profile import EMCY_INHIBIT_100US, ObjectName, PdoSettings, PlacedDevice
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import find_named
from adacd_hil.wire.codec import Codec, MessageCodec
from adacd_hil.wire.contract_frames import (
    EMERGENCY_ID,
    HEARTBEAT_ID,
    HOST_HEARTBEAT,
    NMT_ID,
    NODE_MASK,
    SDO_REQUEST_ID,
    SDO_RESPONSE_ID,
    SYNC_ID,
)
from adacd_hil.wire.dbc_contract import contract_folder, load_codec, parse_codec
from adacd_hil.wire.e2e import PROFILES_BY_CODE
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES, FD_LENGTHS
from adacd_hil.wire.moved_contract import move_contract

COMPOSED_NAME = "contract.dbc"
WIRE_VERSION = 1
_TRIGGERS = ("sync", "command", "event", "request")
_FRAME_FORMATS = ("StandardCAN", "ExtendedCAN", "reserved", "J1939PG", *("reserved",) * 10, "StandardCAN_FD")


class _DbcSignal(NamedTuple):
    """One signal of a composed DBC; value = raw x scale, in `unit`."""

    name: str
    bits: int
    is_signed: bool = False
    scale: float = 1.0
    unit: str = ""

    @property
    def limits(self) -> tuple[float, float]:
        """Least and greatest value, in `unit`."""
        low, high = (-(1 << self.bits - 1), (1 << self.bits - 1) - 1) if self.is_signed else (0, (1 << self.bits) - 1)
        return low * self.scale, high * self.scale


@dataclass
class _DbcMessage:
    """One message of a composed DBC; its signals follow each other without gaps.

    trigger: one of `_TRIGGERS`. period_ms, delay_ms: GenMsgCycleTime, GenMsgDelayTime. protection: end-to-end profile,
    "" for none. data_ids: hexadecimal. values: names of values, by signal.
    """

    can_id: int
    name: str
    sender: str
    receivers: tuple[str, ...]
    signals: tuple[_DbcSignal, ...]
    trigger: str
    period_ms: int = 0
    delay_ms: int = 0
    protection: str = ""
    data_ids: str = ""
    values: dict[str, dict[int, str]] = field(default_factory=dict)

    @property
    def length(self) -> int:
        return sum(signal.bits for signal in self.signals) // 8


_NMT_COMMANDS = {1: "start", 2: "stop", 128: "pre_operational", 129: "reset_node", 130: "reset_communication"}
_NMT_STATES = {0: "boot_up", 4: "stopped", 5: "operational", 127: "pre_operational"}
_MODES = {0: "none", 10: "cyclic_synchronous_torque"}
_EMCY = (
    _DbcSignal("error_code", 16),
    _DbcSignal("error_register", 8),
    _DbcSignal("manufacturer_code", 8),
    _DbcSignal("manufacturer_data", 32),
)
_SDO = (_DbcSignal("command", 8), _DbcSignal("index", 16), _DbcSignal("subindex", 8), _DbcSignal("data", 32))
_HEARTBEAT = (_DbcSignal("state", 8),)


def load_contract(settings: Settings, devices: Sequence[PlacedDevice]) -> Codec:
    """Return the codec of the configured devices: from the DBC that `devices.contract` names, or composed.

    The DBC's node ids are moved as a whole to the configured ones. Raises ConfigError for an unknown contract, and for
    a profile that can't be used or differs from the DBC; CodecError for a DBC that can't be read, used or moved.
    """
    composed = compose(settings, devices)
    name = settings.devices.contract
    if not name:
        return composed
    codec = _move(load_codec(find_contract(name)), settings, devices)
    _compare(codec, composed, name)
    return codec


def compose(settings: Settings, devices: Sequence[PlacedDevice]) -> Codec:
    """Return the codec of a contract that is composed from the profiles of these devices.

    Raises ConfigError for profiles that give no contract, such as two frames with one identifier; CodecError for a
    layout that the codec doesn't accept, such as a signal of 24 bits.
    """
    text = _write_dbc(settings, _messages(settings, devices))
    return parse_codec(text.encode(), Path(COMPOSED_NAME))


def find_contract(name: str) -> Path:
    """Return the file of the DBC that a name (`arm`) or a path stands for; a path with a suffix need not exist.

    Raises ConfigError for any other text, with the nearest name if there is one.
    """
    return find_named("contract", name, contract_folder(), ".dbc")


def _move(codec: Codec, settings: Settings, devices: Sequence[PlacedDevice]) -> Codec:
    """Return the contract with the host at its configured node id, and the devices if all move by the same number.

    Otherwise the devices keep the DBC's node ids. A DBC without the host's heartbeat is returned unchanged. Raises
    CodecError for a device's 29-bit identifier, or its node id outside 1 to 126 or equal to the host's, unless no id
    changes.
    """
    offsets = {
        device.node_id - (codec.messages[name].can_id & NODE_MASK)
        for device in devices
        if (name := f"{device.name}Heartbeat") in codec.messages
    }
    if HOST_HEARTBEAT not in codec.messages:
        return codec
    return move_contract(codec, offsets.pop() if len(offsets) == 1 else 0, settings.bus.host_node)


def _compare(codec: Codec, composed: Codec, name: str) -> None:
    """Raise ConfigError unless the DBC has the layout of the composed contract.

    The error names the first differing message, but none for data ids or places of signals. `name`: of the DBC in the
    error.
    """
    if codec.layout_digest == composed.layout_digest:
        return
    for message in composed.messages.values():
        theirs = codec.messages.get(message.name)
        if theirs is None:
            raise ConfigError(f"message {message.name} of the device profiles is missing in contract {name}")
        for what, ours, other in (
            ("identifier", f"0x{message.can_id:03X}", f"0x{theirs.can_id:03X}"),
            ("length", f"{message.length} bytes", f"{theirs.length} bytes"),
            ("signals", _signal_names(message), _signal_names(theirs)),
            ("scales", _scales(message), _scales(theirs)),
        ):
            if ours != other:
                raise ConfigError(f"{message.name}: {what} {ours} by the device profile, {other} by contract {name}")
    extra = [message for message in codec.messages if message not in composed.messages]
    if extra:
        raise ConfigError(f"message {extra[0]} of contract {name} is in no device profile")
    raise ConfigError(f"data ids or places of signals differ between the device profiles and contract {name}")


def _signal_names(message: MessageCodec) -> str:
    return ", ".join(signal.name for signal in message.signals)


def _scales(message: MessageCodec) -> str:
    return ", ".join(f"{signal.name} {signal.scale:.17g}" for signal in message.signals if signal.scale != 1.0)


def _messages(settings: Settings, devices: Sequence[PlacedDevice]) -> list[_DbcMessage]:
    """Return the messages of an arm, sorted by identifier: NMT, SYNC, heartbeats, EMCY, SDO and the profiles' PDOs.

    Raises ConfigError for a PDO that doesn't fit its EDS, bounds or frame, a `setup` that doesn't fit its EDS, and for
    two messages with one identifier.
    """
    names = tuple(device.name.upper() for device in devices)
    heartbeat_ms = settings.bus.heartbeat_ms
    nmt = (_DbcSignal("command", 8), _DbcSignal("node", 8))
    messages = [
        _DbcMessage(NMT_ID, "Nmt", "HOST", names, nmt, "request", values={"command": _NMT_COMMANDS}),
        _DbcMessage(SYNC_ID, "Sync", "HOST", names, (_DbcSignal("counter", 8),), "sync"),
        _heartbeat("Host", settings.bus.host_node, "HOST", names, heartbeat_ms),
    ]
    for device in devices:
        _check_setup(device)
        node, sender, host = device.node_id, device.name.upper(), ("HOST",)
        messages += [
            _DbcMessage(
                EMERGENCY_ID + node,
                f"{device.name}Emcy",
                sender,
                host,
                _EMCY,
                "event",
                delay_ms=EMCY_INHIBIT_100US // 10,
            ),
            *(_pdo_message(device, pdo) for pdo in device.settings.pdo),
            _DbcMessage(SDO_RESPONSE_ID + node, f"{device.name}SdoResponse", sender, host, _SDO, "request"),
            _DbcMessage(SDO_REQUEST_ID + node, f"{device.name}SdoRequest", "HOST", (sender,), _SDO, "request"),
            _heartbeat(device.name, node, sender, host, heartbeat_ms),
        ]
    messages.sort(key=lambda message: message.can_id)
    _check_identifiers(messages)
    return messages


def _heartbeat(name: str, node: int, sender: str, receivers: tuple[str, ...], period_ms: int) -> _DbcMessage:
    values = {"state": _NMT_STATES}
    return _DbcMessage(
        HEARTBEAT_ID + node,
        f"{name}Heartbeat",
        sender,
        receivers,
        _HEARTBEAT,
        "event",
        period_ms,
        period_ms,
        values=values,
    )


def _mapped(device: PlacedDevice, pdo: PdoSettings, name: ObjectName) -> EdsVariable:
    """Return an object of a PDO by its name.

    Raises ConfigError if it isn't in the EDS or no integer of the type of STANDARD_OBJECTS, if by the EDS no PDO may
    carry it, or if the device receives it but it is read-only.
    """
    variable = device.variable(name)
    refused = "fits no PDO: PDOMapping=0" if not variable.is_mappable else ""
    if pdo.is_received and not variable.is_writable:
        refused = "can't be written by a PDO: its AccessType is read-only"
    if refused:
        raise ConfigError(
            f"device profile {device.profile.name}: object {name} ({variable.name}) {refused} in "
            f"{device.profile.eds}; correct it there if the device maps it"
        )
    return variable


def _pdo_message(device: PlacedDevice, pdo: PdoSettings) -> _DbcMessage:
    """Return the message of a PDO: its signals are the end-to-end header, if it has data ids, then the mapped objects.

    A received PDO is a command of the host; others are sent on SYNC or on events. Raises ConfigError if the EDS lacks
    the PDO or an object, the header has the wrong number of bits, a bound is outside its value's range, or no CAN frame
    has the length.
    """
    profile, name = device.settings, device.name.upper()
    for place in (ObjectName(pdo.communication_index, 1), ObjectName(pdo.mapping_index)):
        if not device.has(place.index, place.sub):
            raise ConfigError(
                f"device profile {device.profile.name}: {place} of [[pdo]] {pdo.message} is not in "
                f"{device.profile.eds}: correct its `number`"
            )
    signals: list[_DbcSignal] = []
    if pdo.data_ids:
        signals = [_DbcSignal(signal, bits) for signal, bits in PROFILES_BY_CODE[profile.protection].signals]
        mapped = sum(_mapped(device, pdo, signal.name).bits for signal in device.header(pdo))
        if mapped != sum(signal.bits for signal in signals):
            raise ConfigError(f"device profile {device.profile.name}: header objects have {mapped} bits in all")
    for signal in pdo.signals:
        variable = _mapped(device, pdo, signal.name)
        scale, unit = profile.unit_of(signal)
        signals.append(_DbcSignal(signal.signal, variable.bits, variable.is_signed, scale, unit))
    _check_bounds(device, pdo, signals)
    sender, receiver = ("HOST", name) if pdo.is_received else (name, "HOST")
    message = _DbcMessage(
        device.can_id(pdo),
        f"{device.name}{pdo.message}",
        sender,
        (receiver,),
        tuple(signals),
        "command" if pdo.is_received else "sync" if pdo.is_synchronous else "event",
        0 if pdo.is_received or pdo.is_synchronous else pdo.event_timer_ms,
        -(-pdo.inhibit_100us // 10),
        profile.protection if pdo.data_ids else "",
        pdo.data_ids[device.joint] if pdo.data_ids else "",
        {"mode_display": _MODES} if any(signal.name == "mode_display" for signal in signals) else {},
    )
    if message.length > CLASSIC_BYTES and message.length not in FD_LENGTHS:
        raise ConfigError(
            f"device profile {device.profile.name}: {pdo.message} has {message.length} bytes; "
            f"a frame has 0 to 8, {', '.join(map(str, FD_LENGTHS))}: map fewer or other objects"
        )
    return message


def _check_bounds(device: PlacedDevice, pdo: PdoSettings, signals: list[_DbcSignal]) -> None:
    """Raise ConfigError for a bound outside the range of its value or difference: it would never act, or always."""
    found = {signal.name: signal for signal in signals}
    for signal in pdo.signals:
        low, high = found[signal.signal].limits
        if signal.of:
            other_low, other_high = found[signal.of].limits
            low, high = low - other_high, high - other_low
        for key, bound in ("low", signal.low), ("high", signal.high):
            if bound is not None and not low <= bound <= high:
                what = f"{signal.signal} - {signal.of}" if signal.of else signal.signal
                raise ConfigError(
                    f"device profile {device.profile.name}: {what}: {key} = {bound:g} is outside its range, "
                    f"{low:g} to {high:g}"
                )


def _check_setup(device: PlacedDevice) -> None:
    """Raise ConfigError for a `setup` of an object or value that by the EDS can't be written and read back."""
    for write in device.settings.setup:
        found = device.listed(write.name)
        refused = "" if found.is_writable and found.is_readable else "AccessType isn't rw"
        if not found.low <= write.value <= found.high:
            refused = f"takes {found.low} to {found.high}" if found.low <= found.high else "is no number"
        if refused:
            raise ConfigError(
                f"device profile {device.profile.name}: `setup` writes {write.value} to {write.name} ({found.name}): "
                f"{refused} in {device.profile.eds}; correct it there if the device takes it"
            )


def _check_identifiers(messages: list[_DbcMessage]) -> None:
    """Raise ConfigError for two messages with the same identifier."""
    owner: dict[int, str] = {}
    for message in messages:
        if message.can_id in owner:
            raise ConfigError(f"{owner[message.can_id]} and {message.name} both have identifier 0x{message.can_id:03X}")
        owner[message.can_id] = message.name


_HEAD = """VERSION "1"

NS_ :
\tCM_
\tBA_DEF_
\tBA_
\tVAL_
\tBA_DEF_DEF_

BS_:
"""
_ATTRIBUTES = f"""BA_DEF_ "WireVersion" INT 1 65535;
BA_DEF_ "Baudrate" INT 0 1000000;
BA_DEF_ "BaudrateCANFD" INT 0 16000000;
BA_DEF_ "BusPeriod_us" INT 0 1000000;
BA_DEF_ BO_ "VFrameFormat" ENUM {",".join(f'"{name}"' for name in _FRAME_FORMATS)};
BA_DEF_ BO_ "E2EProfile" STRING;
BA_DEF_ BO_ "E2EDataIdList" STRING;
BA_DEF_ BO_ "E2EDataId" INT 0 65535;
BA_DEF_ BO_ "Trigger" ENUM {",".join(f'"{name}"' for name in _TRIGGERS)};
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "GenMsgDelayTime" INT 0 65535;
BA_DEF_DEF_ "WireVersion" 1;
BA_DEF_DEF_ "Baudrate" 0;
BA_DEF_DEF_ "BaudrateCANFD" 0;
BA_DEF_DEF_ "BusPeriod_us" 0;
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_DEF_DEF_ "E2EProfile" "";
BA_DEF_DEF_ "E2EDataIdList" "";
BA_DEF_DEF_ "E2EDataId" 0;
BA_DEF_DEF_ "Trigger" "request";
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "GenMsgDelayTime" 0;
"""


def _write_dbc(settings: Settings, messages: list[_DbcMessage]) -> str:
    """Return the text of a DBC with these messages, and the bit rates and period of the settings.

    Raises ConfigError for frames of CAN FD without a data bit rate in the settings.
    """
    senders = sorted({message.sender for message in messages} - {"HOST"})
    is_fd = any(message.length > CLASSIC_BYTES for message in messages)
    if is_fd and not settings.devices.data_bitrate:
        raise ConfigError("`devices.data_bitrate` = 0 bit/s, but the device profiles have frames of CAN FD")
    data_bitrate = settings.devices.data_bitrate if is_fd else 0
    lines = [_HEAD, f"BU_: HOST {' '.join(senders)}", ""]
    for message in messages:
        lines.append(f"BO_ {message.can_id} {message.name}: {message.length} {message.sender}")
        lines.extend(_signal_lines(message))
        lines.append("")
    lines.append(_ATTRIBUTES.rstrip("\n"))
    lines.append(f'BA_ "WireVersion" {WIRE_VERSION};')
    lines.append(f'BA_ "Baudrate" {settings.devices.bitrate};')
    lines.append(f'BA_ "BaudrateCANFD" {data_bitrate};')
    lines.append(f'BA_ "BusPeriod_us" {settings.bus.period_us};')
    lines.extend(line for message in messages for line in _attribute_lines(message))
    lines.extend(line for message in messages for line in _value_lines(message))
    return "\n".join(lines) + "\n"


def _signal_lines(message: _DbcMessage) -> Iterable[str]:
    start = 0
    receivers = ",".join(message.receivers)
    for signal in message.signals:
        low, high = signal.limits
        sign = "-" if signal.is_signed else "+"
        bounds = f"[{_number(low)}|{_number(high)}]"
        place = f"{start}|{signal.bits}@1{sign} ({_number(signal.scale)},0)"
        yield f' SG_ {signal.name} : {place} {bounds} "{signal.unit}" {receivers}'
        start += signal.bits


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else repr(float(value))


def _attribute_lines(message: _DbcMessage) -> Iterable[str]:
    if message.length > CLASSIC_BYTES:
        yield f'BA_ "VFrameFormat" BO_ {message.can_id} {_FRAME_FORMATS.index("StandardCAN_FD")};'
    if message.protection:
        yield f'BA_ "E2EProfile" BO_ {message.can_id} "{message.protection}";'
        if PROFILES_BY_CODE[message.protection].is_id_list:
            yield f'BA_ "E2EDataIdList" BO_ {message.can_id} "{message.data_ids}";'
        else:
            yield f'BA_ "E2EDataId" BO_ {message.can_id} {int(message.data_ids, 16)};'
    yield f'BA_ "Trigger" BO_ {message.can_id} {_TRIGGERS.index(message.trigger)};'
    if message.period_ms:
        yield f'BA_ "GenMsgCycleTime" BO_ {message.can_id} {message.period_ms};'
    if message.delay_ms:
        yield f'BA_ "GenMsgDelayTime" BO_ {message.can_id} {message.delay_ms};'


def _value_lines(message: _DbcMessage) -> Iterable[str]:
    for signal, table in message.values.items():
        values = " ".join(f'{value} "{text}"' for value, text in table.items())
        yield f"VAL_ {message.can_id} {signal} {values} ;"
