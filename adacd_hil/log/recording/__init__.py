"""How a run is recorded: the control side, the writer process, and the files that it writes."""
