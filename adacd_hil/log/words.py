"""What control process and writer say to each other through their socket; all else is JSON."""

WAKE = b"wake"
"""Take what waits in the ring."""
ROOM = b"room"
"""Take some of it and answer the same: there is more room."""
END = b"end"
"""Take it and end the log."""
NOTHING = b""
"""What is received once the other side is dead."""
MOST_BYTES = 65536
