"""The 1 kHz cycle: reading, requests, motion, controller, torque limits, commands; the session around it."""
