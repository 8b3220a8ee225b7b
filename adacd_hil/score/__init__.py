"""The judge: contacts that a run found or missed, and its false alarms."""
