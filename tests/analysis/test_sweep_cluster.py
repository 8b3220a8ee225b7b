"""A sweep's connections to a cluster: by certificates; what is refused."""

import subprocess
import sys
from pathlib import Path

import pytest
from called import called
from hang import HANG_S

distributed = pytest.importorskip("distributed")
parquet = pytest.importorskip("pyarrow.parquet")


@pytest.fixture(scope="module")
def security():
    """A certificate that is its own authority, and its key, for scheduler, workers and clients."""
    return distributed.Security.temporary()


def pem_files(folder: Path, security) -> list[object]:
    """Write them, and name them to the command."""
    words: list[object] = []
    for option in ("--tls-ca-file", "--tls-cert", "--tls-key"):
        content = security.tls_client_key if option == "--tls-key" else security.tls_ca_file
        path = folder / f"{option[2:]}.pem"
        path.write_text(content)
        words += [option, path]
    return words


def sweep(folder: Path, log: Path, *more: object) -> "subprocess.CompletedProcess[str]":
    """Run the command in a process of its own, so that nothing that Dask might print is missed."""
    words = ["sweep", log, "--vary", "detector.threshold_Nm=0.1,0.4", "--out", folder / "out", *more]
    command = [sys.executable, "-c", "from adacd_hil.cli.main import main; main()", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=HANG_S, check=False, cwd=folder)


@pytest.mark.long
def test_a_small_sweep_over_tls(tmp_path, log, security):
    quiet = {"dashboard_address": None, "silence_logs": 50}
    one = {"n_workers": 1, "threads_per_worker": 1, "processes": False}
    with distributed.LocalCluster(protocol="tls", security=security, **one, **quiet) as cluster:
        played = sweep(tmp_path, log, "--scheduler", cluster.scheduler_address, *pem_files(tmp_path, security))
    assert (played.returncode, "is open" in played.stderr) == (0, False)
    rows = parquet.read_table(tmp_path / "out/sweep.parquet").to_pylist()
    assert [(row["set.detector.threshold_Nm"], row["status"]) for row in rows] == [("0.1", "ok"), ("0.4", "ok")]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"--tls-ca-file": None}, "needs --tls-ca-file"),
        ({"--tls-cert": None, "--tls-key": None}, "needs --tls-cert"),
        ({"--tls-cert": None}, "--tls-key needs --tls-cert"),
        ({"--tls-ca-file": "missing.pem"}, "No such file"),
        ({"--tls-ca-file": "text.pem"}, "CA file text.pem"),
        ({"--tls-cert": "text.pem"}, "certificate text.pem"),
        ({"--tls-key": "other.pem"}, "KEY_VALUES_MISMATCH"),
        ({"--scheduler": "tcp://127.0.0.1:1"}, "are for tls:// addresses, not tcp://127.0.0.1:1"),
    ],
)
def test_certificates_that_cant_be_used_are_one_line_and_status_2(
    tmp_path, log, security, monkeypatch, changes, reason
):
    (tmp_path / "text.pem").write_text("no certificate\n")
    (tmp_path / "other.pem").write_text(distributed.Security.temporary().tls_client_key)
    given = pem_files(tmp_path, security)
    words: dict[object, object] = {
        "--scheduler": "tls://127.0.0.1:1",
        **dict(zip(given[::2], given[1::2], strict=True)),
    }
    words |= changes
    more = [str(word) for pair in words.items() if pair[1] is not None for word in pair]
    monkeypatch.chdir(tmp_path)
    refused = called("sweep", log, "--out", tmp_path / "out", *more)
    complaints = [line for line in refused.stderr.splitlines() if not line.startswith("1 row: ")]
    assert (refused.exit_code, len(complaints)) == (2, 1), refused.stderr
    assert reason in complaints[0]
    assert not (tmp_path / "out").exists()


def test_an_open_scheduler_is_called_open(tmp_path, log, monkeypatch):
    monkeypatch.setattr("adacd_hil.lab.tune.workers.TIMEOUT_S", 0.1)
    words = ["sweep", str(log), "--scheduler", "tcp://127.0.0.1:1", "--out", str(tmp_path / "out")]
    refused = called(*words)
    assert (refused.exit_code, (tmp_path / "out").exists()) == (1, False)
    assert "tcp://127.0.0.1:1 is open" in refused.stderr
    assert refused.stderr.splitlines()[-1].startswith("adacd-hil: no Dask scheduler at tcp://127.0.0.1:1: ")
