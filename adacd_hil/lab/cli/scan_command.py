"""Scan: the nodes on a bus, their frames, and whether they are the arm of the configuration."""

from typing import Any

from adacd_hil.cli.connection import Connection
from adacd_hil.cli.output import ExitCode, format_table, tell
from adacd_hil.clock import MonotonicClock
from adacd_hil.device.network import Master
from adacd_hil.lab.commission.survey import Node, Survey, compare, message_name, survey
from adacd_hil.lab.commission.traffic import Talk
from adacd_hil.printable import in_line
from adacd_hil.wire.codec import Codec


def scan_bus(connection: Connection, listen_s: float) -> tuple[dict[str, Any], ExitCode]:
    """Find the nodes on a bus, and compare them with the configuration; return the result, and the exit status.

    The result is of `describe`. The status is OK if all expected nodes are there and right, further ones or not, else
    BUS_MISSING. listen_s: time to listen. Raises ConfigError, CodecError if configuration or contract can't be used,
    BusMissingError if the bus can't be opened, CommandError if it fails.
    """
    settings, codec, devices = connection.load()
    clock = MonotonicClock()
    with connection.bus(clock, codec.is_fd) as bus:
        slaves = Master(settings, codec, devices, bus).slaves
        reporting = {slave.node_id for slave in slaves if slave.device.settings.contract_object}
        found = survey(bus, clock, listen_s, tell, reporting)
    described = describe(found, compare(found, slaves, codec), codec)
    is_right = not any(row["verdict"] not in ("", "unexpected") for row in described["nodes"])
    return described, ExitCode.OK if is_right else ExitCode.BUS_MISSING


def describe(found: Survey, verdicts: dict[int, str], codec: Codec) -> dict[str, Any]:
    """Return a survey as a dictionary for JSON: nodes found or expected, and other identifiers.

    verdicts: by node id, of `compare`.
    """
    nodes = {node.node_id: node for node in found.nodes}
    return {
        "duration_s": round(found.duration_s, 3),
        "error_frames": found.error_frames,
        "contract": {
            "name": codec.path.name,
            "wire_version": codec.wire_version,
            "layout_digest": _hex(codec.layout_digest),
        },
        "nodes": [_describe_node(node_id, nodes.get(node_id), verdict, codec) for node_id, verdict in verdicts.items()],
        "others": [_describe_talk(talk, codec) for talk in found.others],
    }


def _describe_node(node_id: int, node: Node | None, verdict: str, codec: Codec) -> dict[str, Any]:
    row: dict[str, Any] = {"node": node_id, "is_present": node is not None, "verdict": verdict}
    if node is None:
        return row
    return row | {
        "device_type": node.device_type,
        "device": node.device_text,
        "name": node.name,
        "vendor": node.vendor,
        "product": node.product,
        "revision": node.revision,
        "serial": node.serial,
        "state": node.state_text,
        "error_register": node.error_register,
        "answers_sdo": node.answers,
        "wire_version": node.wire_version,
        "layout_digest": _hex(node.layout_digest),
        "emergencies": [{"code": code, "error_register": register} for code, register in node.emergencies],
        "produces": [_describe_talk(talk, codec) for talk in node.produces],
    }


def _hex(number: int | None) -> str | None:
    return None if number is None else f"0x{number:08X}"


def _describe_talk(talk: Talk, codec: Codec) -> dict[str, Any]:
    rate_Hz = talk.rate_Hz
    return {
        "id": talk.can_id,
        "message": message_name(codec, talk.can_id),
        "length": talk.length,
        "count": talk.count,
        "rate_Hz": None if rate_Hz is None else round(rate_Hz, 1),
    }


def as_text(described: dict[str, Any]) -> str:
    """Return the result of `describe` as tables for people."""
    nodes = described["nodes"]
    parts = []
    if nodes:
        head = ("node", "device", "name", "vendor", "product", "revision", "serial", "state", "error", "configuration")
        parts.append(format_table(head, [_node_row(node) for node in nodes], right=(0,)))
    else:
        parts.append("no CANopen node found")
    emergencies = [
        f"node {node['node']}: EMCY 0x{entry['code']:04X}, error register 0x{entry['error_register']:02X}"
        for node in nodes
        for entry in node.get("emergencies", ())
    ]
    if emergencies:
        parts.append("\n".join(emergencies))
    talks = [(str(node["node"]), talk) for node in nodes for talk in node.get("produces", ())]
    talks += [("", talk) for talk in described["others"]]
    if talks:
        rows = [_talk_row(owner, talk) for owner, talk in talks]
        parts.append(
            format_table(("node", "id", "message", "bytes", "frames", "Hz"), rows, right=(0, 3, 4, 5), names=2)
        )
    else:
        has_answers = any(node["is_present"] for node in nodes)
        what = "the nodes answered, and sent nothing by themselves" if has_answers else "nothing was heard"
        parts.append(f"{what} in {described['duration_s']:g} s")
    return "\n\n".join([*parts, f"{in_line(_contract(described))}\n{_summary(described)}"])


def _node_row(node: dict[str, Any]) -> tuple[str, ...]:
    verdict = node["verdict"] or "as expected"
    if not node["is_present"]:
        return (str(node["node"]), *["-"] * 8, verdict)
    register = node["error_register"]
    return (
        str(node["node"]),
        node["device"],
        node["name"] or "?",
        *("?" if node[what] is None else f"0x{node[what]:X}" for what in ("vendor", "product", "revision")),
        "?" if node["serial"] is None else str(node["serial"]),
        node["state"],
        "?" if register is None else f"0x{register:02X}",
        verdict,
    )


def _talk_row(owner: str, talk: dict[str, Any]) -> tuple[str, ...]:
    rate = "-" if talk["rate_Hz"] is None else f"{talk['rate_Hz']:.1f}"
    return owner, f"0x{talk['id']:03X}", talk["message"], talk["length"], str(talk["count"]), rate


def _contract(described: dict[str, Any]) -> str:
    """Return a line on the expected contract, and on nodes that report its layout digest or another one."""
    contract = described["contract"]
    reporting = [node for node in described["nodes"] if node.get("layout_digest") is not None]
    same = [node["node"] for node in reporting if node["layout_digest"] == contract["layout_digest"]]
    other = [f"node {node['node']}: {node['layout_digest']}" for node in reporting if node["node"] not in same]
    what = f"{contract['name']}: wire version {contract['wire_version']}, layout digest {contract['layout_digest']}"
    says = [f"same in node {', '.join(map(str, same))}"] * bool(same) + other
    return f"{what}; {'; '.join(says) or 'no node reports one'}"


def _summary(described: dict[str, Any]) -> str:
    nodes = described["nodes"]
    counts = {
        "as expected": sum(node["verdict"] == "" for node in nodes),
        "missing": sum(not node["is_present"] for node in nodes),
        "unexpected": sum(node["verdict"] == "unexpected" for node in nodes),
    }
    counts["different"] = len(nodes) - sum(counts.values())
    text = ", ".join(f"{count} {what}" for what, count in counts.items() if count or what == "as expected")
    errors = f"; {described['error_frames']} error frames" if described["error_frames"] else ""
    return f"nodes: {text}{errors}"
