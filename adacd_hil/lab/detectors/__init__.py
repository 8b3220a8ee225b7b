"""Detectors of an external torque beside the scheme's own: built in, and of a lab; compared on recordings."""
