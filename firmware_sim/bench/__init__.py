"""Arm and nodes in one time, the faults that affect them, and the truth of the run."""
