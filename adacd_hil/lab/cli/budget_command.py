"""The bit budget of a contract, as text and as JSON."""

from collections.abc import Sequence
from typing import Any

from adacd_hil.device.contract import find_contract, load_contract
from adacd_hil.device.device_files import place_devices
from adacd_hil.printable import in_line
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.table_layout import fit_table
from adacd_hil.terminal import fold, terminal_columns
from adacd_hil.wire.budget import Budget, FrameBudget, LoadCase, ResponseTime, compute_budget, format_us
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_attributes import read_attribute
from adacd_hil.wire.dbc_contract import load_codec

_COLUMNS = ("id", "message", "bytes", "trigger", "every ms", "bits", "µs", "response µs", "disturbed µs", "deadline µs")
_WIDTH = 120
_RIGHT_ALIGNED = [place for place, name in enumerate(_COLUMNS) if name not in ("message", "trigger")]
_LEGEND = (
    "bits at worst-case stuffing, intermission included; CAN FD: nominal + data rate",
    "response in operation; disturbed: with an SDO frame per cycle and every EMCY at once; > : no bound, at least this",
)


def judge(
    dbc: str | None,
    config: str,
    period_us: int | None,
    bitrate: int | None,
    data_bitrate: int | None,
    arms: int | None,
) -> tuple[Codec, Budget, list[str]]:
    """Compute whether the frames of a contract meet their deadlines; return its codec, the budget, and remarks.

    dbc: name or file; None: the contract of the configuration's devices, loaded or composed. period_us: None: the
    DBC's, else the configuration's. bitrate, data_bitrate: bit/s; None: the DBC's. arms: number of arms on the bus;
    None: the configuration's. A remark names a period or bit rate of the configuration that isn't used. Raises
    CodecError, ConfigError if contract or configuration can't be used.
    """
    settings = load_settings(config)
    codec = load_contract(settings, place_devices(settings)) if dbc is None else load_codec(find_contract(dbc))
    declared_us = int(read_attribute(codec.database, "BusPeriod_us"))
    budget = compute_budget(
        codec, period_us or declared_us or settings.bus.period_us, bitrate, data_bitrate, arms or settings.bus.arms
    )
    notes = list(budget.notes)
    for key, given, own, found in (
        ("bus.period_us", period_us, settings.bus.period_us, budget.period_us),
        ("devices.bitrate", bitrate, settings.devices.bitrate, budget.bitrate),
    ):
        if given is None and own != found:
            notes.append(f"configuration {settings.name} has {key} = {own}, the DBC {found}")
    return codec, budget, notes


def as_text(codec: Codec, budget: Budget, notes: Sequence[str]) -> str:
    """Return a budget as text for people, as wide as their terminal, else 120 letters. notes: remarks."""
    rates = f"{budget.bitrate} bit/s" + (f", data {budget.data_bitrate} bit/s" if budget.data_bitrate else "")
    findings = [
        (
            "per cycle",
            f"{budget.unstuffed_bits} bits without stuffing, {budget.worst_bits} at worst, "
            f"{format_us(budget.cyclic_ns)} µs",
        ),
        ("utilisation", f"{budget.cyclic_load:.1%} cyclic, {budget.load:.1%} with event frames"),
        (
            "phases",
            f"feedback in after {format_us(budget.feedback_ns)} µs, commands need {format_us(budget.command_ns)} µs, "
            f"left for the host {format_us(budget.host_ns)} µs",
        ),
        ("0x2000", f"wire version {codec.wire_version}, layout digest 0x{codec.layout_digest:08X}"),
        *(("note", note) for note in notes),
        ("verdict", budget.line),
    ]
    width = terminal_columns() or _WIDTH
    table = fit_table([_COLUMNS, *map(_row, budget.frames)], _RIGHT_ALIGNED, width)
    lines = [f"{budget.name}, {budget.period_us} µs, {rates}", "", *table, "", *_LEGEND, ""]
    lines += [f"{title:12}  {finding}" for title, finding in findings]
    return "\n".join(fold(in_line(line), width) for line in lines)


def _row(entry: FrameBudget) -> tuple[str, ...]:
    return (
        f"0x{entry.can_id:08X}" if entry.is_extended else f"0x{entry.can_id:03X}",
        entry.name,
        str(entry.length),
        entry.trigger.value,
        f"{entry.interval_ns / 1e6:g}",
        f"{entry.worst.nominal}+{entry.worst.data}" if entry.worst.data else str(entry.worst.nominal),
        format_us(entry.duration_ns),
        _response(entry.responses[LoadCase.OPERATION]),
        _response(entry.responses[LoadCase.EMERGENCIES]),
        "-" if entry.deadline_ns is None else format_us(entry.deadline_ns),
    )


def _response(response: ResponseTime) -> str:
    return ("" if response.is_bounded else "> ") + format_us(response.time_ns)


def as_json(codec: Codec, budget: Budget, notes: Sequence[str]) -> dict[str, Any]:
    """Return the budget of a contract's frames on its bus, with the remarks `notes`, as a dictionary for JSON."""
    return {
        "contract": budget.name,
        "wire_version": codec.wire_version,
        "layout_digest": f"0x{codec.layout_digest:08X}",
        "arms": budget.arms,
        "period_us": budget.period_us,
        "bitrate": budget.bitrate,
        "data_bitrate": budget.data_bitrate,
        "is_fit": budget.is_fit,
        "verdict": budget.line,
        "notes": notes,
        "unstuffed_bits": budget.unstuffed_bits,
        "worst_bits": budget.worst_bits,
        "cyclic_us": budget.cyclic_ns / 1000,
        "cyclic_load": budget.cyclic_load,
        "load": budget.load,
        "feedback_us": budget.feedback_ns / 1000,
        "command_us": budget.command_ns / 1000,
        "host_us": budget.host_ns / 1000,
        "messages": [_message(entry) for entry in budget.frames],
    }


def _message(entry: FrameBudget) -> dict[str, Any]:
    return {
        "name": entry.name,
        "id": entry.can_id,
        "is_extended": entry.is_extended,
        "bytes": entry.length,
        "trigger": entry.trigger.value,
        "interval_us": entry.interval_ns / 1000,
        "unstuffed_bits": entry.unstuffed.total,
        "worst_bits": entry.worst.total,
        "worst_data_rate_bits": entry.worst.data,
        "worst_us": entry.duration_ns / 1000,
        "deadline_us": None if entry.deadline_ns is None else entry.deadline_ns / 1000,
        "response_us": {
            traffic.value: {"time": response.time_ns / 1000, "is_bounded": response.is_bounded}
            for traffic, response in entry.responses.items()
        },
        "late_us": entry.late_ns() / 1000,
    }
