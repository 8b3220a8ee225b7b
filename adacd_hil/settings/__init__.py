"""Settings: the engine that reads, checks and writes them, and one file per group of sections."""
