"""The compiled computation of one cycle, for both schemes, and of many cycles at once."""
