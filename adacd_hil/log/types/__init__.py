"""What a log holds: the types of its messages, its topics, its records as arrays."""
