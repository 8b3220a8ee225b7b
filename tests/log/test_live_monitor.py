"""`monitor --url`: what a terminal shows of a live view, and how the commands say that they can't."""

import contextlib
import json
import sys
import threading
from types import SimpleNamespace

import click
import numpy as np
import pytest
from click.testing import CliRunner
from hang import HANG_S
from live_rig import PUSH, Feed, receive_until_last
from recorded_run import make_run

from adacd_hil.cli.main import cli
from adacd_hil.cli.options import live_options
from adacd_hil.extras import install_command
from adacd_hil.lab.cli.live_monitor import TOPICS, LiveMonitor, as_text
from adacd_hil.lab.live.client import LiveMessage, live_client
from adacd_hil.lab.live.live_view import LiveView
from adacd_hil.log.types.message_types import payload_dtype
from adacd_hil.log.types.topics import run_channels
from adacd_hil.records import (
    PARAMETER_NAMES,
    ContactLevel,
    Event,
    FaultReason,
    SchemeState,
    scheme_layout,
)


def two_cycles():
    """Make a run whose second cycle is shown, 60 ms after the first."""
    run = make_run(2, start_ns=5_000_000_000)
    first, second = run.cycles
    second.t_ns = first.t_ns + 60_000_000
    slices = scheme_layout(7).slices
    block = np.zeros(scheme_layout(7).size)
    block[slices["q"]] = (0.5, -1.0)
    block[slices["tau_J"]] = (1.25, -2.5)
    block[slices["tau_ext_hat"]] = (0.03, -0.3)
    block[slices["threshold"]] = (0.1, np.inf)
    block[slices["theta_hat"]] = np.arange(1.0, 8.0)
    second.output = second.output._replace(
        cycle=41, state=SchemeState.MONITOR, fault=FaultReason.NONE, block=block, previous_state=SchemeState.CERTIFY
    )
    second.record = second.record._replace(lateness_ns=12_000, slack_ns=437_000, overruns=7, frames_missing=3)
    second.contact = PUSH._replace(force_N=7.25, lever_m=0.125)
    second.event = Event("warning", "realtime", "late")
    return run


def shown_of(run):
    """What a monitor says of a run."""
    with Feed() as fed, live_client(fed.live.url, TOPICS) as client:
        fed.cycles(run, 1)
        monitor = LiveMonitor(client)
        for message in receive_until_last(client):
            monitor.accept_message(message)
    return monitor.describe()


@pytest.fixture(scope="module")
def described():
    return shown_of(two_cycles())


def test_the_latest_state_is_described(described):
    assert (described["state"], described["fault"], described["cycle"]) == ("MONITOR", "NONE", 41)
    assert described["joints"][0] == {
        "joint": "joint1",
        "q_rad": 0.5,
        "tau_J_Nm": 1.25,
        "tau_ext_hat_Nm": 0.03,
        "threshold_Nm": 0.1,
        "share": pytest.approx(0.3),
    }
    assert (described["joints"][1]["threshold_Nm"], described["joints"][1]["share"]) == (None, None)
    assert described["parameters"] == dict(zip(PARAMETER_NAMES, np.arange(1.0, 8.0).tolist(), strict=True))


def test_times_count_from_the_first_message(described):
    assert described["t_s"] == 0.06
    assert [event["t_s"] for event in described["events"]] == [0.06, 0.06]
    assert described["events"][0] == {"t_s": 0.06, "level": "warning", "name": "realtime", "message": "late"}
    assert described["contacts"] == [
        {
            "t_s": 0.06,
            "link": 2,
            "level": ContactLevel.COLLISION.name,
            "kind": "PUSH",
            "location": "KNOWN",
            "force_N": 7.25,
            "lever_m": 0.125,
            "is_final": True,
        }
    ]


def test_a_terminal_shows_bars_that_are_full_at_the_threshold(described):
    lines = as_text(described).splitlines()
    timing = "late 12 µs, slack 437 µs, 7 periods skipped, 3 frames missing"
    assert lines[0] == f"MONITOR, cycle 41, 0.1 s watched; {timing}"
    (joint1,), (joint2,) = ([line for line in lines if line.startswith(name)] for name in ("joint1", "joint2"))
    assert joint1.startswith("joint1 [" + 12 * "#" + 28 * "." + "]  30 % of the threshold")
    assert joint2.startswith("joint2 [" + 40 * "." + "] detection off")
    assert joint2.endswith("external -0.300 Nm, torque -2.500 Nm, position -57.3°")
    assert "a1 1  a2 2  a3 3  F_v1 4  F_v2 5  F_c1 6  F_c2 7" in lines
    assert any(line.split() == ["0.060", "COLLISION", "2", "PUSH", "7.2", "0.12", "KNOWN"] for line in lines)
    assert any(line.split() == ["0.060", "warning", "realtime", "late"] for line in lines)


def test_a_residual_beyond_the_threshold_fills_the_bar_and_a_fault_is_named(described):
    joint = described["joints"][0] | {"share": 2.5}
    text = as_text(described | {"joints": [joint, joint], "fault": "DRIVE"})
    assert "[" + 40 * "#" + "] 250 % of the threshold" in text
    assert text.startswith("MONITOR by DRIVE")


