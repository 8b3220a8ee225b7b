"""Doctor's diagnosis, its checks of the configuration, and of the host: kernel, CAN interface, permissions, scheduler.

A diagnosis is a table of named checks, run in order, each with a reason and a remedy. A check is skipped if a check
that it needs has failed, so that a bad bus is not used further.
"""

import errno
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

from adacd_hil.control.configuration_check import examine_settings, profile_guesses
from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.scheduling import ANY_CPU, ISOLATED_CPU, RealtimeGrant, isolated_cpus
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import ConfigurationLayer
from adacd_hil.settings.setting_keys import in_words, known_keys, value_of
from adacd_hil.wire.bus import BusError
from adacd_hil.wire.can_interface import CANFD_MTU, InterfaceState, can_interfaces


class Status(Enum):
    """Outcome of a check."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"
    SKIPPED = "skipped"


class Finding(NamedTuple):
    """Outcome of a check with its reason. name: of the check; "" until `diagnose` has set it.

    `remedy`: the user's next step; "" if none is needed.
    """

    name: str
    status: Status
    reason: str
    remedy: str = ""


Examination = TypeVar("Examination")


class Check(NamedTuple, Generic[Examination]):
    """One line of a table of checks. `run`: returns the finding on the examined settings, host or arm.

    `needs`: names of earlier checks; if one has failed, this check is skipped.
    """

    name: str
    run: Callable[[Examination], Finding]
    needs: tuple[str, ...] = ()


def ok(reason: str) -> Finding:
    """Return the outcome of a passed check."""
    return Finding("", Status.OK, reason)


def warning(reason: str, remedy: str) -> Finding:
    """Return the outcome of a check after which the arm can run, but with less margin. remedy: the user's next step."""
    return Finding("", Status.WARNING, reason, remedy)


def failed(reason: str, remedy: str) -> Finding:
    """Return the outcome of a check after which the arm must not or can't run. remedy: the user's next step."""
    return Finding("", Status.FAILED, reason, remedy)


def skipped(reason: str) -> Finding:
    """Return the outcome of a check that wasn't made; reason: why it isn't possible here."""
    return Finding("", Status.SKIPPED, reason)


def diagnose(
    checks: Sequence[Check[Examination]],
    examination: Examination,
    report: Callable[[Finding], None],
    earlier: Sequence[Finding] = (),
) -> list[Finding]:
    """Run the checks in order; call `report` with each finding, and return all findings, with their names.

    A DeviceError or BusError fails its check; other errors are raised. A check is skipped if a check that it needs has
    failed, here or in `earlier`, the findings of another table, or was skipped for that reason here.
    """
    findings: list[Finding] = []
    # failed or skipped check → the failed check that caused it
    blocked = {finding.name: finding.name for finding in earlier if finding.status is Status.FAILED}
    for check in checks:
        cause = next((blocked[name] for name in check.needs if name in blocked), None)
        if cause is not None:
            outcome = skipped(f"needs `{cause}`, which failed")
            blocked[check.name] = cause
        else:
            outcome = _run(check, examination)
            if outcome.status is Status.FAILED:
                blocked[check.name] = check.name
        findings.append(outcome._replace(name=check.name))
        report(findings[-1])
    return findings


def _run(check: Check[Examination], examination: Examination) -> Finding:
    """Return the finding of a check; a DeviceError or BusError becomes a failure, other errors are raised."""
    try:
        return check.run(examination)
    except DeviceError as error:
        return failed(str(error), error.remedy or "see the device's manual; `adacd-hil scan` lists the nodes")
    except BusError as error:
        return failed(str(error), "check wiring, termination and bit rate")


def summarise(findings: Sequence[Finding]) -> str:
    """Return a line with the number of findings of each status, such as "3 ok, 1 warning, 0 failed, 0 skipped"."""
    counts = {status: sum(finding.status is status for finding in findings) for status in Status}
    return ", ".join(f"{count} {status.value}" for status, count in counts.items())


def configuration_checks(settings: Settings, layers: Sequence[ConfigurationLayer] = ()) -> list[Check[Settings]]:
    """Return doctor's checks of a configuration: one of its errors and likely mistakes, and one for each guessed value.

    The latter always warn. Guessed are keys in `assumed` of the configuration, and of its device profiles; unknown keys
    of the configuration have no check. layers: as of `examine_settings`. Raises ConfigError as `profile_guesses`.
    """
    known, guesses = known_keys(), dict[str, Finding]()
    for key in settings.assumed:
        if key in known:
            value = value_of(settings, key)
            text = "nothing is given" if value is None else f"{in_words(value)} is a guess"
            remedy = f"measure it or look it up, write it, and take `{key}` off `assumed`"
            guesses[key] = warning(f"{text}: {known[key].meaning}", remedy)
    for key, number in profile_guesses(settings).items():
        remedy = "look it up or measure it, write it into that profile, and take the key off its `assumed`"
        guesses[key] = warning(f"{number:.10g} is a guess", remedy)
    return [
        Check("settings", lambda settings: check_settings(settings, layers)),
        *(Check(f"`{key}`", _telling(finding)) for key, finding in guesses.items()),
    ]


