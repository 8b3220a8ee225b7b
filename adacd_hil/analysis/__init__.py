"""What a log says: scores, reports, replays, sweeps, thresholds."""
