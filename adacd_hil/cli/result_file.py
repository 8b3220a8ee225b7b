"""The file that a long search ends in: its place is tried before, and when it fails after nothing is lost."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from adacd_hil.cli.exit_codes import CommandError
from adacd_hil.output_files import Replacement, replace_file, tidied


@contextmanager
def tried(out: Path | None) -> Iterator[None]:
    """Before the block, make the folder of a result and a file in it that goes again; None: there is no file.

    A folder that was made and holds nothing afterwards goes, too. Raises CommandError.
    """
    if out is None:
        yield
        return
    with tidied(out.parent):
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            Replacement(out).discard()
        except FileExistsError as error:
            raise CommandError(f"{out} can't be written: {error.filename} is no folder") from error
        except OSError as error:
            raise CommandError(f"{out} can't be written: {error.strerror}") from error
        yield


def tell(said: str, out: Path | None, content: str, has_all: bool) -> None:
    """Write `content` to the file of a result, and print what is said of it.

    Where the file can't be written its content is printed, too, unless what is said has all of it. Raises CommandError.
    """
    failure = None
    if out is not None:
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            replace_file(out, content)
        except OSError as error:
            failure = error
    print(said)
    if failure is None:
        return
    if not has_all:
        print(f"\n{content}", end="")
    raise CommandError(f"{out} can't be written: {failure.strerror}; what was found is printed above") from failure
