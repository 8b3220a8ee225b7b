"""The check of a log: the rules, and the findings that break them."""
