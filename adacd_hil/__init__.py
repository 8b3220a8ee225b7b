"""Online adaptation and collision detection for torque-sensed arms on CAN."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("adacd-hil")
except PackageNotFoundError:  # imported from a source tree that was never installed
    __version__ = "0+unknown"
