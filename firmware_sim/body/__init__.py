"""The arm in motion: motors, encoders, torque transducers, and the contacts."""
