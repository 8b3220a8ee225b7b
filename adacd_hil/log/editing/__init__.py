"""Logs made from logs: recovered, cut, merged; and what a log holds."""
