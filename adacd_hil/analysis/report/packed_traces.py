"""The traces of a page: a panel per group of curves, their data, and what the script needs to draw them."""

from typing import Any, Final, NamedTuple

import numpy as np

from adacd_hil.analysis.logged_run import Run
from adacd_hil.analysis.metrics import Metrics
from adacd_hil.analysis.report.timeline import STATE_COLOURS, notices_of, stays_of
from adacd_hil.analysis.report.trace_encoding import Packed, pack, step_of
from adacd_hil.analysis.report.traces import Panel, panels_of

STYLES: Final = ("uplot-1.6.32.min.css",)
SCRIPTS: Final = ("uplot-1.6.32.iife.min.js", "traces.js")
"""uPlot is Leon Sorokin's, MIT licence, from npm; its licence lies beside it."""

_TIME_STEP_S: Final = 1e-5


class Traces(NamedTuple):
    """The data of the traces. blocks: the series as text, by name; plan: what the script draws of them."""

    panels: tuple[Panel, ...]
    blocks: dict[str, str]
    plan: dict[str, Any]


def traces_of(run: Run, metrics: Metrics) -> Traces | None:
    """Pack the series; None of a run of less than two cycles."""
    panels = panels_of(run)
    if run.cycle.size < 2 or not panels:
        return None
    is_next = None if run.all_cycles is None else np.diff(run.cycle, prepend=run.cycle[0] - 2) == 1
    time = pack(run.time_s(), _TIME_STEP_S)
    blocks = {"trace-t": time.text}
    drawn = []
    for panel in panels:
        curves = []
        for number, trace in enumerate(panel.traces):
            packed = pack(trace.values, step_of(trace.values, trace.finest, is_next))
            name = f"trace-{panel.name}-{number}"
            blocks[name] = packed.text
            curves.append(
                {
                    **_numbers(name, packed),
                    "label": trace.label,
                    "colour": trace.colour,
                    "isDashed": trace.is_dashed,
                    "isMirrored": trace.is_mirrored,
                }
            )
        drawn.append(
            {"name": panel.name, "unit": panel.unit, "near": panel.near, "levels": panel.levels, "curves": curves}
        )
    plan = {
        "count": int(run.cycle.size),
        "period": run.settings.bus.period_s,
        "time": _numbers("trace-t", time),
        "panels": drawn,
        "bands": [
            [round(stay.start_s, 4), round(stay.end_s, 4), STATE_COLOURS[stay.state]]
            for stay in stays_of(run)
            if stay.state in STATE_COLOURS
        ],
        "contacts": [
            [round(contact.at_s, 4), round(contact.end_s or contact.at_s, 4), contact.number]
            for contact in metrics.contacts
        ],
        "faults": [round(notice.at_s, 4) for notice in notices_of(run, metrics) if notice.is_bad],
    }
    return Traces(panels, blocks, plan)


def _numbers(name: str, packed: Packed) -> dict[str, Any]:
    return {"id": name, "low": packed.low, "step": packed.step, "order": packed.order, "planes": packed.planes}
