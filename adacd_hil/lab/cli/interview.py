"""Questions to the user that options answer, too: asked on a terminal; elsewhere an error names the option."""

from collections.abc import Callable
from typing import Any, TypeVar

import click

from adacd_hil.cli.output import CommandError, ExitCode, is_terminal, tell
from adacd_hil.printable import in_line
from adacd_hil.settings.schema import ConfigError

Answer = TypeVar("Answer")


class Interview:
    """Answers a question by its option, else by the user on a terminal, or the proposal with `--yes`; else it fails.

    is_asking: the user can be asked.
    """

    def __init__(self, takes_proposals: bool) -> None:
        self.takes_proposals = takes_proposals
        self.is_asking = not takes_proposals and is_terminal()

    def ask(
        self,
        option: str,
        given: Any,
        question: str,
        read: Callable[[Any], Answer],
        proposal: tuple[Any, str] = (None, ""),
        explanation: str = "",
    ) -> tuple[Answer, str]:
        """Return the answer to a question, and its source: "given" for option and user, else the proposal's.

        The answer is the option's, else the user's on a terminal, else the proposal if `--yes` allows it. given: the
        option's value, None without one. read: makes an answer of that value, of typed text, or of the proposal's; if
        it raises ConfigError for typed text, the question is repeated. proposal: value, None without one, and source,
        "" for a guess. explanation: printed on `?`. Raises ConfigError for a wrong option, CommandError without an
        answer.
        """
        if given is not None:
            return read(given), "given"
        value, source = proposal
        if self.is_asking:
            origin = "" if value is None else f"Enter takes {as_typed(value)}: {source or 'a guess'}"
            parts = (explanation, f"{option} answers it, too", origin, "Ctrl-C ends")
            return self._prompt(question, read, proposal, "; ".join(filter(None, parts)))
        if value is None:
            reason = "--yes has no proposal for it" if self.takes_proposals else "stdin is not a terminal"
            raise CommandError(f"{reason}: give {option} ({question})", ExitCode.USAGE)
        if not self.takes_proposals:
            raise CommandError(
                f"stdin is not a terminal: give {option} ({question}), or --yes for {as_typed(value)}",
                ExitCode.USAGE,
            )
        return read(value), source

    def _prompt(
        self, question: str, read: Callable[[Any], Answer], proposal: tuple[Any, str], help_text: str
    ) -> tuple[Answer, str]:
        """Ask on the terminal until an answer can be read; return it and its source, as of `ask`.

        help_text: printed on `?`.
        """
        value, source = proposal
        default = None if value is None else as_typed(value)
        while True:
            text = click.prompt(in_line(question), default=default, err=True, show_default=default != "")
            if text.strip() == "?":
                tell(help_text)
                continue
            try:
                if text == default:
                    return read(value), source
                return read(text), "given"
            except ConfigError as error:
                tell(str(error))

    def confirm(self, answer: bool | None, question: str) -> bool:
        """Return the option's answer, unless None; else ask yes or no on a terminal, Enter for no; False elsewhere.

        With `--yes` the user isn't asked: False, too.
        """
        if answer is not None:
            return answer
        return self.is_asking and click.confirm(in_line(question), default=False, err=True)


def as_typed(value: Any) -> str:
    """Return a value in the form in which the user types it: the values of a pair with a space between."""
    if isinstance(value, tuple | list):
        return " ".join(f"{one:g}" if isinstance(one, float) else str(one) for one in value)
    return str(value)