def _telling(finding: Finding) -> Callable[[Settings], Finding]:
    return lambda _: finding


def check_settings(settings: Settings, layers: Sequence[ConfigurationLayer]) -> Finding:
    """Fail for errors of a configuration, warn of likely mistakes; as `config check`. layers: of the configuration."""
    found = examine_settings(settings, layers)
    remedy = "correct the configuration; `adacd-hil config check` looks at it without a bus"
    if found.errors:
        return failed("; ".join(found.errors), remedy)
    return warning("; ".join(found.mistakes), remedy) if found.mistakes else ok(f"configuration {settings.name}")


QUEUE_FRAMES = 10
"""Recommended txqueuelen: the kernel's default, three cycles' worth of a cycle's three frames."""
LONG_QUEUE_FRAMES = 100
"""A queue this long keeps over 30 cycles of old commands on a dead bus, which are sent when it returns."""
_SAMPLE_POINT = (0.70, 0.90)
"""CiA 301 table 1 recommends 87.5 %; 70 to 90 % is compatible with it on the short bus of an arm."""
_CAP_NET_ADMIN = 12
_RT_SHARE = 0.9
"""The kernel's default is 0.95; apart from waiting for feedback, a cycle works for less than half of its period."""


@dataclass(frozen=True)
class Host:
    """The host to examine. `interface`: as of python-can, "socketcan" for the kernel's CAN. `channel`: such as "can0".

    `link`: state of the channel; None if there is no such CAN interface. bitrate, data_bitrate: of the contract, bit/s,
    the second 0 without CAN FD. `request_realtime`: requests the scheduler for this process. `cpu`: the setting
    `realtime.cpu`. `root`: folder with proc and sys.
    """

    interface: str
    channel: str
    link: InterfaceState | None
    bitrate: int
    data_bitrate: int
    request_realtime: Callable[[], RealtimeGrant]
    cpu: str = ANY_CPU
    root: Path = Path("/")

    @property
    def is_socketcan(self) -> bool:
        """Whether the interface is the kernel's SocketCAN, not a driver of python-can's own."""
        return self.interface == "socketcan"


def check_kernel(host: Host) -> Finding:
    """Fail if the kernel gives out no raw CAN socket; skipped for an interface other than SocketCAN."""
    if not host.is_socketcan:
        return skipped(f"interface {host.interface} does not use the kernel's CAN")
    return look_for_socketcan()


def look_for_socketcan() -> Finding:
    """Open and close a raw CAN socket; fail if the kernel has no SocketCAN or refuses."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        if error.errno == errno.EAFNOSUPPORT:
            return failed(
                "this kernel has no SocketCAN", "modprobe can-raw; for a trial, tools/with-vcan brings its own"
            )
        return failed(f"no raw CAN socket: {error.strerror}", "modprobe can-raw, or allow raw sockets (CAP_NET_RAW)")
    return ok("SocketCAN, raw sockets allowed")


def check_interface(host: Host) -> Finding:
    """Fail if the CAN interface doesn't exist or is down; skipped for an interface other than SocketCAN."""
    if not host.is_socketcan:
        return skipped(f"interface {host.interface} is python-can's own")
    name, link = host.channel, host.link
    if link is None:
        present = ", ".join(can_interfaces()) or "none"
        return failed(f"{name} is no CAN interface; present: {present}", "plug the adapter in, or name another with -c")
    if not link.is_up:
        return failed(f"{name} is down", f"ip link set {name} up type can bitrate {host.bitrate}")
    if link.is_virtual:
        return ok(f"{name} is up, {link.kind}: virtual, without bit rate and arbitration")
    return ok(f"{name} is up, hardware" + (f" ({link.kind})" if link.kind else ""))


def _with_hardware(check: Callable[[Host, InterfaceState], Finding]) -> Callable[[Host], Finding]:
    """Return a check of a `Host` that calls `check` with its interface's state.

    It is skipped without a SocketCAN interface, or on a virtual one.
    """

    def run(host: Host) -> Finding:
        if host.link is None:
            return skipped("no SocketCAN interface")
        if host.link.is_virtual:
            return skipped(f"{host.link.kind} has none")
        return check(host, host.link)

    return run


