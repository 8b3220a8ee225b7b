"""The recording of a run: the control side, the writer process, and the files that it writes."""
