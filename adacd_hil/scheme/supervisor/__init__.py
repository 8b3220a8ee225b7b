"""States, what leads from one to the next, and the bits that the numbers say."""
