"""The numbers of a run as plain values for other programs: the content of report.json.

It draws no figure, so that lists of runs read it quickly; the keys are described in `adacd_hil.lab.score.metrics`.
"""

from collections.abc import Mapping
from typing import Any, Final

from adacd_hil.lab.score.metrics import Metrics, ReportSource
from adacd_hil.lab.score.run_arrays import StretchOfRun
from adacd_hil.plain_values import plain_values
from adacd_hil.records import MOTION_START

JSON_NAME: Final = "report.json"
SCHEMA: Final = 3
"""Version of report.json; goes up when a key changes its meaning or disappears."""
_DIGITS: Final = 6


def report_json(
    metrics: Metrics, metadata: Mapping[str, str], source: ReportSource, stretch: StretchOfRun | None = None
) -> dict[str, Any]:
    """Return the content of report.json as plain values, rounded to `_DIGITS` significant digits.

    The keys are described in `adacd_hil.lab.score.metrics`. stretch: None: the whole log was read.
    """
    evidence = metrics.evidence
    fault = None if metrics.fault is None else {"reason": metrics.fault, "at_s": metrics.fault_s}
    plain: dict[str, Any] = plain_values(
        {
            "schema": SCHEMA,
            "verdict": metrics.verdict,
            "is_clean": metrics.is_clean,
            "time_zero": f"first cycle in {MOTION_START.name} (motion start)",
            "adaptation_s": metrics.adaptation_s,
            "sections": {
                section.label: {**vars(section), "duration_s": section.duration_s} for section in metrics.sections
            },
            "frozen_residual_max_Nm": metrics.frozen_residual_max_Nm,
            "contacts": metrics.contacts,
            "false_alarms": metrics.false_alarms,
            "false_alarms_s": metrics.false_alarms_s,
            "false_alarm_bound_per_h": metrics.false_alarm_bound_per_h,
            "missed": metrics.missed,
            "parameters": metrics.parameters,
            "payload_kg": metrics.payload_kg,
            "certified": evidence and {**vars(evidence), "smallest_margin": evidence.smallest_margin},
            "fault": fault,
            "cycle": metrics.cycle,
            "timing": metrics.timing.by_key(),
            "data": metrics.data,
            "log": {
                "name": source.log_name,
                "frames": metrics.frames,
                "dropped": metrics.dropped,
                "is_complete": source.is_complete,
                "problem": source.notice,
            },
            "stretch": None if stretch is None else _stretch_json(stretch),
            "paper": metrics.paper,
            "run": dict(sorted(metadata.items())),
        },
        _DIGITS,
    )
    return plain


def _stretch_json(stretch: StretchOfRun) -> dict[str, Any]:
    """Return the found and the requested stretch and motion start by keys of report.json, s since the log began."""
    return {
        "from_s": stretch.found.start_s,
        "until_s": stretch.found.end_s,
        "asked_from_s": stretch.asked.start_s,
        "asked_until_s": stretch.asked.end_s,
        "motion_start_s": stretch.motion_start_s,
    }
