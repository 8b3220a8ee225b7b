"""Identification from recordings of other arms: import, map, fit, verdict."""
