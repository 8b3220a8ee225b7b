"""Whether a contact was found, how late, and whether an alarm was false: the one judge."""
