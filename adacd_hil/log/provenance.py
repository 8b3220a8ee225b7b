"""What numbers are computed with: two machines of which it is the same come to the same bits."""

import platform
from importlib.metadata import version


def arithmetic() -> dict[str, str]:
    """Describe this machine, for a log's metadata."""
    return {
        "machine": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "numba": version("numba"),
    }
