"""Doctor's checks of the host, as rows: what the kernel says, and what is made of it."""

import dataclasses
from typing import Any

import pytest

from adacd_hil.lab.commission.host_checks import HOST_CHECKS, Host, Status
from adacd_hil.scheduling import RealtimeGrant, Refusal
from adacd_hil.wire.can_interface import InterfaceState, parse_ip_link

GRANTED = RealtimeGrant("SCHED_FIFO 80", cpu=3, is_memory_locked=True, is_awake=True)
CAN0 = InterfaceState(
    name="can0",
    is_up=True,
    kind="can",
    mtu=72,
    txqueuelen=10,
    qdisc="pfifo_fast",
    bitrate=1_000_000,
    data_bitrate=5_000_000,
    sample_point=0.875,
    restart_ms=100,
    state="ERROR-ACTIVE",
    rx_errors=0,
    tx_errors=0,
)

RUN = {check.name: check.run for check in HOST_CHECKS}


def host(link: InterfaceState | None = CAN0, **changes: Any) -> Host:
    return dataclasses.replace(Host("socketcan", "can0", link, 1_000_000, 0, lambda: GRANTED), **changes)


FD = {"data_bitrate": 5_000_000}
"""A contract with CAN FD."""


@pytest.mark.parametrize(
    ("check", "changes", "contract", "status", "text"),
    [
        ("interface", {}, {}, Status.OK, "can0 is up, hardware"),
        ("interface", {"is_up": False}, {}, Status.FAILED, "can0 is down"),
        ("interface", {"kind": "vcan"}, {}, Status.OK, "virtual"),
        ("bit rate", {}, {}, Status.OK, "1000000 bit/s"),
        ("bit rate", {"bitrate": 500_000}, {}, Status.FAILED, "500000 bit/s, the contract has 1000000"),
        ("bit rate", {"bitrate": None}, {}, Status.SKIPPED, "install iproute2"),
        ("bit rate", {"kind": "vcan"}, {}, Status.SKIPPED, "vcan has none"),
        ("bit rate", {}, FD, Status.OK, "data phase 5000000"),
        ("bit rate", {"data_bitrate": 2_000_000}, FD, Status.FAILED, "2000000 bit/s, the contract has 5000000"),
        ("bit rate", {"data_bitrate": None}, FD, Status.FAILED, "data phase 0 bit/s, the contract has 5000000"),
        ("sample point", {"sample_point": 0.70}, {}, Status.OK, "70.0 %"),
        ("sample point", {"sample_point": 0.69}, {}, Status.WARNING, "outside 70% to 90%"),
        ("sample point", {"sample_point": 0.91}, {}, Status.WARNING, "outside 70% to 90%"),
        ("restart", {}, {}, Status.OK, "100 ms"),
        ("restart", {"restart_ms": 0}, {}, Status.WARNING, "stays silent"),
        ("controller", {}, {}, Status.OK, "ERROR-ACTIVE"),
        ("controller", {"state": "ERROR-PASSIVE", "tx_errors": 128}, {}, Status.WARNING, "tx 128"),
        ("controller", {"state": "BUS-OFF"}, {}, Status.FAILED, "BUS-OFF"),
        ("queue", {"txqueuelen": 99}, {}, Status.OK, "txqueuelen 99"),
        ("queue", {"txqueuelen": 100}, {}, Status.WARNING, "up to 100 old commands"),
        ("queue", {"txqueuelen": 4096, "qdisc": "noqueue"}, {}, Status.OK, "noqueue"),
        ("mtu", {"mtu": 16}, {}, Status.OK, "16, classic frames fit"),
        ("mtu", {}, FD, Status.OK, "CAN FD frames fit"),
        ("mtu", {"mtu": 16}, FD, Status.FAILED, "no CAN FD frames"),
    ],
)
def test_an_interface_is_judged_by_what_the_kernel_says(check, changes, contract, status, text):
    outcome = RUN[check](host(dataclasses.replace(CAN0, **changes), **contract))
    assert outcome.status is status
    assert text in outcome.reason
    assert bool(outcome.remedy) is (status in (Status.WARNING, Status.FAILED))


def test_an_interface_that_is_not_there_is_named_with_those_that_are():
    outcome = RUN["interface"](host(None))
    assert outcome.status is Status.FAILED
    assert outcome.reason.startswith("can0 is no CAN interface; present: ")


@pytest.mark.parametrize("check", ["kernel", "interface", "permissions"])
def test_python_cans_own_interfaces_have_no_kernel_to_look_at(check):
    assert RUN[check](host(None, interface="virtual")).status is Status.SKIPPED


