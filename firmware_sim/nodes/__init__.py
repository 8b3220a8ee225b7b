"""Drives and torque sensors on the bus."""
