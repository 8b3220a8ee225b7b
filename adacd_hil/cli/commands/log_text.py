"""What the commands on logs print."""

from typing import Any

from adacd_hil.cli.table import format_table
from adacd_hil.log.check.log_check import LogCheck
from adacd_hil.log.editing.log_info import LogInfo
from adacd_hil.log.editing.recover import LogRecovery
from adacd_hil.terminal import in_line

_TOLD_FAULTS = 5


def info_as_json(info: LogInfo) -> dict[str, Any]:
    """Make a table of all that is known."""
    return {
        "path": str(info.path),
        "files": info.files,
        "size_bytes": info.size_bytes,
        "start_ns": info.start_ns,
        "duration_s": info.duration_s,
        "messages": info.messages,
        "cycles": info.cycles,
        "frames": info.frames,
        "dropped": info.dropped,
        "ending": info.ending,
        "contacts": info.contacts,
        "collisions": info.collisions,
        "faults": info.faults,
        "events": dict(info.events),
        "topics": [topic._asdict() for topic in info.topics],
        "attachments": info.attachments,
        "metadata": info.metadata,
        "summary": info.summary,
        "problems": info.problems,
    }


def info_as_text(info: LogInfo) -> str:
    """Tell what a log holds, the gist first."""
    ending = info.ending or "without an end"
    parts = f"{info.files} parts, " if info.files > 1 else ""
    lines = [
        f"{info.path}: {parts}{_size(info.size_bytes)}, {info.duration_s:.3f} s, {info.cycles} cycles, {ending}",
        f"{info.frames} frames, {info.messages} messages, {info.dropped} packets dropped",
        f"{info.contacts} contacts, {info.collisions} of them collisions; {len(info.faults)} errors, "
        f"{info.events['warning']} warnings",
    ]
    lines += [f"  error: {fault}" for fault in info.faults[:_TOLD_FAULTS]]
    if len(info.faults) > _TOLD_FAULTS:
        lines.append(f"  and {len(info.faults) - _TOLD_FAULTS} more")
    lines += [f"problem: {problem}" for problem in info.problems]
    lines = [in_line(line) for line in lines]
    rows = [
        (topic.topic, topic.type, str(topic.messages), f"{topic.rate_hz:.1f}", _bytes(topic.bytes))
        for topic in info.topics
        if topic.messages
    ]
    if rows:
        lines += ["", format_table(("topic", "type", "messages", "per s", "bytes"), rows, right=(2, 3, 4))]
    if info.attachments:
        names = ", ".join(f"{name} ({size})" for name, size in info.attachments.items())
        lines += ["", in_line(f"attached: {names}")]
    if info.metadata:
        lines += ["", format_table(("", ""), [(key, text) for key, text in info.metadata.items()])]
    return "\n".join(lines)


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"


def _bytes(count: int | None) -> str:
    return "–" if count is None else str(count)


def check_as_json(check: LogCheck) -> dict[str, Any]:
    """Make a table of what was found."""
    return {
        "path": str(check.path),
        "files": check.files,
        "messages": check.messages,
        "errors": check.errors,
        "warnings": check.warnings,
        "findings": [finding._asdict() for finding in check.findings],
    }


def check_as_text(check: LogCheck) -> str:
    """Tell what was found, and the sum of it."""
    lines = []
    for finding in check.findings:
        where = f"{finding.file}, byte {finding.offset}" if finding.offset >= 0 else finding.file
        lines.append(f"{finding.severity}: {where}: {finding.text} ({finding.rule})")
    left_out = check.errors + check.warnings - len(check.findings)
    if left_out:
        lines.append(f"and {left_out} more of these")
    verdict = "clean" if not check.errors + check.warnings else f"{check.errors} errors, {check.warnings} warnings"
    lines.append(f"{check.path}: {verdict}; {check.messages} messages in {check.files} files")
    return "\n".join(in_line(line) for line in lines)


def recovery_as_json(recovery: LogRecovery) -> dict[str, Any]:
    """Make a table of what was saved and lost."""
    losses = recovery.losses
    return {
        "path": str(recovery.path),
        "out": str(recovery.out),
        "messages": recovery.messages,
        "attachments": recovery.attachments,
        "metadata": recovery.metadata,
        "is_lossy": recovery.is_lossy,
        "lost": recovery.describe_loss(),
        "lost_messages": losses.messages,
        "lost_chunks": losses.chunks,
        "lost_bytes": losses.bytes,
        "is_cut": losses.is_cut,
        "holes_s": [hole.seconds for hole in losses.holes],
        "missing_parts": list(recovery.missing_parts),
        "notes": losses.notes,
    }


def recovery_as_text(recovery: LogRecovery) -> str:
    """Tell what was saved and lost."""
    saved = f"{recovery.messages} messages, {recovery.attachments} attachments"
    lost = recovery.describe_loss()
    lines = [f"{recovery.out}: {saved}", *(f"  {note}" for note in recovery.losses.notes)]
    lines.append(f"lost: {lost}" if lost else "nothing was lost")
    return "\n".join(in_line(line) for line in lines)
