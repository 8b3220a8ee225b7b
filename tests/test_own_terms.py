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
