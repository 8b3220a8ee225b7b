"""The analysis of logs: scores, reports, replays, sweeps, thresholds."""
