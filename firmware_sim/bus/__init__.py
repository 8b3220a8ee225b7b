"""A modelled CAN bus, and two processes in lockstep."""
