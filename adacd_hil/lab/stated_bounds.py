"""Bounds and words that commands state in their help and the lab judges by; it imports nothing, so help is fast."""

from typing import Final

LEAST_RATE_PER_H: Final = 1e-6
MOST_RATE_PER_H: Final = 1e4
"""Of the false alarms per hour that thresholds can be asked for."""
SUFFICIENT_SHARE: Final = 0.90
GOOD_SHARE: Final = 0.95
"""Of a communication test's cycles with complete fresh data: less is not sufficient, or poor."""
STATUSES: Final = ("good", "not good", "not judged", "broken", "running")
"""Of runs."""
