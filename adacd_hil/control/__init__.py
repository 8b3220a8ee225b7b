"""The cycle and what stands on both sides of the scheme in it."""
