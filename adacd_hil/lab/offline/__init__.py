"""Recordings of arms that others made."""
