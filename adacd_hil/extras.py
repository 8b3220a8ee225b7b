"""Optional packages: how an extra of this package is installed where it runs from."""

import sys
from pathlib import Path

_ROOT = Path(__file__).resolve().parent.parent


def install_command(extra: str) -> str:
    """Write the command that installs an extra: into this interpreter's environment, from the source tree if it is one.

    This package is in no registry: without a source tree the command names the package, and its file has to be given.
    """
    is_source = (_ROOT / "pyproject.toml").is_file()
    source = "adacd-hil" if not is_source else "." if Path.cwd() == _ROOT else str(_ROOT)
    return f"{_pip()} install {'-e ' if is_source else ''}'{source}[{extra}]'"


def _pip() -> str:
    """Name pip of this interpreter, as short as it can be from here."""
    executable = Path(sys.executable)
    pip = executable.with_name("pip")
    try:
        name = str((pip if pip.exists() else executable).relative_to(Path.cwd()))
    except ValueError:
        name = str(pip if pip.exists() else executable)
    return name if pip.exists() else f"{name} -m pip"
