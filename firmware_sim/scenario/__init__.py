"""Scenarios: the events of a run, and the expected outcome with a host."""
