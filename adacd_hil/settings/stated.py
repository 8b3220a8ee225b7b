"""Names and bounds of settings that help texts state, too; it imports nothing, so help is fast."""

ARM_PROFILES = ("P", "S", "M")
"""Emulated arms that configurations have tables for; the first one is the default."""
BITRATES = (10_000, 1_000_000)
"""Slowest and fastest nominal rate of a bus, bit/s."""
