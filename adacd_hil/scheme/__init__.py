"""The adaptation-and-collision-detection scheme, pure: no clock, no I/O."""
