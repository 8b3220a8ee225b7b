"""The project's documents, in pieces: fenced blocks, inline code with the table row it stands in."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")))


@dataclass(frozen=True)
class Piece:
    """Something that a page shows. `language`: of a fenced block; `indented`: of one that is only indented."""

    page: Path
    line: int
    text: str
    language: str = ""
    head: str = ""  # inline code: the text of its table row's first cell

    @property
    def place(self) -> str:
        """Where it stands, as an editor opens it."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"


@dataclass(frozen=True)
class Document:
    """One page."""

    path: Path
    blocks: tuple[Piece, ...]
    spans: tuple[Piece, ...]


def read_document(path: Path) -> Document:
    """Take a page apart."""
    return parse_document(path, path.read_text(encoding="utf-8"))


def parse_document(path: Path, text: str) -> Document:
    """Take the text of a page, or a part of it, apart."""
    tokens = MarkdownIt("commonmark").enable("table").parse(text)
    blocks, spans = [], []
    for number, token in enumerate(tokens):
        line = (token.map or [0])[0] + 1
        if token.type in ("fence", "code_block"):
            language = token.info.strip() if token.type == "fence" else "indented"
            blocks.append(Piece(path, line, token.content, language))
        if token.type != "inline":
            continue
        head = _first_cell(tokens, number)
        spans += [Piece(path, line, child.content, head=head) for child in _flat(token) if child.type == "code_inline"]
    return Document(path, tuple(blocks), tuple(spans))


def _flat(token: Token) -> Iterator[Token]:
    for child in token.children or []:
        yield child
        yield from _flat(child)


def _first_cell(tokens: list[Token], number: int) -> str:
    """Return the source of the first cell of the table row that a token stands in; empty outside tables."""
    if tokens[number - 1].type not in ("td_open", "th_open"):
        return ""
    begin = next(index for index in range(number, -1, -1) if tokens[index].type == "tr_open")
    return tokens[begin + 2].content
