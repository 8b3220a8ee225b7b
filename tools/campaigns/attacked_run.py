"""Plays an attack in virtual time: host in real-time mode, devices by the clock, the attacker on the same wire.

The bus has no length of its own: what somebody sends, all others hear at once, in the order host, attacker's answers
that come ahead, devices, attacker's other answers. Time goes on where the host waits. So "noticed after" and "at rest
after" are of the host's rules and not of this machine.
"""

import dataclasses
import heapq
import re
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from attacks import MS, Attack, AttackCase, Forged, Forger
from numpy.typing import NDArray

from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.control.session import Session, SessionSummary
from adacd_hil.device.contract import load_contract
from adacd_hil.device.device_files import place_devices
from adacd_hil.log.reader import LoggedEvent, RunLog, read_log
from adacd_hil.log.types.topics import EVENTS, SCHEME
from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.records import SchemeState
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.run_settings import OperatorSettings, RequestSettings, SafetySettings
from adacd_hil.wire.bus import Bus, Frame
from firmware_sim.bench.bench import Bench
from firmware_sim.scenario.scenario import Scenario

ATTACK_S = 4.29
"""When an attack begins, since the drives were enabled: both joints move, joint 1 at its fastest, 100 deg/s."""
AFTER_S = 1.5
"""How long the arm is watched after the host has gone; the attack goes on until its own end."""
REST_RAD_S = SafetySettings().rest_velocity_rad_s
REST_HOLD_S = 0.1
"""At rest is an arm that is this slow for so long: the speed is the setting's default."""
STOPS = (SchemeState.FAULT, SchemeState.REACT)
REST_BOUND_S = 0.12
"""At rest so soon after it was noticed: from 100 deg/s, the fastest the arm moves, at 900 deg/s² it takes 0.11 s."""


class WatchedBench(Bench):
    """The emulated arm, with a look at its body between two SYNCs."""

    def look(self) -> NDArray[np.float64]:
        """Return what is true now, by TRUTH_LAYOUT."""
        block = np.zeros(TRUTH_LAYOUT.size)
        self._body.truth(block)
        return block


