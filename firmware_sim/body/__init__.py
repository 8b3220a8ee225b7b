"""The arm in motion: motors, encoders, torque transducers, and who touches it."""
