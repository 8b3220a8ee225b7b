"""A run drawn from a seed: arm, scheme, contract, host, touches, faults, and the user's requests.

The same seed draws the same run. Most faults begin after detection is armed, so that most runs get there.
"""

import dataclasses
import math
import random
from dataclasses import dataclass
from functools import cache
from typing import Any

from witnessed_run import User

from adacd_hil.records import QUINTIC_PEAK_SPEED, Request
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_text import to_toml
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.dbc_contract import load_codec
from firmware_sim.arm.touch_settings import BODY_REGIONS
from firmware_sim.bench.fault_plan import FaultPlan
from firmware_sim.canopen.object_dictionary import CONTRACTS as DBCS
from firmware_sim.scenario.faults import FRAME_NODES, KINDS, SIGNAL_NODES, FaultSettings
from firmware_sim.scenario.scenario import Scenario

CONTRACTS = ("arm", "arm_fd", "arm_stock")
CONFIGURATION = {"arm_fd": "fd", "arm_stock": "stock", "arm_fd_500us": "fd_500us"}
"""The built-in configuration whose devices speak a contract."""
CERTIFIED_S = 2.3
PAPER_S = {
    ("P", True): 2.5,
    ("S", True): 2.5,
    ("M", True): 4.6,
    ("P", False): 5.3,
    ("S", False): 5.4,
    ("M", False): 7.1,
}
"""When detection is armed after the approach, measured without faults: certified; the paper's by profile, with the
quick settings or with its own."""
QUICK_HOLD_S = 1.5
QUICK_HALF_PERIOD_S = (1.125, 2.25)
WEIGHTS = {
    "lose": 6, "delay": 8, "reorder": 3, "duplicate": 3, "corrupt": 5, "freeze_counter": 3, "stick": 2, "jump": 3,
    "saturate": 2, "reboot": 2, "emcy_storm": 2, "babble": 3, "bus_off": 2, "late_sync": 3, "clock_drift": 2,
    "power_loss": 2, "silence": 2, "drive_fault": 4, "sensor_error": 2,
}  # fmt: skip
"""How often each kind is drawn. Wrong and double node ids end a run at its boot; they have a share of their own."""
ATTEMPTS = 50


@dataclass(frozen=True)
class Drawn:
    """One run to play. armed_s: when detection should be armed, since the drives were enabled."""

    seed: int
    contract: str
    settings: Settings
    scenario: Scenario
    user: User
    armed_s: float
    finish_s: float

    @property
    def line(self) -> str:
        """The run in one line."""
        faults = "; ".join(row.timed_text for row in self.scenario.faults) or "no fault"
        settings = self.settings
        return (
            f"{settings.scheme} {self.contract} {settings.arm.profile} {settings.bus.period_us} us"
            f"{' pipelined' if settings.bus.is_pipelined else ''}, finish {self.finish_s:.2f} s, {faults}"
        )

    @property
    def files(self) -> dict[str, str]:
        """Settings and scenario as TOML, by file name."""
        return {"settings.toml": to_toml(self.settings), "scenario.toml": to_toml(self.scenario)}


def draw_run(seed: int) -> Drawn:
    """Draw a run."""
    draws = random.Random(seed)
    contract = draws.choice(CONTRACTS) if draws.random() < 0.95 else "arm_fd_500us"
    scheme = "certified" if draws.random() < 0.75 else "paper"
    profile = draws.choice("PPSM")
    settings = _draw_host(draws, scheme, profile, contract)
    start_deg = _draw_start(draws, settings)
    approach_s = _approach_s(settings, start_deg)
    is_quick = settings.termination.hold_s == QUICK_HOLD_S
    armed_s = approach_s + (PAPER_S[profile, is_quick] if scheme == "paper" else CERTIFIED_S)
    finish_s = round(armed_s + draws.uniform(1.0, 5.0), 3)
    script = [{"at_s": finish_s, "request": "finish"}]
    payloads = []
    if draws.random() < 0.2:
        begin_s = round(draws.uniform(armed_s, finish_s), 3)
        script += [
            {"at_s": begin_s, "request": "payload"},
            {"at_s": round(begin_s + draws.uniform(1.5, 3.0), 3), "request": "payload_changed"},
        ]
        payloads = [{"at_s": round(begin_s + draws.uniform(0.2, 2.0), 3), "mass_kg": round(draws.uniform(0.1, 2.0), 2)}]
    operator = {
        "script": script,
        "acknowledge_after_s": draws.choice((0.0, 0.3, 0.6, 1.0)),
        "acknowledge_faults": draws.choice((0, 0, 0, 1, 1, 2)),
        "acknowledge_fault_after_s": round(draws.uniform(0.0, 1.0), 3),
    }
    settings = dataclasses.replace(settings, operator=parse(type(settings.operator), operator))
    touches = _draw_touches(draws, settings, armed_s, finish_s)
    table = {
        "name": f"seed-{seed}",
        "profile": profile,
        "seed": seed,
        "noise": draws.random() < 0.9,
        "start_deg": start_deg,
        "payloads": payloads,
    }
    faults = _draw_faults(draws, _codec(contract), seed, armed_s, finish_s)
    scenario = _build(table | {"faults": faults}, touches)
    return Drawn(seed, contract, settings, scenario, _draw_user(draws, armed_s, finish_s), armed_s, finish_s)