def check_bitrate(host: Host, link: InterfaceState) -> Finding:
    """Fail if the interface's bit rate, or with CAN FD its data bit rate, isn't the contract's.

    The check is skipped if the kernel doesn't report it.
    """
    if link.bitrate is None:
        return skipped("the kernel does not report it here; install iproute2")
    remedy = f"ip link set {link.name} down; ip link set {link.name} up type can bitrate {host.bitrate}"
    if host.data_bitrate:
        remedy += f" dbitrate {host.data_bitrate} fd on"
    if link.bitrate != host.bitrate:
        return failed(f"{link.bitrate} bit/s, the contract has {host.bitrate}", remedy)
    if host.data_bitrate and link.data_bitrate != host.data_bitrate:
        return failed(f"data phase {link.data_bitrate or 0} bit/s, the contract has {host.data_bitrate}", remedy)
    return ok(f"{link.bitrate} bit/s" + (f", data phase {link.data_bitrate}" if host.data_bitrate else ""))


def check_sample_point(_host: Host, link: InterfaceState) -> Finding:
    """Warn of a sample point outside `_SAMPLE_POINT`, which may not suit the devices; skipped if it is unknown."""
    if link.sample_point is None:
        return skipped("the kernel does not report it here; install iproute2")
    text = f"{100.0 * link.sample_point:.1f} %"
    low, high = _SAMPLE_POINT
    if not low <= link.sample_point <= high:
        return warning(f"{text} is outside {low:.0%} to {high:.0%}", "add `sample-point 0.875` to `ip link set`")
    return ok(text)


def check_restart(_host: Host, link: InterfaceState) -> Finding:
    """Warn if the interface doesn't restart by itself after bus-off; skipped if the kernel doesn't report it."""
    if link.restart_ms is None:
        return skipped("the kernel does not report it here; install iproute2")
    if link.restart_ms == 0:
        return warning(
            "off: after bus-off the interface stays silent",
            f"`ip link set {link.name} type can restart-ms 100`, or restart it by hand when that happens",
        )
    return ok(f"{link.restart_ms} ms after bus-off")


def check_controller(_host: Host, link: InterfaceState) -> Finding:
    """Fail if the CAN controller is in bus-off, warn if it isn't error-active; skipped if its state is unknown."""
    if link.state is None:
        return skipped("the kernel does not report it here; install iproute2")
    counters = f"{link.state}, error counters rx {link.rx_errors or 0}, tx {link.tx_errors or 0}"
    if link.state == "BUS-OFF":
        return failed(counters, f"find the cause, then `ip link set {link.name} type can restart`")
    if link.state != "ERROR-ACTIVE":
        return warning(counters, "check wiring, termination (60 ohm between CAN_H and CAN_L) and bit rate")
    return ok(counters)


def check_queue(host: Host) -> Finding:
    """Warn if the transmit queue has room for `LONG_QUEUE_FRAMES` or more.

    After a dead bus these would be outdated commands. The frames that wait are not counted. An interface without a
    queue passes. The check is skipped without a SocketCAN interface.
    """
    if host.link is None:
        return skipped("no SocketCAN interface")
    length, name = host.link.txqueuelen, host.link.name
    if host.link.qdisc == "noqueue":
        return ok(f"no queue (qdisc noqueue; txqueuelen {length})")
    if length >= LONG_QUEUE_FRAMES:
        return warning(
            f"txqueuelen {length}: when the bus dies, up to {length} old commands wait for it to come back",
            f"ip link set {name} txqueuelen {QUEUE_FRAMES}",
        )
    return ok(f"txqueuelen {length}")


def check_mtu(host: Host) -> Finding:
    """Fail if the contract has CAN FD and the interface's MTU is too small for it; skipped without SocketCAN."""
    if host.link is None:
        return skipped("no SocketCAN interface")
    if not host.data_bitrate:
        return ok(f"{host.link.mtu}, classic frames fit")
    if host.link.mtu < CANFD_MTU:
        return failed(f"{host.link.mtu}: no CAN FD frames", f"ip link set {host.link.name} mtu {CANFD_MTU}, or `fd on`")
    return ok(f"{host.link.mtu}, CAN FD frames fit")


def check_permissions(host: Host) -> Finding:
    """Warn if this process lacks CAP_NET_ADMIN, with which it empties the interface's queue after a fault.

    The check is skipped for an interface other than SocketCAN, or if /proc doesn't tell.
    """
    if not host.is_socketcan:
        return skipped(f"interface {host.interface} has no queue in the kernel")
    try:
        status = (host.root / "proc/self/status").read_text()
        effective = int(next(line for line in status.splitlines() if line.startswith("CapEff:")).split()[1], 16)
    except (OSError, StopIteration, ValueError):
        return skipped("/proc does not report it")
    if not effective >> _CAP_NET_ADMIN & 1:
        return warning(
            "without CAP_NET_ADMIN: the interface's queue can't be emptied after a fault",
            "run as root, or with ambient CAP_NET_ADMIN (capsh, systemd AmbientCapabilities)",
        )
    return ok("CAP_NET_ADMIN: the interface's queue can be emptied")


