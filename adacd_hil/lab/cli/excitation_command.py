"""The search for an excitation: the command's work and its table."""

from typing import Any

from adacd_hil.cli.output import CommandError, extendable, format_table
from adacd_hil.clock import MonotonicClock
from adacd_hil.lab.tune.excitation_search import NoExcitationError, Search
from adacd_hil.progress_lines import Progress
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.run_settings import ExcitationSettings
from adacd_hil.settings.toml_text import to_toml, toml_value

_LABELS = (
    ("excitation_Nm2s", "smallest eigenvalue, Nm² s", "{:.3g}"),
    ("condition", "condition number", "{:.3g}"),
    ("inertia_Nm2s", "of the inertia after a payload's fit, Nm² s", "{:.3g}"),
    ("travel_deg", "largest angle, deg", "{:.1f}"),
    ("velocity_deg_s", "peak speed, deg/s", "{:.1f}"),
    ("acceleration_deg_s2", "peak acceleration, deg/s²", "{:.0f}"),
    ("torque_Nm", "peak torque of the CAD model, Nm", "{:.2f}"),
)


def search(config: str, profile: str | None, seconds: float, seed: int) -> dict[str, Any]:
    """Search an excitation for a configuration; return the result by the keys of its JSON.

    `present`, None without one, and `found`: figures of the configuration's excitation and of the found one; `limits`:
    their bounds; `excitation`: the found one. seed: of the starting points of climbs. seconds: after which no further
    climb is begun. Raises ConfigError for a configuration that allows no search, CommandError if no motion keeps the
    limits.
    """
    task = Search(load_settings(config, profile))
    clock = MonotonicClock()
    end_ns = clock.now_ns() + round(1e9 * seconds)
    try:
        with Progress() as progress:
            found = task.run(seed, lambda _: clock.now_ns() < end_ns, progress)
    except NoExcitationError as error:
        raise CommandError(str(error)) from None
    present = task.figures(task.present) if task.present.period_s else None
    return {
        "present": present,
        "found": task.figures(found),
        "limits": task.limits(),
        "excitation": found,
    }


def as_toml(config: str, excitation: ExcitationSettings) -> str:
    """Return an excitation as the TOML text of a configuration that extends `config`, a name or file."""
    return f"extends = {toml_value(extendable(config))}\n\n[excitation]\n{to_toml(excitation)}"


def as_text(outcome: dict[str, Any]) -> str:
    """Return the result of `search` as a table, its figures per joint as joint 1 / joint 2."""
    rows = [
        (
            label,
            *(_cell(getattr(one, name, None), form) for one in (outcome["present"], outcome["found"])),
            _cell(outcome["limits"].get(name), form),
        )
        for name, label, form in _LABELS
    ]
    return format_table(("", "present", "found", "limit"), rows, (1, 2, 3))


def _cell(value: float | list[float] | None, form: str) -> str:
    if value is None:
        return "–"
    return " / ".join(form.format(one) for one in value) if isinstance(value, list) else form.format(value)
