"""The log while it is written, for viewers: Foxglove WebSocket server, its client, the arm in 3-D."""
