"""What happens in a run, and what a host is to make of it."""
