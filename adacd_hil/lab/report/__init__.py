"""The report of a run: read, judged, drawn, written as HTML, PDF, PNG, CSV and JSON."""
