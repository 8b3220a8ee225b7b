"""The device side: drives, joint torque sensors, the rigid arm and the person who touches it, on the same bus."""
