"""Replays of logs through codec, arm and scheme, with the logged or other settings."""
