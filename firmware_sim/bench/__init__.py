"""Arm and nodes in one time, faults that befall them, and the truth about it."""