def test_what_is_granted_is_told_and_what_is_not_with_its_remedy():
    reason = RUN["scheduler"](host()).reason
    assert reason == "scheduler SCHED_FIFO 80, cpu 3, memory locked, idle states shallow"
    grant = RealtimeGrant("SCHED_OTHER", (Refusal("SCHED_FIFO: no", "allow it"), Refusal("memory: no", "allow that")))
    outcome = RUN["scheduler"](host(request_realtime=lambda: grant))
    assert outcome.reason == "not granted: SCHED_FIFO: no, memory: no"
    assert outcome.remedy == "allow it; allow that"


def isolated(cpus: str) -> dict[str, str]:
    return {"sys/devices/system/cpu/isolated": f"{cpus}\n"}


def governors(*names: str) -> dict[str, str]:
    return {f"sys/devices/system/cpu/cpu{k}/cpufreq/scaling_governor": f"{name}\n" for k, name in enumerate(names)}


def throttled(runtime_us: int) -> dict[str, str]:
    kernel = "proc/sys/kernel/sched_rt_"
    return {f"{kernel}runtime_us": f"{runtime_us}\n", f"{kernel}period_us": "1000000\n"}


@pytest.mark.parametrize(
    ("files", "check", "status", "text"),
    [
        (isolated(""), "isolation any", Status.OK, "not asked for"),
        (isolated("2-3"), "isolation any", Status.WARNING, "isolated processors: 2, 3, not used"),
        (isolated(""), "isolation isolated", Status.WARNING, "isolated processors: none"),
        (isolated("2-3"), "isolation isolated", Status.OK, "isolated processors: 2, 3"),
        (isolated("2-3"), "isolation 3", Status.OK, "`realtime.cpu` = 3"),
        (isolated("2-3"), "isolation 1", Status.WARNING, "processor 1 is shared"),
        ({"proc/self/status": "Name:\tx\nCapEff:\t0000000000001000\n"}, "permissions", Status.OK, "CAP_NET_ADMIN"),
        ({"proc/self/status": "CapEff:\t0000000000002fff\n"}, "permissions", Status.WARNING, "without CAP_NET_ADMIN"),
        ({}, "permissions", Status.SKIPPED, "/proc"),
        ({"proc/version": "Linux #1 SMP PREEMPT_RT Debian"}, "preemption", Status.OK, "PREEMPT_RT"),
        ({"sys/kernel/realtime": "1\n"}, "preemption", Status.OK, "PREEMPT_RT"),
        ({"proc/version": "Linux #1 SMP PREEMPT_DYNAMIC"}, "preemption", Status.WARNING, "PREEMPT: single"),
        ({"proc/version": "Linux #1 SMP"}, "preemption", Status.WARNING, "no preemption named"),
        (governors("performance"), "processor", Status.OK, "governor performance"),
        (governors("performance", "powersave"), "processor", Status.WARNING, "governor performance, powersave"),
        ({}, "processor", Status.SKIPPED, "no frequency scaling"),
        (throttled(-1), "throttling", Status.OK, "off"),
        (throttled(950_000), "throttling", Status.OK, "95% of 1000 ms"),
        (throttled(500_000), "throttling", Status.WARNING, "50% of 1000 ms"),
        ({}, "throttling", Status.SKIPPED, "/proc"),
    ],
)
def test_the_machine_is_judged_by_its_files(tmp_path, files, check, status, text):
    """The processor that is asked for stands behind the check."""
    for name, content in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    check, _, cpu = check.partition(" ")
    outcome = RUN[check](host(root=tmp_path, cpu=cpu or "any"))
    assert outcome.status is status
    assert text in outcome.reason
    assert bool(outcome.remedy) is (status is Status.WARNING)


def test_a_link_is_read_from_iproute2():
    shown = {
        "ifname": "can0",
        "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"],
        "mtu": 72,
        "qdisc": "pfifo_fast",
        "txqlen": 10,
        "link_type": "can",
        "linkinfo": {
            "info_kind": "can",
            "info_data": {
                "state": "ERROR-ACTIVE",
                "berr_counter": {"tx": 0, "rx": 0},
                "restart_ms": 100,
                "bittiming": {"bitrate": 1_000_000, "sample_point": "0.875", "tq": 12},
                "data_bittiming": {"bitrate": 5_000_000, "sample_point": "0.750"},
            },
            "info_xstats": {"bus_off": 0},
        },
    }
    assert parse_ip_link(shown) == CAN0


def test_a_vcan_has_no_bit_timing():
    shown = {"ifname": "vcan0", "flags": ["UP"], "mtu": 72, "txqlen": 1000, "link_type": "can"}
    link = parse_ip_link(shown | {"linkinfo": {"info_kind": "vcan"}})
    assert link is not None
    assert (link.bitrate, link.restart_ms, link.state, link.is_virtual) == (None, None, None, True)


def test_what_is_no_can_is_no_link():
    assert parse_ip_link({"ifname": "lo", "flags": ["UP"], "link_type": "loopback", "mtu": 65536}) is None
