"""A command line as somebody types it, in this process."""

from click.testing import CliRunner, Result

from adacd_hil.cli.main import cli


def called(*words: object, typed: str = "") -> Result:
    """Call `adacd-hil`. typed: the answers to what it asks."""
    return CliRunner().invoke(cli, [str(word) for word in words], input=typed)


def complaints(result: Result) -> list[str]:
    """List the lines in which it complains."""
    return [line for line in result.stderr.splitlines() if line.startswith("adacd-hil:")]
