"""The desired motion of each state."""
