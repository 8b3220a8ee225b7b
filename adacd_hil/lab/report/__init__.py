"""The report of a run: read, judged, drawn, written as HTML, PNG, CSV and JSON."""
