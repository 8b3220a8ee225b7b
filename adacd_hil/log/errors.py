"""What goes wrong with a log."""


class LogError(Exception):
    """A log that can't be written or read; the message is one line: file, reason."""


class LogExistsError(LogError):
    """A log that would have to take the place of another; the message is one line."""
