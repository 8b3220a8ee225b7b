"""Thresholds for a wanted rate of false alarms, from recorded contact-free motion."""