def test_of_the_certified_scheme_the_filter_nearest_to_its_threshold_counts():
    (scheme,) = (c for c in run_channels(7, (), 2, 3) if c.topic == "/scheme")
    record = np.zeros(1, payload_dtype(scheme.type.text))[0]
    record["tau_ext_bank"] = (0.1, 0.2, -0.9, 0.4, 0.3, 5.0)
    record["threshold_bank"] = (1.0, 1.0, 1.0, 1.0, 1.0, np.inf)
    monitor = LiveMonitor(SimpleNamespace(decode=lambda message: record))
    monitor.accept_message(LiveMessage("/scheme", 0, b""))
    assert [joint["share"] for joint in monitor.describe()["joints"]] == [0.9, 0.4]
    record["threshold_bank"] = np.inf
    assert [joint["share"] for joint in monitor.describe()["joints"]] == [None, None]


@pytest.mark.parametrize("words", [(), ("--json",)])
def test_the_monitor_ends_with_the_run(words, monkeypatch):
    fed = Feed()
    is_subscribed = threading.Event()

    class Seen(LiveMonitor):
        def __init__(self, client) -> None:
            super().__init__(client)
            is_subscribed.set()

    def end() -> None:
        is_subscribed.wait(HANG_S)
        fed.close()

    monkeypatch.setattr("adacd_hil.lab.cli.live_monitor.LiveMonitor", Seen)
    thread = threading.Thread(target=end)
    thread.start()
    result = CliRunner().invoke(cli, ["monitor", "--url", fed.live.url, "--seconds", "600", *words])
    thread.join()
    assert result.exit_code == 0
    if words:
        assert json.loads(result.stdout)["messages"] == 0
    else:
        assert result.stdout == "0 messages, none of /scheme\n"


@pytest.mark.wallclock
def test_the_monitor_listens_for_as_long_as_it_is_asked_to():
    fed = Feed()
    result = CliRunner().invoke(cli, ["monitor", "--url", fed.live.url, "--seconds", "0.1", "--json"])
    fed.close()
    assert (result.exit_code, json.loads(result.stdout)["url"]) == (0, fed.live.url)


@pytest.mark.parametrize(
    ("words", "asked_for"), [(("demo", "--live"), "--live"), (("monitor", "--url", "ws://127.0.0.1:1"), "--url")]
)
def test_without_the_extra_there_is_one_line_and_status_2(monkeypatch, tmp_path, words, asked_for):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "websockets", None)
    result = CliRunner().invoke(cli, words)
    assert result.exit_code == 2
    assert result.stderr == f"adacd-hil: {asked_for} needs the extra `live`: {install_command('live')}\n"
    assert list(tmp_path.iterdir()) == []


def test_no_escape_sequence_of_an_event_reaches_the_terminal():
    run = two_cycles()
    run.cycles[1].event = Event("warning", "\x1b[2Jname", "\x1b]0;owned\x07text\r\n")
    text = as_text(shown_of(run))
    assert "\\u001b[2Jname" in text
    assert {letter for letter in text if not letter.isprintable()} <= {"\n"}


@pytest.mark.parametrize(
    "message", [LiveMessage("/events", 0, b"short"), LiveMessage("/scheme", 0, b""), LiveMessage("/contact", 0, b"")]
)
def test_a_server_of_something_else_is_one_line_and_status_1(monkeypatch, message):
    @contextlib.contextmanager
    def strange(url, topics):
        unknown = np.zeros(1, [("state", np.uint8)])[0]
        yield SimpleNamespace(is_open=True, receive=lambda timeout_s: message, decode=lambda message: unknown)

    monkeypatch.setattr("adacd_hil.lab.cli.live_monitor.live_client", strange)
    result = CliRunner().invoke(cli, ["monitor", "--url", "ws://x:1", "--seconds", "0.1"])
    assert (result.exit_code, result.stderr) == (1, "adacd-hil: it does not serve a log of adacd-hil\n")


def test_the_options_say_where_and_who():
    @click.command()
    @live_options
    def command(live):
        print(live)

    given = ["--live", "--live-port", "0", "--live-host", "::1", "--live-viewers", "3", "--live-name", "arm.example"]
    origins = ["--live-origin", "https://View.example:8443/", "--live-origin", "viewer-app://"]
    found = CliRunner().invoke(command, [*given, *origins]).stdout
    assert found == f"{LiveView('::1', 0, ('https://view.example:8443', 'viewer-app://'), ('arm.example',), 3)}\n"
    assert CliRunner().invoke(command, []).stdout == "None\n"
    assert CliRunner().invoke(command, ["--live"]).stdout == f"{LiveView('127.0.0.1', 8765, (), (), 8)}\n"


@pytest.mark.parametrize("origin", ["view.example", "*", "https://view.example/page", "https://a b", "", "null"])
def test_what_is_no_origin_is_refused(origin, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(cli, ["demo", "--live", "--live-origin", origin])
    assert result.exit_code == 2
    assert result.stderr.startswith(f"adacd-hil: --live-origin: {origin!r} is no origin")
    assert list(tmp_path.iterdir()) == []
