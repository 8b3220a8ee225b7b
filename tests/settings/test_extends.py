"""Which file a configuration extends: a path is taken from the file that names it, wherever one stands."""

import pytest

from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.schema import ConfigError


def test_a_path_is_taken_from_the_file_that_names_it(tmp_path, monkeypatch):
    below = tmp_path / "below"
    below.mkdir()
    (below / "mine.toml").write_text('extends = "base.toml"\n')
    (below / "base.toml").write_text('extends = "../certified.toml"\n[bus]\nperiod_us = 1000\n')
    (tmp_path / "certified.toml").write_text('extends = "certified"\n[data]\nblind_cycles = 7\n')
    (tmp_path / "base.toml").write_text("[bus]\nperiod_us = 4000\n")
    monkeypatch.chdir(tmp_path)
    settings = load_settings("below/mine.toml")
    assert (settings.bus.period_us, settings.data.blind_cycles, settings.scheme) == (1000, 7, "certified")
    (below / "base.toml").unlink()
    with pytest.raises(ConfigError, match=r"below/base\.toml"):
        load_settings("below/mine.toml")


def test_a_file_that_extends_itself_by_another_path_is_refused(tmp_path):
    (tmp_path / "mine.toml").write_text('extends = "./mine.toml"\n')
    with pytest.raises(ConfigError, match=r"^configuration .*mine\.toml extends itself$"):
        load_settings(str(tmp_path / "mine.toml"))
