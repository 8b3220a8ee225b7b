"""Many runs: the figures of each, a list, and trends from run to run."""
