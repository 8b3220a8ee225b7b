"""A file for each command of `adacd-hil`."""
