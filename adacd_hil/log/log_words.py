"""What control process, writer and live view say to each other through their sockets; all else is JSON."""

WAKE = b"wake"
"""Take what waits in the ring."""
ROOM = b"room"
"""Take some of it and answer the same: there is more room."""
END = b"end"
"""Take it and end the log."""
NOTHING = b""
"""What is received once the other side is dead."""
WATCHED = b"watched"
ALONE = b"alone"
"""Whether somebody watches: from the process of the live view to the writer."""
MOST_BYTES = 65536
