"""Whether a log is sound: the rules, and what breaks them."""
