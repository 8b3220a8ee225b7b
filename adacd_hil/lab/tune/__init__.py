"""Many replays or runs, and settings found from logs."""