class VirtualClock:
    """Moves when told, and lets `world` live through the time; not a clock of lockstep."""

    def __init__(self) -> None:
        self._t_ns = 0
        self.world: Callable[[int, int], None] = lambda _from_ns, _to_ns: None

    def now_ns(self) -> int:
        """Return the time reached so far, ns."""
        return self._t_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Move to `t_ns`; never backwards."""
        if t_ns > self._t_ns:
            self.world(self._t_ns, t_ns)
            self._t_ns = t_ns

    def move(self, t_ns: int) -> None:
        """Set the time from within `world`."""
        self._t_ns = max(self._t_ns, t_ns)


class Wire(Bus):
    """The host's end of the bus, with devices and attacker on it."""

    def __init__(self, clock: VirtualClock) -> None:
        self.channel = "virtual"
        self._clock = clock
        self._received: deque[Frame] = deque()
        self.bench: WatchedBench | None = None
        self.attack: Attack | None = None
        self.begin_ns: int | None = None
        """When the attack begins; None: not yet known."""
        self.end_ns = 1 << 62
        self._tick_ns = 0
        self._held: list[tuple[int, int, Forged]] = []
        self._order = 0
        self.forged = 0
        self.first_ns: int | None = None
        """When the first frame was forged."""
        self.looks: list[tuple[int, NDArray[np.float64]]] = []
        self._is_open = True
        clock.world = self._live

    # The host's end

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame of the host to everybody."""
        answers = self._hear(can_id, data)
        for forged in answers:
            if forged.is_ahead:
                self._forge(forged)
        self._to_devices(can_id, data)
        for forged in answers:
            if not forged.is_ahead:
                self._forge(forged)

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, waiting for it in virtual time."""
        limit_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while not self._received:
            now_ns = self._clock.now_ns()
            if now_ns >= limit_ns:
                return None
            self._clock.sleep_until_ns(min(limit_ns, now_ns + 50_000))
        return self._received.popleft()

    def recover(self) -> None:
        """Drop what the host has not read."""
        self._received.clear()

    def close(self) -> None:
        """Take the host off the bus; the others stay."""
        self._is_open = False

    # The others

    def deliver(self, can_id: int, data: bytes) -> None:
        """Send a frame of a device to everybody."""
        self._to_host(can_id, data)
        for forged in self._hear(can_id, data):
            self._forge(forged)

    def _hear(self, can_id: int, data: bytes) -> list[Forged]:
        since_ns = self._since_begin_ns()
        return [] if self.attack is None or since_ns is None else self.attack.hears(can_id, data, since_ns)

    def _since_begin_ns(self) -> int | None:
        now_ns = self._clock.now_ns()
        if self.begin_ns is None or not self.begin_ns <= now_ns < self.end_ns:
            return None
        return now_ns - self.begin_ns

    def _forge(self, forged: Forged) -> None:
        if forged.after_ns:
            self._order += 1
            heapq.heappush(self._held, (self._clock.now_ns() + forged.after_ns, self._order, forged))
            return
        self.forged += 1
        if self.first_ns is None:
            self.first_ns = self._clock.now_ns()
        self._to_host(forged.can_id, forged.data)
        self._to_devices(forged.can_id, forged.data)

    def _to_host(self, can_id: int, data: bytes) -> None:
        if self._is_open:
            self._received.append(Frame(can_id, data, self._clock.now_ns()))

    def _to_devices(self, can_id: int, data: bytes) -> None:
        if self.bench is not None:
            self.bench.on_frame(Frame(can_id, data, self._clock.now_ns()))

    def _live(self, _from_ns: int, to_ns: int) -> None:
        """Let devices and attacker live until `to_ns`, in steps of at most a millisecond."""
        while (now_ns := self._clock.now_ns()) < to_ns:
            next_ns = min(to_ns, (now_ns // MS + 1) * MS)
            if self._held:
                next_ns = min(next_ns, max(self._held[0][0], now_ns))
            attack, since_ns = self.attack, self._since_begin_ns()
            if attack is not None and attack.every_ns and since_ns is not None and self.begin_ns is not None:
                self._tick_ns = max(self._tick_ns, self.begin_ns)
                next_ns = min(next_ns, max(self._tick_ns, now_ns))
            self._clock.move(next_ns)
            if self.bench is not None:
                self.bench.advance_to(next_ns)
            while self._held and self._held[0][0] <= next_ns:
                self._forge(heapq.heappop(self._held)[2]._replace(after_ns=0))
            self._tick(next_ns)
            if next_ns % MS == 0 and self.bench is not None:
                self.looks.append((next_ns, self.bench.look()))

    def _tick(self, now_ns: int) -> None:
        attack, since_ns = self.attack, self._since_begin_ns()
        if attack is None or not attack.every_ns or since_ns is None or now_ns < self._tick_ns:
            return
        self._tick_ns = now_ns + attack.every_ns
        for forged in attack.tick(since_ns):
            self._forge(forged)


@dataclass
class Finding:
    """What came of an attack. Times in ms, from the first forged frame on; None: never. Angles in deg.

    noticed_by: the first line of the log, or of stderr, that says that something is wrong. rest_after_notice_ms: None
    where it was not noticed, or never came to rest. travelled_deg: path of the joint that went furthest from the first
    forged frame to rest. drives: where the CiA 402 state machines ended.
    """

    name: str
    about: str
    forged: int
    noticed_ms: float | None
    noticed_by: str
    is_named: bool
    stopped_ms: float | None
    rest_ms: float | None
    rest_after_notice_ms: float | None
    travelled_deg: float
    fastest_deg_s: float
    furthest_deg: float
    end: str
    verdict: str


def settings_of(lasts_s: float) -> Settings:
    """Return the host of an attack: certified, profile P, real time without a request to the scheduler."""
    settings = load_settings("certified", "P")
    return dataclasses.replace(
        settings,
        operator=OperatorSettings(script=(RequestSettings(at_s=round(ATTACK_S + lasts_s + 0.2, 3), request="finish"),)),
        realtime=dataclasses.replace(settings.realtime, scheduler="other", lock_memory=False, spin_us=0.0),
        log=dataclasses.replace(settings.log, buffer_MiB=64),
    )


def scenario_of(case: AttackCase) -> Scenario:
    """Return the arm of an attack, from the start corner, with the faults that the attack makes use of."""
    faults = [row | {"at_s": round(ATTACK_S + row["at_s"], 4)} for row in case.faults]
    return parse(Scenario, {"name": case.name, "profile": "P", "start_deg": [-30.0, -60.0], "faults": faults})


def play_attack(case: AttackCase | None, folder: Path) -> tuple[Finding, RunLog]:
    """Play one attack, or the same run without any."""
    folder.mkdir(parents=True, exist_ok=True)
    lasts_s = 1.5 if case is None else case.lasts_s
    settings = settings_of(lasts_s)
    devices = place_devices(settings)
    codec = load_contract(settings, devices)
    clock = VirtualClock()
    wire = Wire(clock)
    scenario = parse(Scenario, {"profile": "P", "start_deg": [-30.0, -60.0]}) if case is None else scenario_of(case)
    bench = wire.bench = WatchedBench(scenario, codec, wire.deliver, clock_mode="wall")
    if case is not None:
        wire.attack = case.make(Forger(codec.text))
    bench.boot()

    def on_progress(line: str) -> None:
        if "ENABLE -> ADAPT" in line and wire.begin_ns is None:
            wire.begin_ns = clock.now_ns() + round(ATTACK_S * 1e9)
            wire.end_ns = wire.begin_ns + round(lasts_s * 1e9)

    operator = ScriptedOperator(settings.operator)
    session = Session(settings, codec, devices, wire, clock, operator, folder, "embedded", progress=on_progress)
    summary = session.run()
    wire.close()
    clock.sleep_until_ns(clock.now_ns() + round(AFTER_S * 1e9))
    log = read_log(summary.log.path, (SCHEME.name, EVENTS.name))
    return judge(case, wire, bench, log, summary), log


def judge(case: AttackCase | None, wire: Wire, bench: Bench, log: RunLog, summary: SessionSummary) -> Finding:
    """Say what came of an attack in virtual time."""
    begin_ns = wire.begin_ns or 0
    if case is not None and not case.faults and wire.first_ns is not None:
        begin_ns = wire.first_ns  # where a fault is part of the attack, it is what begins
    times_ns = np.array([t_ns for t_ns, _ in wire.looks], np.int64)
    blocks = np.array([block for _, block in wire.looks])
    noticed_ns, line = first_notice(log.events, begin_ns, () if case is None else expected_lines(case))
    stops_ns = log.scheme.t_ns[np.isin(log.scheme["state"], STOPS)]
    result = summary.result
    end = summary.error or ("" if result is None else f"{result.state.name} {result.fault.name}")
    states = ", ".join(drive.state.value for drive in bench.drives)
    return finding(
        case, wire.forged, begin_ns, noticed_ns, line, times_ns, blocks, stops_ns, f"{end}; drives: {states}"
    )


def expected_lines(case: AttackCase) -> tuple[str, ...]:
    """Return what the log says anyway: of a fault that the attack only makes use of."""
    return ("0x2310", "-> FAULT: DRIVE") if case.name == "enable-after-fault" else ()


def first_notice(events: Sequence[LoggedEvent], begin_ns: int, ignored: tuple[str, ...]) -> tuple[int | None, str]:
    """Return when the log first says that something is wrong, and how; with a line that names more, if one is near."""
    found = [
        (entry.t_ns, f"{entry.event.name}: {entry.event.message}")
        for entry in events
        if entry.t_ns >= begin_ns
        and (entry.event.level in ("warning", "error") or "-> REACT" in entry.event.message)
        and not any(text in entry.event.message for text in ignored)
    ]
    if not found:
        return None, ""
    first_ns = found[0][0]
    return first_ns, " | ".join(line for t_ns, line in found if t_ns <= first_ns + 20 * MS)


def finding(
    case: AttackCase | None,
    forged: int,
    begin_ns: int,
    noticed_ns: int | None,
    line: str,
    times_ns: NDArray[np.int64],
    blocks: NDArray[np.float64],
    stops_ns: NDArray[np.int64],
    end: str,
) -> Finding:
    """Put together what came of an attack.

    times_ns (n,), blocks (n, TRUTH_LAYOUT.size): the arm's truth over time. stops_ns: when the host stopped the arm.
    """
    q = np.degrees(blocks[:, TRUTH_LAYOUT.slices["q"]])
    dq = np.degrees(blocks[:, TRUTH_LAYOUT.slices["dq"]])
    since = times_ns >= begin_ns
    rest_ns = rest_from(times_ns, np.abs(dq).max(axis=1), noticed_ns if noticed_ns is not None else begin_ns)
    until = since & (times_ns <= rest_ns) if rest_ns is not None else since
    path = np.abs(np.diff(q[until], axis=0)).sum(axis=0).max(initial=0.0)
    stops = stops_ns[stops_ns >= begin_ns]
    after = None if rest_ns is None or noticed_ns is None else (rest_ns - noticed_ns) / MS
    is_named = bool(case is not None and line and re.search(case.named_by, line, re.IGNORECASE))
    found = Finding(
        name="nothing" if case is None else case.name,
        about="nobody attacks" if case is None else case.about,
        forged=forged,
        noticed_ms=None if noticed_ns is None else (noticed_ns - begin_ns) / MS,
        noticed_by=line,
        is_named=is_named,
        stopped_ms=float(stops[0] - begin_ns) / MS if len(stops) else None,
        rest_ms=None if rest_ns is None else (rest_ns - begin_ns) / MS,
        rest_after_notice_ms=after,
        travelled_deg=round(float(path), 2),
        fastest_deg_s=round(float(np.abs(dq[since]).max(initial=0.0)), 1),
        furthest_deg=round(float(np.abs(q[since]).max(initial=0.0)), 1),
        end=end,
        verdict="",
    )
    found.verdict = verdict(case, found)
    return found


def rest_from(times_ns: NDArray[np.int64], speed_deg_s: NDArray[np.float64], begin_ns: int) -> int | None:
    """Return from when on the arm stands still for REST_HOLD_S or to the end, not before `begin_ns`; None: never.

    The truth of an arm whose host has died ends with the arm at rest.
    """
    is_still = (speed_deg_s < np.degrees(REST_RAD_S)) & (times_ns >= begin_ns)
    still_since: int | None = None
    for t_ns, still in zip(times_ns.tolist(), is_still.tolist(), strict=True):
        if not still:
            still_since = None
        elif still_since is None:
            still_since = t_ns
        elif t_ns - still_since >= REST_HOLD_S * 1e9:
            return still_since
    return still_since


def verdict(case: AttackCase | None, found: Finding) -> str:
    """Say in a word whether it is as it must be: ok, UNNOTICED, NOT NAMED, NOT AT REST."""
    if case is None:
        return "ok" if found.noticed_ms is None else "FALSE ALARM"
    if found.noticed_ms is None or found.noticed_ms > case.lasts_s * 1e3:
        return "ok, no effect" if case.is_harmless and found.stopped_ms is None else "UNNOTICED"
    late = found.rest_after_notice_ms is None or found.rest_after_notice_ms > REST_BOUND_S * 1e3
    is_stopped = (case.must_stop or found.stopped_ms is not None) and not case.may_move
    problems = [
        word for word, holds in (("NOT AT REST", late and is_stopped), ("NOT NAMED", not found.is_named)) if holds
    ]
    return ", ".join(problems) or "ok"
