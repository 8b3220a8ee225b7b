"""Online adaptation and collision detection for torque-sensed arms on CAN."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    __version__: str
else:

    def __getattr__(name: str) -> str:
        """Return `__version__`, looked up only when it is used: the lookup takes longer than all of `start.py`.

        "0+unknown" if the package isn't installed. Raises AttributeError for any other name.
        """
        if name != "__version__":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("adacd-hil")
        except PackageNotFoundError:  # imported from a source tree that was never installed
            return "0+unknown"