def _build(table: dict[str, Any], touches: dict[str, list[dict[str, Any]]]) -> Scenario:
    """Make the scenario, without what can't be where it was drawn, such as a body that the arm stands in."""
    kept: dict[str, list[dict[str, Any]]] = {}
    for key, rows in touches.items():
        for row in rows:
            try:
                parse(Scenario, table | kept | {key: [*kept.get(key, []), row]})
            except ConfigError:
                continue
            kept[key] = [*kept.get(key, []), row]
    return parse(Scenario, table | kept)


def _draw_host(draws: random.Random, scheme: str, profile: str, contract: str) -> Settings:
    """Draw what the host is and how it is on time."""
    settings = load_settings(scheme, profile)
    bus: dict[str, Any] = {}
    if contract in CONFIGURATION:
        other = load_settings(CONFIGURATION[contract], profile)
        settings = dataclasses.replace(settings, devices=other.devices)
        bus["period_us"] = other.bus.period_us
    if contract != "arm_fd_500us" and draws.random() < 0.15:
        bus["period_us"] = draws.choice((2000, 2000, 2000, 2000, 2000, 5000))
    if draws.random() < 0.1:
        bus["schedule"] = "pipelined"
    if draws.random() < 0.1:
        bus["max_age_cycles"] = draws.randint(1, 10)
    changes: dict[str, Any] = {"bus": dataclasses.replace(settings.bus, **bus)}
    changes["lockstep"] = parse(type(settings.lockstep), _draw_lockstep(draws))
    if draws.random() < 0.3:
        changes["realtime"] = dataclasses.replace(settings.realtime, on_misses="hold")
    if draws.random() < 0.3:
        names = ("stop", "withdraw", "float", "admittance")
        pairs = {key: (draws.choice(names), draws.choice(names)) for key in ("contact", "collision")}
        changes["reaction"] = dataclasses.replace(settings.reaction, **pairs)
    if scheme == "paper" and draws.random() < 0.8:
        changes |= quick_paper(settings)
    return dataclasses.replace(settings, **changes)


def quick_paper(settings: Settings) -> dict[str, Any]:
    """Return sections with which the paper's scheme is armed sooner: a shorter hold, and joint 2 twice as fast."""
    return {
        "termination": dataclasses.replace(settings.termination, hold_s=QUICK_HOLD_S),
        "trajectory": dataclasses.replace(settings.trajectory, half_period_s=QUICK_HALF_PERIOD_S),
    }


def _draw_lockstep(draws: random.Random) -> dict[str, Any]:
    """Draw the modelled time of the host: mostly on time."""
    table: dict[str, Any] = {
        "seed": draws.randrange(1 << 30),
        "stuffing": draws.choice(("exact", "worst")),
        "queue": draws.choice(("identifier", "identifier", "fifo")),
    }
    latency = draws.choice(("constant", "constant", "uniform", "lognormal"))
    low_us = round(draws.uniform(20.0, 120.0))
    table |= {"latency": latency, "latency_us": low_us, "latency_high_us": low_us + round(draws.uniform(10.0, 250.0))}
    if draws.random() < 0.25:
        table |= {"stall_us": round(draws.uniform(200.0, 8000.0)), "stall_every_s": round(draws.uniform(0.5, 5.0), 2)}
    return table


def _draw_start(draws: random.Random, settings: Settings) -> list[float]:
    """Draw where the arm stands at power-on: mostly in the start corner of its motion."""
    corner = [-value for value in settings.trajectory.amplitude_deg]
    if draws.random() < 0.7:
        return corner
    return [round(draws.uniform(-60.0, 60.0), 1), round(draws.uniform(-100.0, 100.0), 1)]


def _approach_s(settings: Settings, start_deg: list[float]) -> float:
    """Estimate how long the arm takes to the start corner: a quintic with the approach's peak speed."""
    way_deg = max(abs(a + b) for a, b in zip(start_deg, settings.trajectory.amplitude_deg, strict=True))
    return QUINTIC_PEAK_SPEED * way_deg / settings.trajectory.approach_deg_s


