"""The check of logs: each file by itself, then what the parts of a log say of each other.

The rules are in `findings.RULES`: those of `mcap doctor` (foxglove/mcap), all CRCs, indexes against records, and our
own. A file is read once, from front to back, in constant memory but for 0.5 kB per chunk.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from adacd_hil.log.check.file_checks import FileFacts, check_file
from adacd_hil.log.check.findings import Finding, Findings, Severity
from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap_file import CONTINUED, ENDING_KEY, PART_KEY, RUN_METADATA, SUMMARY_METADATA
from adacd_hil.log.parts import find_parts, part_path
from adacd_hil.log.summary import DROPPED_KEY, LOST_KEY, PLANNED_ENDINGS


class Check(NamedTuple):
    """What was found in a log, with all its parts."""

    path: Path
    files: int
    messages: int
    findings: list[Finding]
    errors: int  # more than are in `findings` where a rule was broken often
    warnings: int


def find_logs(paths: Iterable[Path]) -> list[Path]:
    """List the logs that are meant: files as they are, of folders all .mcap in them but the later parts of a log.

    Raises LogError when a folder has none.
    """
    logs = []
    for path in paths:
        if not path.is_dir():
            logs.append(path)
            continue
        files = sorted(path.rglob("*.mcap"))
        later = {part for file in files for number, part in find_parts(file).items() if number}
        if not files:
            raise LogError(f"folder {path} has no .mcap file")
        logs += [file for file in files if file not in later]
    return logs


def check_log(path: Path, progress: Callable[[str], None] = lambda _: None) -> Check:
    """Check the log whose first part is `path`, with all its parts. Raises LogError when a file can't be read."""
    try:
        parts = find_parts(path) or {0: path}
    except OSError:
        parts = {0: path}
    checked = {}
    for number, part in parts.items():
        progress(f"checking {part.name}")
        checked[number] = check_file(part)
    whole = Findings(path.name)
    _check_parts(path, checked, whole)
    for facts in checked.values():
        _check_words(facts)
    all_findings = [whole, *(facts.findings for facts in checked.values())]
    return Check(
        path,
        len(parts),
        sum(facts.messages for facts in checked.values()),
        [finding for findings in all_findings for finding in findings.found],
        sum(findings.count(Severity.ERROR) for findings in all_findings),
        sum(findings.count(Severity.WARNING) for findings in all_findings),
    )


def _check_parts(path: Path, checked: dict[int, FileFacts], findings: Findings) -> None:
    """Judge the parts of a log together."""
    for before, number in pairwise((-1, *checked)):
        for missing in range(before + 1, number):
            findings.add("missing-part", f"{part_path(path, missing).name} is missing")
    last = max(checked)
    if _summary(checked[last]).get(ENDING_KEY) == CONTINUED:
        findings.add("missing-part", f"{part_path(path, last + 1).name} is missing: the part before says it follows")
    runs = {number: facts.metadata[RUN_METADATA] for number, facts in checked.items() if RUN_METADATA in facts.metadata}
    first = next(iter(runs.values()), {})
    for number, run in runs.items():
        name = part_path(path, number).name
        different = sorted(key for key, _ in {*_identity(run)} ^ {*_identity(first)})
        if different:
            text = f"{name} is of another run: {', '.join(dict.fromkeys(different))} differ"
            findings.add("foreign-part", text)
        said = run.get(PART_KEY, str(number))
        if said != str(number):
            findings.add("foreign-part", f"{name} is part {said} of a log")


def _identity(run: dict[str, str]) -> Iterator[tuple[str, str]]:
    return (pair for pair in run.items() if pair[0] != PART_KEY)


def _summary(facts: FileFacts) -> dict[str, str]:
    return facts.metadata.get(SUMMARY_METADATA, {})


def _check_words(facts: FileFacts) -> None:
    """Judge what one of our own files says of itself."""
    findings, summary = facts.findings, _summary(facts)
    if RUN_METADATA not in facts.metadata:
        return
    if not summary:
        if facts.is_ended:
            findings.add("ending", "the log doesn't say why it ended")
        return
    for key, real in (("messages", facts.messages), ("frames", facts.frames)):
        if summary.get(key, str(real)) != str(real):
            findings.add("counts", f"there are {real} {key}, the summary says {summary[key]}")
    dropped = summary.get(DROPPED_KEY, "0")
    if dropped != "0":
        findings.add("dropped", f"{dropped} packets were dropped on the way to the log")
    ending = summary.get(ENDING_KEY, "")
    if ending not in PLANNED_ENDINGS:
        findings.add("ending", f"the log ended because: {ending}" if ending else "the log doesn't say why it ended")
    if LOST_KEY in summary:
        findings.add("lost", f"lost before it was recovered: {summary[LOST_KEY]}")
