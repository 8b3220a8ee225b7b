"""Counts turns of phrase that readers stumble over, in docstrings and comments of Python files, and in pages.

    python tools/prose.py adacd_hil firmware_sim
    python tools/prose.py --figures docs README.md CONTRIBUTING.md CHANGELOG.md
    python tools/prose.py --figures adacd_hil/wire ../another-checkout

Prints each place as `file:line: pattern: text` and then, per 1000 words of prose, how often each pattern occurs. Prose
is every string that stands alone as a statement (docstrings) and every comment; messages and other strings don't count.
Of a page (`.md`) it is everything but fenced blocks, code in backticks and the targets of links.

Patterns: a relative clause as the subject of a sentence ("What is through ..."), the word "what", hearsay ("is told"),
negations as nouns ("nobody", "is no").

Exit status: 0 counted, 2 a path doesn't exist, or is neither Python nor a page.
"""

import argparse
import ast
import io
import re
import signal
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

PATTERNS = {
    "relative clause as subject": re.compile(
        r"(?:(?<=^)|(?<=[.:;!?] ))(What|Who|Whoever|Whatever|Which|Where|Whose)\b(?![^.]*\?)"
    ),
    "what": re.compile(r"\bwhat\b", re.IGNORECASE),
    "hearsay": re.compile(r"\b(?:is|are|was|were|be) (?:said|told|asked|heard)\b|\bsays? (?:so|of|what|that)\b"),
    "is no, nobody, nothing, none": re.compile(r"\b(?:is no|are no|nobody|nothing|none)\b"),
}
_LONGEST = 110
_NO_PROSE = re.compile(r"^ *```.*?^ *```$|`[^`\n]+`|(?<=\])\([^)]*\)", re.MULTILINE | re.DOTALL)


def page_prose(page: str) -> str:
    """Return the text of a page, its lines as they are, each piece of code or link target replaced by one letter."""
    return _NO_PROSE.sub(lambda found: "x" + "\n" * found[0].count("\n"), page)


def prose(source: str, name: str = "") -> Iterator[tuple[int, str]]:
    """Yield line number and text of every docstring and comment of a source; name: for errors. Raises SyntaxError."""
    if name.endswith(".md"):
        yield 1, page_prose(source)
        return
    for node in ast.walk(ast.parse(source, name)):
        match node:
            case ast.Expr(value=ast.Constant(value=str(text))):
                yield node.lineno, text
    tokens = tokenize.generate_tokens(io.StringIO(source).readline) if "#" in source else ()
    for token in tokens:
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("# ")


def find_hits(text: str) -> Iterator[tuple[str, int, str]]:
    """Yield pattern's name, lines below the beginning of the text, and the words around, for each place in a text."""
    words = " ".join(text.split())
    line_of_word = [number for number, line in enumerate(text.split("\n")) for _ in line.split()]
    for name, pattern in PATTERNS.items():
        for found in pattern.finditer(words):
            line = line_of_word[words.count(" ", 0, found.start())]
            yield name, line, words[max(found.start() - _LONGEST // 3, 0) :][:_LONGEST]


def files_with_prose(paths: list[Path]) -> list[Path]:
    """Return the given files, all Python files and pages below the given folders, sorted. Raises FileNotFoundError."""
    found: set[Path] = set()
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such file or folder")
        found |= {*path.rglob("*.py"), *path.rglob("*.md")} if path.is_dir() else {path}
    return sorted(found)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument(
        "paths", nargs="+", type=Path, help="Python files, pages, or folders that are searched for them"
    )
    parser.add_argument("--figures", action="store_true", help="print the figures only, not the places")
    given = parser.parse_args(arguments)
    words = 0
    hits: Counter[str] = Counter()
    try:
        for path in files_with_prose(given.paths):
            for number, text in prose(path.read_text(), str(path)):
                words += len(text.split())
                for name, line, shown in find_hits(text):
                    hits[name] += 1
                    if not given.figures:
                        sys.stdout.write(f"{path}:{number + line}: {name}: {shown}\n")
    except (OSError, SyntaxError, UnicodeDecodeError) as error:
        where = f"{path}: " if isinstance(error, UnicodeDecodeError) else ""
        sys.stderr.write(f"{where}{error}\n")
        return 2
    sys.stdout.write(f"{words} words\n")
    for name in PATTERNS:
        sys.stdout.write(f"{name:30} {1000 * hits[name] / max(words, 1):6.2f} per 1000 words, {hits[name]} in all\n")
    return 0


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `| head` ends it quietly
    sys.exit(main())
