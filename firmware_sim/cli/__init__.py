"""The commands of `firmware-sim`."""
