"""The scheme's states, their transitions, and the findings that trigger them."""
