"""The section *Traces* of a page: a panel per group of curves, their data, and what the script needs to draw them."""

from html import escape
from typing import Any, Final

import numpy as np

from adacd_hil.analysis.metrics import Metrics
from adacd_hil.analysis.report.long_run import CONTACTS
from adacd_hil.analysis.report.page import data_block, json_block, wrap_section
from adacd_hil.analysis.report.timeline import STATE_COLOURS, notices_of, state_key, stays_of
from adacd_hil.analysis.report.trace_encoding import Packed, pack, step_of
from adacd_hil.analysis.report.traces import Panel, panels_of
from adacd_hil.analysis.run import Run

STYLES: Final = ("uplot-1.6.32.min.css",)
SCRIPTS: Final = ("uplot-1.6.32.iife.min.js", "traces.js")
"""uPlot is Leon Sorokin's, MIT licence, from npm; its licence lies beside it."""

_TIME_STEP_S: Final = 1e-5


def traces_section(run: Run, metrics: Metrics) -> str:
    """Write the section; nothing of a run of less than two cycles."""
    panels = panels_of(run)
    if run.cycle.size < 2 or not panels:
        return ""
    is_next = None if run.all_cycles is None else np.diff(run.cycle, prepend=run.cycle[0] - 2) == 1
    time = pack(run.time_s(), _TIME_STEP_S)
    blocks = [data_block("trace-t", time.text)]
    drawn = []
    for panel in panels:
        curves = []
        for number, trace in enumerate(panel.traces):
            packed = pack(trace.values, step_of(trace.values, trace.finest, is_next))
            name = f"trace-{panel.name}-{number}"
            blocks.append(data_block(name, packed.text))
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
    figures = "\n".join(map(_figure, panels))
    return wrap_section(
        "Traces", _BAR, _key(run), figures, _note(run, panels, drawn), "".join(blocks), json_block("trace-plan", plan)
    )


def _numbers(name: str, packed: Packed) -> dict[str, Any]:
    return {"id": name, "low": packed.low, "step": packed.step, "order": packed.order, "planes": packed.planes}


_BAR: Final = """<noscript>
<p class="note">The traces need JavaScript; all other figures and tables don't.</p>
</noscript>
<div class="bar scripted" role="group" aria-label="What the traces show">
<button type="button" data-move="earlier" aria-label="earlier">◀</button>
<button type="button" data-move="later" aria-label="later">▶</button>
<button type="button" data-move="in" aria-label="closer">+</button>
<button type="button" data-move="out" aria-label="wider">−</button>
<button type="button" data-move="all">whole run</button>
<label><input type="checkbox" id="near"> residuals near their thresholds</label>
<output id="shown"></output>
<span class="note">wheel: closer, wider · drag: choose a stretch · shift + drag: move · double click: whole run</span>
</div>"""


def _key(run: Run) -> str:
    return f'<p class="note scripted">{state_key(run)} <i class="key touch"></i>touch</p>'


def _figure(panel: Panel) -> str:
    label = f"{panel.title}, {panel.unit}: {', '.join(trace.label for trace in panel.traces)}, over time in s"
    return (
        f'<figure class="trace scripted" id="panel-{panel.name}"><h3>{escape(panel.title)} '
        f"<small>{escape(panel.unit)}</small></h3>"
        f'<div class="plot" role="img" aria-label="{escape(label)}"></div></figure>'
    )


def _note(run: Run, panels: tuple[Panel, ...], drawn: list[dict[str, Any]]) -> str:
    """Say which cycles are there, and how finely the traces are written down."""
    steps = []
    for panel, plan in zip(panels, drawn, strict=True):
        coarsest = max(curve["step"] for curve in plan["curves"])
        steps.append(f"{panel.name} {coarsest:.2g} {panel.unit}".rstrip())
    cycles = "Every cycle is here."
    if run.all_cycles is not None:
        cycles = (
            f"Of {run.all_cycles} cycles {run.cycle.size} are here: of every {run.bucket} those in which a curve is "
            f"smallest or largest, and all around the first {CONTACTS} contacts; <b>report --from --until</b> shows "
            "every cycle of a stretch."
        )
    return (
        f'<p class="note scripted">{cycles} Where a pixel has more than one, the smallest and the largest '
        "value are drawn. Values are rounded to half the standard deviation of their noise, but no finer than anybody "
        f"reads: {escape(', '.join(steps))}. A threshold above every residual is not drawn.</p>"
    )
