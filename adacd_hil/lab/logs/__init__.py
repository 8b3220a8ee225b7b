"""Logs as files: check, cut, recover, export."""
