"""One cycle in, one decision out: numbers, supervisor, contact reports."""
