"""Words that this project uses far more often than other software are in the glossary, or are plain words."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
import own_terms


@pytest.mark.slow
def test_a_frequent_word_is_in_the_glossary_or_is_an_ordinary_one() -> None:
    terms = own_terms.frequent_terms(own_terms.our_texts(), own_terms.package_texts())
    assert len(terms) > 150  # the comparison finds words at all
    assert [term.word for term in own_terms.unexplained(terms)] == []


def test_a_word_counts_with_its_stem_in_names_and_prose() -> None:
    ours = ["class TareFile: ...\ndef write_tare(): ...  # taring"] * 9
    (found,) = own_terms.frequent_terms(ours, ["class File: ...\ndef write_file(): ..."] * 100)
    assert (found.word, found.uses, found.files) == ("tare", 27, 9)


def test_a_word_that_others_use_as_often_is_not_found() -> None:
    assert own_terms.frequent_terms(["write the tare"] * 30, ["write the tare"] * 9) == []


def test_the_glossary_explains_the_words_in_bold() -> None:
    page = "- **earlier belief, sight**: the knowledge of a **run**\n"
    assert own_terms.glossary_stems(page) == {own_terms.stem(word) for word in ("earlier", "belief", "sight")}