def request_scheduler(host: Host) -> Finding:
    """Request scheduler, processor, locked memory and shallow idle states for this process; warn of those refused."""
    grant = host.request_realtime()
    if grant.missing:
        reasons, remedies = zip(*grant.missing, strict=True)
        return warning(f"not granted: {', '.join(reasons)}", "; ".join(remedies))
    return ok(", ".join(f"{name.replace('_', ' ')} {value}" for name, value in grant.describe().items()))


def check_throttling(host: Host) -> Finding:
    """Warn if the kernel lets real-time processes work for less than `_RT_SHARE` of the time; skipped if unknown.

    It passes if the kernel doesn't limit them.
    """
    folder = host.root / "proc/sys/kernel"
    try:
        runtime_us = int(_read(folder / "sched_rt_runtime_us"))
        period_us = int(_read(folder / "sched_rt_period_us"))
    except ValueError:
        return skipped("/proc does not report it")
    if runtime_us < 0:
        return ok("off: a real-time process that never sleeps keeps its processor")
    share = runtime_us / period_us
    text = f"real-time processes may work for {share:.0%} of {period_us / 1000:.0f} ms"
    if share < _RT_SHARE:
        return warning(text, "sysctl -w kernel.sched_rt_runtime_us=950000")
    return ok(text)


def check_preemption(host: Host) -> Finding:
    """Warn if the kernel isn't PREEMPT_RT, which wakes real-time processes without delay."""
    version = _read(host.root / "proc/version")
    if _read(host.root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return ok("PREEMPT_RT")
    kind = "PREEMPT" if "PREEMPT" in version else "no preemption named"
    return warning(f"{kind}: single cycles can be late by milliseconds", "install a PREEMPT_RT kernel (linux-image-rt)")


def check_processor(host: Host) -> Finding:
    """Warn if a processor's frequency governor isn't `performance`; skipped without frequency scaling."""
    folder = host.root / "sys/devices/system/cpu"
    governors = sorted({_read(path) for path in folder.glob("cpu[0-9]*/cpufreq/scaling_governor")})
    if not governors:
        return skipped("no frequency scaling to look at")
    text = f"governor {', '.join(governors)}"
    if governors != ["performance"]:
        return warning(text, "cpupower frequency-set -g performance")
    return ok(text)


def check_isolation(host: Host) -> Finding:
    """Warn if the processor that `realtime.cpu` names isn't isolated, or if it names none and there are isolated ones.

    Also warn if it asks for any isolated one, and there is none. It passes if `realtime.cpu` names none and none is
    isolated.
    """
    isolated = isolated_cpus(host.root / "sys/devices/system/cpu")
    names = ", ".join(map(str, isolated)) or "none"
    isolate = "isolcpus={0} nohz_full={0} rcu_nocbs={0} on the kernel's command line, and no interrupts there"
    if host.cpu == ANY_CPU and isolated:
        return warning(f"isolated processors: {names}, not used", 'set `realtime.cpu = "isolated"`')
    if host.cpu == ANY_CPU:
        return ok("not asked for (`realtime.cpu`); isolated processors: none")
    if host.cpu == ISOLATED_CPU and not isolated:
        return warning("isolated processors: none", isolate.format("N"))
    if host.cpu != ISOLATED_CPU and int(host.cpu) not in isolated:
        return warning(f"processor {host.cpu} is shared with other work", isolate.format(host.cpu))
    return ok(f"isolated processors: {names}; `realtime.cpu` = {host.cpu}")


def _read(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""


HOST_CHECKS: tuple[Check[Host], ...] = (
    Check("kernel", check_kernel),
    Check("interface", check_interface, ("kernel",)),
    Check("bit rate", _with_hardware(check_bitrate), ("interface",)),
    Check("sample point", _with_hardware(check_sample_point), ("interface",)),
    Check("restart", _with_hardware(check_restart), ("interface",)),
    Check("controller", _with_hardware(check_controller), ("interface",)),
    Check("queue", check_queue, ("interface",)),
    Check("mtu", check_mtu, ("interface",)),
    Check("permissions", check_permissions),
    Check("scheduler", request_scheduler),
    Check("throttling", check_throttling),
    Check("preemption", check_preemption),
    Check("processor", check_processor),
    Check("isolation", check_isolation),
)
