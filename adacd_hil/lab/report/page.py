"""Pages from the Jinja2 templates in `templates`: words, forms and limits that all share; the only place that renders.

A page loads no other file and allows its own styles and scripts alone, by their digests: no
inline style, no request (content security policy). Every value is escaped; a template that marks one as safe gives
the reason. A value that a template needs and lacks is an error. Pages follow the reader's light or dark
scheme and print in the light one.

The size of a report is bounded, whatever the length of the run. The tables as CSV and JSON are complete.
"""

import hashlib
from base64 import b64encode
from collections.abc import Iterable, Sequence
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined

from adacd_hil.lab.score.metrics import Beside, Metrics, ReportedContact
from adacd_hil.lab.score.report_wording import number_text
from adacd_hil.lab.score.run_arrays import StretchOfRun
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.terminal import keep_units

if TYPE_CHECKING:
    from adacd_hil.lab.report.traces import Traces  # it imports the judge

TRACED_CONTACTS: Final = 60


SECTION_TITLES: Final = {
    "adaptation": "adaptation",
    "detection": "collision detection",
    "payload": "payload change",
    "fault": "fault",
}
SECTIONS: Final = 60
"""Sections with a row in the tables of sections and margins."""
CONTACTS: Final = 200
"""Contacts with a row in the table of contacts, and so many more that went wrong."""
NOTICES: Final = 12
"""Notices in words below the timeline."""
ADAPTATIONS: Final = 8
"""Adaptations with a figure, and with columns in the tables of parameters."""
MARKS: Final = 1_500
"""Stays and contacts on the timeline, each; beyond, those that are narrower than a mark are drawn as one."""


_PACKAGE: Final = "adacd_hil.lab.report"


STEPS: Final = 2
"""Next steps on the first screen, at most; the others are folded."""


class Cell(NamedTuple):
    """A cell of a table.

    kind: its class for the style sheet, such as "bad" or "strong"; "" for none.
    """

    content: object
    kind: str = ""


class Table(NamedTuple):
    """A table for the template. Its columns are aligned right, except those in `left`, numbered from 0.

    head: empty for a table without one.
    """

    head: Sequence[Cell]
    rows: Sequence[Sequence[Cell]]
    left: Sequence[int]


def make_table(head: Sequence[object], rows: Iterable[Sequence[object]], left: Sequence[int] = (0,)) -> Table:
    """Return a table; contents that aren't a `Cell` become cells without a class.

    left: numbers of the columns, from 0, that are aligned left.
    """

    def line(contents: Sequence[object]) -> list[Cell]:
        return [content if isinstance(content, Cell) else Cell(content) for content in contents]

    return Table(line(head), [line(row) for row in rows], left)


_STYLES: Final = ("uplot-1.6.32.min.css", "report.css")
_SCRIPTS: Final = ("uplot-1.6.32.iife.min.js", "traces.js")
"""uPlot is Leon Sorokin's, MIT licence, from npm; its licence lies beside it."""


def render_page(
    template: str,
    title: str,
    over: str,
    headline: str,
    is_good: bool,
    problems: Sequence[str] = (),
    findings: Sequence[str] = (),
    traces: "Traces | None" = None,
    **values: Any,
) -> str:
    """Return the HTML of a page whose template extends `page.html.j2`.

    traces: its curves; None: a page without script. over: a line over the headline; problems: of the log, and further
    findings, a line each. is_good: colour of the headline. values: for the template.
    """
    sheets, programs = ([_asset(name) for name in names] for names in (_STYLES, _SCRIPTS if traces else ()))
    heading = {"over": over, "title": headline, "is_good": is_good, "problems": problems, "further": findings}
    return render(template, title=title, heading=heading, traces=traces, styles=sheets, scripts=programs, **values)


def render(template: str, **values: Any) -> str:
    """Return the text of a template filled with values, with a newline at its end.

    Raises an error of Jinja2 if the template, or a value that it needs, is missing.
    """
    return _environment().get_template(template).render(values) + "\n"


@cache
def _environment() -> Environment:
    loader = PackageLoader(_PACKAGE)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    bounds = {
        "ADAPTATIONS": ADAPTATIONS,
        "CONTACTS": CONTACTS,
        "NOTICES": NOTICES,
        "SECTIONS": SECTIONS,
    }
    environment.globals["bounds"] = bounds
    environment.filters |= {"number": number_text, "keep_units": lambda text: keep_units(text, "\u00a0")}
    environment.policies["json.dumps_kwargs"] = {
        "ensure_ascii": False, "allow_nan": False, "separators": (",", ":"),
    }  # fmt: skip
    return environment


@cache
def _asset(name: str) -> dict[str, str]:
    """Return "text" and "digest" (SHA-256, base64) of a style sheet or script.

    The content security policy allows it by the digest.
    """
    text = f"\n{resources.files(_PACKAGE).joinpath('assets', name).read_text(encoding='utf-8').strip()}\n"
    return {"text": text, "digest": b64encode(hashlib.sha256(text.encode()).digest()).decode()}


def shown_contacts(metrics: Metrics) -> tuple[ReportedContact, ...]:
    """Return the contacts to be listed: the first CONTACTS, and of the later ones that went wrong as many at most."""
    later = [contact for contact in metrics.contacts[CONTACTS:] if went_wrong(contact)]
    return (*metrics.contacts[:CONTACTS], *later[:CONTACTS])


def went_wrong(contact: ReportedContact) -> bool:
    """Return whether a contact was missed by armed detection, or found on a wrong link or with a wrong direction."""
    is_missed = contact.is_armed and contact.detected_s is None
    return is_missed or contact.link_ok is False or contact.direction_ok is False


def left_out_text(metrics: Metrics) -> str:
    """Return a sentence on which of all contacts `shown_contacts` lists; "" if it lists all."""
    count, shown = len(metrics.contacts), len(shown_contacts(metrics))
    if shown == count:
        return ""
    wrong = f" and {shown - CONTACTS} more that went wrong" if shown > CONTACTS else ""
    return f"The first {CONTACTS}{wrong} of {count} contacts; all are in contacts.csv."


def has_paper(metrics: Metrics) -> bool:
    """Return whether the run played the paper's experiment. Then the paper's figures stand beside its own."""
    return any(row.paper is not None for row in metrics.paper)


def shown_beside(metrics: Metrics) -> Beside | None:
    """Return the result of the paper's scheme on the same stream for the page.

    None if the run didn't play the paper's experiment, was not certified, or had no paper's scheme beside. report.json
    has it even without the experiment.
    """
    return metrics.evidence.paper_beside if metrics.evidence is not None and has_paper(metrics) else None


def stretch_text(stretch: StretchOfRun) -> str:
    """Return a phrase on the time window of a log that was read; if it is wider than requested, the phrase says why."""
    found = TimeWindow(*(round(bound_s, 2) for bound_s in stretch.found))
    is_wider = stretch.found != stretch.asked
    return f"the log {found.text}{', widened so that no contact and no adaptation is cut' if is_wider else ''}"
