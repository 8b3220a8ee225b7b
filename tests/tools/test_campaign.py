"""tools/campaigns/campaign.py: what is chosen, and what a run that deviates or can't be played comes to."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

CAMPAIGN = Path(__file__).parents[2] / "tools" / "campaigns" / "campaign.py"
SHORT = """
about = "Too short to adapt."
group = "short"
lasts_s = 0.3
start_deg = [-30.0, -60.0]

[expect]
adaptations = {adaptations}
contacts = 0
"""


def campaign(*arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([sys.executable, CAMPAIGN, *arguments], capture_output=True, text=True, check=False)


@pytest.mark.long
@pytest.mark.slow
def test_a_run_that_deviates_is_told_and_is_the_exit_status(tmp_path: Path) -> None:
    good, bad = tmp_path / "good.toml", tmp_path / "bad.toml"
    good.write_text(SHORT.format(adaptations=0))
    bad.write_text(SHORT.format(adaptations=1))
    done = campaign(str(good), str(bad), "--config", "paper", "--json", "--keep", str(tmp_path / "logs"))
    assert done.returncode == 1
    rows = {row["name"]: row for row in json.loads(done.stdout)}
    assert (rows["good"]["is_good"], rows["good"]["deviations"]) == (True, [])
    assert (rows["bad"]["is_good"], rows["bad"]["deviations"]) == (False, ["adaptations: 0, expected 1"])
    assert rows["bad"]["outcome"]["end"] == "finished"
    assert (tmp_path / "logs" / "paper" / "bad" / "run.mcap").is_file()
    assert "2/2" in done.stderr
