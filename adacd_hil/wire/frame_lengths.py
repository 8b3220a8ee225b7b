"""Data lengths of CAN frames, and their identifiers. Source: ISO 11898-1."""

CLASSIC_BYTES = 8
"""A frame with more data is CAN FD with bit rate switch; all others are classic, on an FD bus too."""
MAX_STANDARD_ID = 0x7FF
"""Larger identifiers are 29-bit ones."""
FD_LENGTHS = (12, 16, 20, 24, 32, 48, 64)
"""Data lengths of FD frames beyond those of classic ones. Source: ISO 11898-1, table of DLC."""
FRAME_LENGTHS = (*range(CLASSIC_BYTES + 1), *FD_LENGTHS)
"""Data lengths of CAN FD, by data length code."""
