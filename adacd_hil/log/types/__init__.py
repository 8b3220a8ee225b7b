"""The content of a log: the types of its messages, its topics, its records as arrays."""
