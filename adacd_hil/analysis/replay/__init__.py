"""Logs once more through codec, arm and scheme, and what other settings would have made of them."""
