"""Bounds and words that commands state in their help and the lab judges by; it imports nothing, so help is fast."""

from typing import Final

LEAST_RATE_PER_H: Final = 1e-6
MOST_RATE_PER_H: Final = 1e4
"""Of the false alarms per hour that thresholds can be asked for."""
SUFFICIENT_SHARE: Final = 0.90
GOOD_SHARE: Final = 0.95
"""Of a communication test's cycles with complete fresh data: less is not sufficient, or poor."""
LISTEN_S: Final = 1.5
"""How long a scan listens by default: longer than the usual heartbeat and status periods of up to 1 s."""
PLAIN_S: Final = 1.0
"""Interval between tables of a bus without a terminal."""
THRESHOLD_SHARE: Final = 0.4
"""A threshold that differs by more has changed: eight demos that differed in their seeds only had thresholds up to 27 %
apart, 2026-11-25."""
MEANT_SHARE: Final = 0.25
"""Part of that share where settings have changed, too."""
STATUSES: Final = ("good", "not good", "not judged", "broken", "running")
"""Of runs."""
