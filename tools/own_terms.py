"""Lists words that this project uses far more often than other software does: candidates for the glossary.

    python tools/own_terms.py                 # those that are neither in the glossary nor ordinary
    python tools/own_terms.py --all           # all of them, with their counts

A word is a part of an identifier, or a word of a docstring, comment, message, page or TOML file. Words with one stem
count together (`refuse`, `refused`). They are compared with the sources of installed packages (PACKAGES), text and
identifiers alike. A word is listed if it occurs at least 25 times, in at least 5 files, and 20 times as often per word
as in the packages. docs/glossary.md must have it as a term, or tools/ordinary_words.toml must list it with a reason.

Exit status: 0 every listed word is in one of the two, 1 some are not, 2 wrong usage or a missing package.
"""

import argparse
import functools
import importlib.util
import re
import sys
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import snowballstemmer

ROOT = Path(__file__).resolve().parents[1]
OURS = ("adacd_hil", "firmware_sim", "docs")
PACKAGES = (
    *("can", "canopen", "cantools", "click", "distributed", "docutils", "hypothesis", "jinja2", "matplotlib", "mcap"),
    *("numba", "numpy", "_pytest", "rosbags", "scipy", "sphinx", "websockets"),
)
LEAST_USES, LEAST_FILES, LEAST_RATIO = 25, 5, 20.0
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_TERM = re.compile(r"^(?:- \*\*(.+?)\*\*:|\| ([^|]+) \|)", re.MULTILINE)
_stemmer = snowballstemmer.stemmer("english")


class Term(NamedTuple):
    """A word that is more frequent here; ratio: of its frequencies, here over elsewhere."""

    word: str
    uses: int
    files: int
    ratio: float


@functools.cache
def stem(word: str) -> str:
    """Return the stem of a word: `refuse` and `refused` have the same one."""
    return str(_stemmer.stemWord(word.lower()))


def count_stems(*texts: str) -> Counter[str]:
    """Count the stems of all words of texts, identifiers split at underscores and capitals."""
    words: Counter[str] = Counter()
    for text in texts:
        words.update(_WORD.findall(text))
    stems: Counter[str] = Counter()
    for word, uses in words.items():
        stems[stem(word)] += uses
    return stems


def frequent_terms(ours: Iterable[str], theirs: Iterable[str]) -> list[Term]:
    """Return the words of our texts that are more frequent than in their texts, by the bounds above, best first."""
    uses: Counter[str] = Counter()
    files: Counter[str] = Counter()
    spellings: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for text in ours:
        stems = count_stems(text)
        uses.update(stems)
        files.update(stems.keys())
        for word, number in Counter(_WORD.findall(text)).items():
            spellings[stem(word)][word.lower()] += number
    elsewhere = count_stems(*theirs)
    here, there = uses.total(), max(elsewhere.total(), 1)
    found = []
    for key, number in uses.items():
        ratio = number / here * there / (elsewhere[key] + 1)
        if len(key) > 2 and number >= LEAST_USES and files[key] >= LEAST_FILES and ratio >= LEAST_RATIO:
            found.append(Term(spellings[key].most_common(1)[0][0], number, files[key], ratio))
    return sorted(found, key=lambda term: -term.ratio)


def our_texts() -> Iterator[str]:
    """Yield the texts of the product and its pages."""
    for top in OURS:
        for path in sorted((ROOT / top).rglob("*")):
            if path.suffix in (".py", ".md", ".toml"):
                yield path.read_text(encoding="utf-8")


def package_texts() -> Iterator[str]:
    """Yield the Python sources of PACKAGES. Raises ModuleNotFoundError."""
    for name in PACKAGES:
        spec = importlib.util.find_spec(name)
        if spec is None or not spec.submodule_search_locations:
            raise ModuleNotFoundError(f"{name} is not installed: make .venv/.dev")
        for folder in spec.submodule_search_locations:
            for path in sorted(Path(folder).rglob("*.py")):
                yield path.read_text(encoding="utf-8", errors="replace")


def glossary_stems(page: str) -> set[str]:
    """Return the stems of the words that the glossary explains: in bold, or in the first column of a table."""
    return {key for found in _TERM.findall(page) for key in count_stems(" ".join(found))}


def ordinary_words() -> dict[str, str]:
    """Return the words of tools/ordinary_words.toml, each with the reason why the glossary need not have it."""
    groups = tomllib.loads((ROOT / "tools" / "ordinary_words.toml").read_text(encoding="utf-8"))
    return {word: group["reason"] for group in groups.values() for word in group["words"].split()}


def unexplained(terms: list[Term]) -> list[Term]:
    """Return the terms that neither the glossary nor the list of ordinary words has."""
    known = glossary_stems((ROOT / "docs" / "glossary.md").read_text(encoding="utf-8"))
    known |= {stem(word) for word in ordinary_words()}
    return [term for term in terms if stem(term.word) not in known]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--all", action="store_true", help="list the words of the glossary and the ordinary ones, too")
    given = parser.parse_args(arguments)
    try:
        terms = frequent_terms(our_texts(), package_texts())
    except ModuleNotFoundError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    missing = unexplained(terms)
    for term in terms if given.all else missing:
        sys.stdout.write(f"{term.word:20} {term.uses:6} uses, {term.files:4} files, {term.ratio:8.0f} times as often\n")
    sys.stdout.write(f"{len(terms)} words are frequent here; {len(missing)} of them are explained nowhere\n")
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
