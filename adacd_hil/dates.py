"""Dates: wall-clock time as ISO 8601, in a tare, the history, names of folders."""

from datetime import UTC, datetime

_NS_PER_S = 1_000_000_000
_DATE = "%Y-%m-%dT%H:%M:%SZ"
NS_PER_H = 3600 * _NS_PER_S
MOST_AHEAD_H = 0.1
"""Most by which a date in a file may be ahead of this machine's clock."""


def format_date(t_ns: int) -> str:
    """Return wall-clock time, ns since 1970, as ISO 8601 in UTC, such as "2026-01-31T08:00:00Z", cut to seconds."""
    return datetime.fromtimestamp(t_ns // _NS_PER_S, tz=UTC).strftime(_DATE)


def date_ns(date_utc: str) -> int:
    """Return the ns since 1970 of a date as `format_date` returns it. Raises ValueError for another form."""
    return int(datetime.strptime(date_utc, _DATE).replace(tzinfo=UTC).timestamp()) * _NS_PER_S