def _draw_touches(
    draws: random.Random, settings: Settings, armed_s: float, finish_s: float
) -> dict[str, list[dict[str, Any]]]:
    """Draw contacts, a hand, a body and a wall; most contacts come when detection is armed."""
    contacts = []
    begin_s = armed_s + 0.4 if draws.random() < 0.85 else draws.uniform(0.2, armed_s)
    for _ in range(draws.choice((0, 1, 1, 2, 3))):
        begin_s += draws.uniform(0.0, 1.2)
        duration_s = round(draws.choice((draws.uniform(0.02, 0.15), draws.uniform(0.2, 0.8))), 3)
        link = draws.choice((1, 2))
        row = {
            "at_s": round(begin_s, 3),
            "link": link,
            "point_m": round(draws.uniform(0.05, settings.arm.link_length_m[link - 1]), 3),
            "force_N": round(10.0 ** draws.uniform(0.3, 1.6), 2),
            "duration_s": duration_s,
            "angle_deg": draws.choice((90.0, -90.0, round(draws.uniform(-180.0, 180.0), 1))),
            "shape": draws.choice(("step", "half_sine", "push")),
        }
        contacts.append(row)
        begin_s += duration_s + 0.05
    touches: dict[str, list[dict[str, Any]]] = {"contacts": contacts}
    if draws.random() < 0.1:
        touches["hands"] = [
            {
                "at_s": round(draws.uniform(armed_s, finish_s), 3),
                "duration_s": round(draws.uniform(0.2, 2.0), 2),
                "link": 2,
                "point_m": 0.25,
                "direction_deg": round(draws.uniform(-180.0, 180.0), 1),
                "speed_m_s": round(draws.uniform(0.02, 0.3), 3),
            }
        ]
    if draws.random() < 0.1:
        q1, q2 = (math.radians(draws.uniform(-value, value)) for value in settings.trajectory.amplitude_deg)
        length1_m, length2_m = settings.arm.link_length_m
        lever_m = draws.uniform(0.3, 0.95) * length2_m
        touches["bodies"] = [
            {
                "at_s": round(draws.uniform(armed_s, finish_s), 3),
                "duration_s": round(draws.uniform(0.3, 2.0), 2),
                "link": 2,
                "x_m": round(length1_m * math.cos(q1) + lever_m * math.cos(q1 + q2), 4),
                "y_m": round(length1_m * math.sin(q1) + lever_m * math.sin(q1 + q2), 4),
                "region": draws.choice(tuple(BODY_REGIONS)),
                "radius_m": 0.01,
                "clamped": draws.random() < 0.5,
            }
        ]
    if draws.random() < 0.05:
        reach_m = sum(settings.arm.link_length_m)
        touches["walls"] = [
            {
                "at_s": round(armed_s, 3),
                "x_m": round(draws.uniform(0.6, 1.0) * reach_m, 3),
                "y_m": 0.0,
                "normal_deg": 180.0,
            }
        ]
    return touches


def _draw_user(draws: random.Random, armed_s: float, finish_s: float) -> User:
    """Draw what the user says at the wrong time, and when Ctrl-C is pressed."""
    words: list[tuple[float, Request]] = []
    if draws.random() < 0.2:
        choices = (Request.ACKNOWLEDGE, Request.PAYLOAD, Request.PAYLOAD_CHANGED, Request.ACKNOWLEDGE)
        words = [(round(draws.uniform(0.0, finish_s + 1.0), 3), draws.choice(choices)) for _ in range(4)]
    interrupts: list[float] = []
    if draws.random() < 0.1:
        interrupts.append(round(draws.uniform(armed_s if draws.random() < 0.8 else 0.0, finish_s), 3))
        if draws.random() < 0.5:
            interrupts.append(interrupts[0] + round(draws.uniform(0.0, 1.0), 3))
    return User(tuple(sorted(words)), tuple(interrupts))


@cache
def _codec(contract: str) -> Codec:
    return load_codec(DBCS[contract].path)


def _draw_faults(
    draws: random.Random, codec: Codec, seed: int, armed_s: float, finish_s: float
) -> list[dict[str, Any]]:
    """Draw faults that this contract can have."""
    rows: list[dict[str, Any]] = []
    if draws.random() < 0.01:
        kind = draws.choice(("wrong_node_id", "duplicate_node_id"))
        node = draws.choice(("drive1", "drive2", "sensor1", "sensor2"))
        others = [name for name in ("drive1", "drive2", "sensor1", "sensor2") if name != node]
        rows.append({"kind": kind, "node": node})
        rows[-1] |= {"node_id": draws.randint(5, 120)} if kind == "wrong_node_id" else {"same_as": draws.choice(others)}
    for _ in range(draws.choice((0, 1, 1, 1, 2, 2, 3))):
        for _ in range(ATTEMPTS):
            row = _draw_fault(draws, armed_s, finish_s)
            try:
                FaultPlan([parse(FaultSettings, row)], seed, codec)
            except ConfigError:
                continue
            rows.append(row)
            break
    return rows


