"""Frames and tables in the forms of other programs, in and out."""
