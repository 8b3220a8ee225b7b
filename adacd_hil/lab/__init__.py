"""The lab: everything about an arm that does not run on it. Nothing outside this package imports it."""
