"""`adacd-hil log` on small logs: what it prints and how it ends."""

import json

import pytest
from called import called
from log.made_log import SUMMARY, make_log
from log.recorded_run import make_run, record

from adacd_hil.records import Event
from firmware_sim.bench.bench_time import TruthLog

WHOLE = make_log()


def call(*arguments):
    result = called("log", *arguments)
    return result.exit_code, result.stdout, result.stderr


def write(path, data=WHOLE):
    path.write_bytes(data)
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A run of 200 cycles, with contacts and events."""
    path = tmp_path_factory.mktemp("recorded") / "run.mcap"
    record(path, make_run(200, has_fd=True))
    return path


def test_check_says_whether_a_log_is_clean(tmp_path):
    clean, bad = write(tmp_path / "a.mcap"), write(tmp_path / "b.mcap", WHOLE[:-3])
    dropped = write(tmp_path / "c.mcap", make_log(summary={**SUMMARY, "dropped": "4"}))
    assert call("check", clean)[:2] == (0, f"{clean}: clean; 20 messages in 1 files\n")
    code, out, _ = call("check", dropped)
    warning, last = out.splitlines()
    assert (code, last) == (3, f"{dropped}: 0 errors, 1 warnings; 20 messages in 1 files")
    assert "c.mcap: 4 packets were dropped on the way to the log" in warning
    code, out, err = call("check", tmp_path, "--json")
    errors = {entry["path"]: entry["errors"] for entry in json.loads(out)}
    assert (code, errors) == (1, {str(clean): 0, str(bad): 2, str(dropped): 0})
    assert err.splitlines() == ["checking a.mcap", "checking b.mcap", "checking c.mcap"]
    assert call("check", tmp_path / "none.mcap")[0] == 1


@pytest.mark.parametrize("command", ["info", "check"])
def test_a_log_that_cannot_be_read_keeps_no_other_back(command, tmp_path):
    whole, gone, empty = write(tmp_path / "a.mcap"), tmp_path / "gone.mcap", tmp_path / "empty"
    empty.mkdir()
    code, out, err = call(command, empty, gone, whole, "--json")
    assert (code, [entry["path"] for entry in json.loads(out)]) == (1, [str(whole)])
    folder, file = (line for line in err.splitlines() if line.startswith("adacd-hil: "))
    assert (str(empty) in folder, str(gone) in file) == (True, True)
    assert call(command, gone, "--json")[:2] == (1, "")


def test_recover_says_what_was_lost(tmp_path):
    path = write(tmp_path / "a.mcap")
    code, out, _ = call("recover", path)
    saved = f"{tmp_path / 'a.recovered.mcap'}: 20 messages, 2 attachments"
    assert (code, out.splitlines()) == (0, [saved, "nothing was lost"])
    path.write_bytes(WHOLE[:700])
    code, out, _ = call("recover", path, "--out", tmp_path / "b.mcap", "--json")
    result = json.loads(out)
    assert (code, result["messages"], result["lost"]) == (3, 10, "the end, an unknown number of messages")
    assert call("recover", path)[1].splitlines()[-1] == "lost: the end, an unknown number of messages"
    path.write_bytes(WHOLE[:30])
    code, out, err = call("recover", path)
    assert (code, out, err.splitlines()[-1]) == (1, "", f"adacd-hil: {path}: nothing to save")
    assert call("recover")[0] == 2


def test_info_shows_a_run_at_a_glance(recorded):
    code, out, _ = call("info", recorded, "--json")
    (info,) = json.loads(out)
    assert code == 0
    assert (info["cycles"], info["dropped"], info["ending"]) == (200, 0, "closed")
    assert info["frames"] == 200 * 9 + 80
    assert (info["contacts"], info["collisions"]) == (4, 4)
    assert (info["events"], len(info["faults"])) == ({"info": 2, "warning": 2, "error": 1}, 1)
    assert info["duration_s"] == pytest.approx(0.199, abs=0.006)
    topics = {topic["topic"]: topic for topic in info["topics"]}
    assert (topics["/cycle"]["messages"], topics["/cycle"]["bytes"]) == (200, 200 * 124)
    assert topics["/cycle"]["rate_hz"] == pytest.approx(1000, rel=0.05)
    assert topics["/from_can_bus_fd"]["bytes"] is None
    assert info["metadata"]["name"] == "Prüfung"
    assert info["attachments"]["run.toml"] == 11
    text = call("info", recorded)[1]
    assert "200 cycles, closed" in text
    assert "4 contacts, 4 of them collisions; 1 errors, 2 warnings" in text


def test_info_counts_no_errors_where_there_is_no_topic_for_them(recorded, tmp_path):
    call("cut", recorded, "--topic", "/cycle", "--out", tmp_path / "run.mcap")
    assert call("info", tmp_path / "run.mcap")[1].splitlines()[2] == "no /contact; no /events"


def test_info_of_a_cut_log_shows_what_is_there(recorded, tmp_path):
    whole, cut = json.loads(call("info", recorded, "--json")[1])[0], tmp_path / "run.mcap"
    cut.write_bytes(recorded.read_bytes()[:-30])
    code, out, _ = call("info", cut, "--json")
    (info,) = json.loads(out)
    assert code == 3
    assert info["problems"] == ["run.mcap is cut or damaged: `adacd-hil log check` says how"]
    found = ("messages", "cycles", "frames", "contacts", "events", "metadata", "attachments", "start_ns", "duration_s")
    assert {key: info[key] for key in found} == {key: whole[key] for key in found}
    sizes = {topic["topic"]: topic["bytes"] for topic in info["topics"]}
    for topic in whole["topics"]:
        assert topic["bytes"] in (None, sizes[topic["topic"]]), topic


FORGED = "x\nclean: forged"
SHOWN = "x\\u000aclean: forged"


def test_what_a_log_says_stays_within_its_line(tmp_path):
    run = {"name": FORGED, FORGED: "text"}
    data = make_log(topics=("/a", f"/{FORGED}"), run=run, attachments={FORGED: b"data"})
    path = write(tmp_path / f"{FORGED}.mcap", data)
    cut = write(tmp_path / "cut.mcap", data[:-40])
    out = tmp_path / f"{FORGED}.out"
    given = (
        ("info", path),
        ("check", path),
        ("check", cut),
        ("recover", cut, "--out", out),
        ("cut", path, "--out", out),
    )
    for words in given:
        _, text, err = call(*words)
        assert text
        assert not [line for line in (text + err).splitlines() if line.startswith("clean: forged")]
    text = call("info", path)[1]
    assert f"  {SHOWN}\n" in text
    assert f"attached: {SHOWN} (4)" in text
    assert f"/{SHOWN} " in text


def test_events_of_a_log_stay_within_their_line(tmp_path):
    with TruthLog(tmp_path / "truth.mcap", blocking=True) as log:
        log.event(0, Event("error", "arm", "fell\nproblem: none"))
    (line,) = [line for line in call("info", tmp_path)[1].splitlines() if "fell" in line]
    assert line == "  error: arm: fell\\u000aproblem: none"


@pytest.mark.parametrize(("end", "status"), [(None, 0), (-30, 3)])
def test_info_of_a_log_without_its_beginning_shows_what_is_there(end, status, recorded, tmp_path):
    (tmp_path / "x.mcap").write_bytes(b"spoilt.." + recorded.read_bytes()[8:end])
    code, out, _ = call("info", tmp_path / "x.mcap", "--json")
    assert (code, json.loads(out)[0]["cycles"]) == (status, 200)


def test_cut_takes_a_stretch_by_time_or_contact(recorded, tmp_path):
    out = tmp_path / "out.mcap"
    code, text, _ = call("cut", recorded, "--from", "0.05", "--until", "0.1", "--out", out, "--json")
    assert (code, json.loads(text)["from_s"], json.loads(text)["until_s"]) == (0, 0.05, 0.1)
    assert json.loads(call("info", out, "--json")[1])[0]["cycles"] == 50
    assert call("check", out)[0] == 0
    code, text, _ = call("cut", recorded, "--contact", "2", "--around", "0.01", "--out", out)
    assert code == 0
    (info,) = json.loads(call("info", out, "--json")[1])
    assert (info["cycles"], info["contacts"]) == (20, 1)  # the second is of cycle 70
    code, text, _ = call("cut", recorded, "--out", out, "--json")
    assert (json.loads(text)["from_s"], json.loads(text)["until_s"]) == (None, None)
