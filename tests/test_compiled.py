"""The cache of compiled code is keyed by all that the code may depend on."""

from pathlib import Path

import pytest

from adacd_hil.compiled import compiled_sources

CALLER = "from adacd_hil.compiled import compiled\nfrom adacd_hil.scheme import (\n    callee,\n)\n"
CALLEE = "from adacd_hil.scheme.constants import GRAVITY\n"


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    folder = tmp_path / "adacd_hil" / "scheme"
    folder.mkdir(parents=True)
    for name, text in (("caller", CALLER), ("callee", CALLEE), ("constants", "GRAVITY = 9.81\n"), ("other", "A = 1\n")):
        (folder / f"{name}.py").write_text(text)
    return tmp_path


def test_what_compiled_code_imports_belongs_to_its_key_and_nothing_else_does(tree: Path) -> None:
    assert list(compiled_sources(tree)) == [f"adacd_hil.scheme.{name}" for name in ("callee", "caller", "constants")]


def test_the_key_has_the_text_of_the_package_itself() -> None:
    sources = compiled_sources(Path(__file__).resolve().parent.parent)
    assert b"def step(" in sources["adacd_hil.scheme.kernel"]
    assert b"class Layout" in sources["adacd_hil.records"]
    assert "adacd_hil.cli.main" not in sources
