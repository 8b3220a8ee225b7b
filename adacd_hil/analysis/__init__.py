"""What a log says: figures, metrics, reports."""
