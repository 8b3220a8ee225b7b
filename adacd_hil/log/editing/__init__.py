"""Logs made from logs: recovered, cut, merged; and the content of a log at a glance."""
