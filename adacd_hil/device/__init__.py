"""CANopen devices on the bus, joined into one arm."""
