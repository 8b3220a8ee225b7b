"""Questions to the user, each of which an option answers, too: on a terminal they are asked, elsewhere the option."""

import sys
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import click

from adacd_hil.cli.output import CommandError, ExitCode
from adacd_hil.settings.schema import ConfigError
from adacd_hil.terminal import in_line

Answer = TypeVar("Answer")


def is_terminal() -> bool:
    """Whether somebody can type."""
    return sys.stdin is not None and sys.stdin.isatty()


class Proposal(NamedTuple):
    """A value that is taken without a word. source: who says so; "" for a guess. value None: there is none."""

    value: Any
    source: str = ""


class Interview:
    """Asks what no option has answered; without a terminal it takes proposals where it may, and names the option."""

    def __init__(self, takes_proposals: bool) -> None:
        self.takes_proposals = takes_proposals
        self.is_asking = not takes_proposals and is_terminal()

    def say(self, line: str) -> None:
        """Tell something that is neither question nor result."""
        print(in_line(line), file=sys.stderr, flush=True)

    def ask(
        self,
        option: str,
        given: Any,
        question: str,
        read: Callable[[Any], Answer],
        proposal: Proposal = Proposal(None),  # noqa: B008 (immutable)
        explanation: str = "",
    ) -> tuple[Answer, str]:
        """Return an answer and its source: "given", the proposal's, or "" for a guess that nobody has changed.

        read: makes an answer of an option's value, of what was typed, or of a proposal; raises ConfigError for what is
        none, and the question is asked again. explanation: what `?` gets. Raises CommandError where nothing answers.
        """
        if given is not None:
            return read(given), "given"
        if self.is_asking:
            help_text = "; ".join(
                part for part in (explanation, f"{option} answers it, too", _origin(proposal), "Ctrl-C ends") if part
            )
            return self._prompt(question, read, proposal, help_text)
        if proposal.value is None:
            raise CommandError(f"nobody to ask, as stdin is no terminal: give {option} ({question})", ExitCode.USAGE)
        if not self.takes_proposals:
            raise CommandError(
                f"nobody to ask, as stdin is no terminal: give {option} ({question}), or --yes for {told(proposal)}",
                ExitCode.USAGE,
            )
        return read(proposal.value), proposal.source

    def _prompt(
        self, question: str, read: Callable[[Any], Answer], proposal: Proposal, help_text: str
    ) -> tuple[Answer, str]:
        while True:
            default = None if proposal.value is None else told(proposal)
            text = click.prompt(in_line(question), default=default, err=True, show_default=default != "")
            if text.strip() == "?":
                self.say(help_text)
                continue
            try:
                if text == default and proposal.value is not None:
                    return read(proposal.value), proposal.source
                return read(text), "given"
            except ConfigError as error:
                self.say(str(error))

    def confirm(self, answer: bool | None, question: str) -> bool:
        """Return what an option says, else ask; without a terminal the answer is no."""
        if answer is not None:
            return answer
        return self.is_asking and click.confirm(in_line(question), default=False, err=True)


def _origin(proposal: Proposal) -> str:
    if proposal.value is None:
        return ""
    return f"Enter takes {told(proposal)}: {proposal.source or 'a guess'}"


def told(proposal: Proposal) -> str:
    """Write a proposed value as it would be typed."""
    value = proposal.value
    if isinstance(value, tuple | list):
        return " ".join(f"{one:g}" if isinstance(one, float) else str(one) for one in value)
    return str(value)
