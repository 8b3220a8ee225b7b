"""Logs as files: check, cut, merge, recover, export."""
