"""Thresholds for a wanted rate of false alarms, from recorded motion that nobody touched."""
