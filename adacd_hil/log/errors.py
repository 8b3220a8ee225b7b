"""What goes wrong with a log."""


class LogError(Exception):
    """A log that can't be written or read; the message is one line: file, reason."""