def _draw_onset(draws: random.Random, armed_s: float, finish_s: float) -> dict[str, Any]:
    chance = draws.random()
    if chance < 0.82:
        return {"at_s": round(draws.uniform(armed_s + 0.1, finish_s), 4)}
    if chance < 0.92:
        return {"at_s": round(draws.uniform(finish_s - 0.2, finish_s + 1.5), 4)}
    if chance < 0.98:
        return {"at_s": round(draws.uniform(0.0, armed_s), 4)}
    return {"at_s": round(draws.uniform(0.0, 1.0), 4), "since": "power_on"}


def _draw_fault(draws: random.Random, armed_s: float, finish_s: float) -> dict[str, Any]:
    """Draw one fault; it may be one that the contract hasn't got."""
    kind = draws.choices(tuple(WEIGHTS), tuple(WEIGHTS.values()))[0]
    rule = KINDS[kind]
    keys = rule.keys
    row: dict[str, Any] = {"kind": kind, **_draw_onset(draws, armed_s, finish_s)}
    nodes = rule.nodes
    if "frame" in keys:
        cyclic = ("feedback", "torque", "command", "status")
        frames = rule.frames
        row["frame"] = draws.choice([name for name in cyclic if name in frames] if draws.random() < 0.8 else frames)
        nodes = FRAME_NODES[row["frame"]]
    if "signal" in keys:
        row["signal"] = draws.choice(tuple(SIGNAL_NODES))
        nodes = SIGNAL_NODES[row["signal"]]
    if "node" in keys:
        row["node"] = draws.choice(nodes)
    if "probability" in keys and draws.random() < 0.5:
        row["probability"] = draws.choice((0.01, 0.1, 0.5, round(draws.uniform(0.01, 1.0), 3)))
    row |= _draw_length(draws, keys)
    row |= _draw_details(draws, kind, keys)
    return row


def _draw_length(draws: random.Random, keys: tuple[str, ...]) -> dict[str, Any]:
    chance = draws.random()
    if "duration_s" in keys and chance < 0.4:
        return {"duration_s": round(draws.uniform(0.001, 0.1), 4)}
    if "duration_s" in keys and chance < 0.7:
        return {"duration_s": round(draws.uniform(0.1, 2.0), 3)}
    if "count" in keys and chance < 0.85:
        return {"count": draws.randint(1, 12)}
    return {}


def _draw_details(draws: random.Random, kind: str, keys: tuple[str, ...]) -> dict[str, Any]:
    """Draw the keys that only some kinds have."""
    row: dict[str, Any] = {}
    if "delay_us" in keys:
        row["delay_us"] = round(draws.uniform(50.0, 1500.0))
    if "jitter_us" in keys and draws.random() < 0.3:
        row["jitter_us"] = round(draws.uniform(0.0, 500.0))
    if "bits" in keys and draws.random() < 0.5:
        row["bits"] = draws.randint(1, 5)
    if kind == "jump":
        row["step"] = round(draws.choice((-1, 1)) * 10.0 ** draws.uniform(-2.5, 1.0), 4)
    if kind == "saturate":
        row["value"] = round(10.0 ** draws.uniform(-2.0, 1.0), 4)
    if "code" in keys:
        row["code"] = draws.choice((0x1000, 0x2310, 0x3210, 0x4310, 0x5441, 0x7305, 0x8130, 0xFF01))
    if "rate_Hz" in keys:
        row["rate_Hz"] = round(10.0 ** draws.uniform(0.5, 3.6), 1)
    if "can_id" in keys:
        ids = (0x001, 0x055, 0x07F, 0x181, 0x183, 0x281, 0x283, 0x701, 0x703, 0x7F0, draws.randrange(0x800))
        row["can_id"] = draws.choice(ids)
        row["data"] = draws.randbytes(draws.randint(1, 8)).hex()
    if kind == "sensor_error" and draws.random() < 0.5:
        row["status"] = draws.randint(1, 7)
    if "drift_ppm" in keys:
        row["drift_ppm"] = round(draws.choice((-1, 1)) * 10.0 ** draws.uniform(1.0, 5.5))
    return row
