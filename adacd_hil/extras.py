"""Commands that install the package's extras, for error messages."""

import sys
from pathlib import Path

_SOURCE_TREE = Path(__file__).resolve().parent.parent


def install_command(extra: str) -> str:
    """Return the pip command that installs this package with an extra into this interpreter's environment.

    It installs the source tree, editable, if this code runs from one. Otherwise it names the package, which is in no
    registry: the user gives its file.
    """
    is_source = (_SOURCE_TREE / "pyproject.toml").is_file()
    source = "adacd-hil" if not is_source else "." if Path.cwd() == _SOURCE_TREE else str(_SOURCE_TREE)
    return f"{pip_command()} install {'-e ' if is_source else ''}'{source}[{extra}]'"


def pip_command() -> str:
    """Return the command that runs this interpreter's pip: `pip` beside it, else `-m pip`.

    Its path is relative if it is below the working directory.
    """
    executable = Path(sys.executable)
    pip = executable.with_name("pip")
    try:
        name = str((pip if pip.exists() else executable).relative_to(Path.cwd()))
    except ValueError:
        name = str(pip if pip.exists() else executable)
    return name if pip.exists() else f"{name} -m pip"
