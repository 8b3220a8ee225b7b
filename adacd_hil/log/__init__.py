"""Runs as MCAP files."""
