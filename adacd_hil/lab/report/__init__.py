"""The report of a run: read, judged, written as HTML, CSV and JSON."""
