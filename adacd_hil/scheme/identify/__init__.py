"""What is learnt of an arm, and what judges it."""
