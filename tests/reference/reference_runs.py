"""Short runs whose decisions and bits are stored: a change that alters live and replay together is seen.

Each run is two files in `runs/`: NAME.config.toml and NAME.scenario.toml; a run of a known arm has its tare and its
history beside, NAME.tare.toml and NAME.history.toml. What it came to is stored in NAME.json:

- decisions: every transition with its cycle, every final contact report, all that is said of certificates, the fault,
  the model at the end. Compared on every machine, within `CYCLES` cycles and `SHARE` of a value; a text without its
  numbers.
- bits: for each field of /scheme, /control and /contact, and for each identifier on the bus both ways, one digest per
  `BLOCK_CYCLES` cycles. Compared where `arithmetic` is that of the machine on which they were stored: another numpy, or
  a processor without fused multiply-add, may round the last bit differently.

Renew what is stored with `python tests/reference/renew.py`; it prints every difference. A renewal is a commit of its
own with that print in its body.
"""

import hashlib
import itertools
import json
import platform
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import llvmlite.binding
import numpy as np
from experiment_runs import Played, emulator, run_on_vcan
from loaded import loaded_contract
from numpy.typing import NDArray
from rig import SessionRig
from two_arms_rig import TwoArms

from adacd_hil.clock import wall_ns
from adacd_hil.control.history_file import UsedHistory, use_history
from adacd_hil.control.operator import Operator, ScriptedOperator
from adacd_hil.control.session import Session
from adacd_hil.control.tare_file import UsedTare, use_tare
from adacd_hil.device.device_files import place_devices
from adacd_hil.log.reader import RunLog, Series, read_log
from adacd_hil.records import CERTIFICATE_EVENTS, Request, SchemeState
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from firmware_sim.cli.own_devices import describe_devices
from firmware_sim.scenario.scenario import Scenario, load_scenario

RUNS = Path(__file__).parent / "runs"
BLOCK_CYCLES = 250
CYCLES = 2
"""Cycles by which a decision may shift on a machine whose arithmetic is another."""
SHARE = 0.01
"""Share by which a value may differ there."""
_ROUNDING = ("avx2", "fma")
"""Instructions that change how numpy's products and the C library's sines round; Zen 3 and 5 gave equal bits."""
_NUMBER = re.compile(r"\d+\.?\d*")
_TOPICS = ("/scheme", "/control", "/contact")
_DIGEST_BYTES = 4
_PARTS = "\n[log]\npart_min = 0.05\n"


def names() -> list[str]:
    """Name the reference runs."""
    return sorted(path.name.removesuffix(".config.toml") for path in RUNS.glob("*.config.toml"))


def known_arm(name: str) -> tuple[Path, Path]:
    """Give the paths of a run's tare and history, which only a known arm has."""
    return RUNS / f"{name}.tare.toml", RUNS / f"{name}.history.toml"


def arithmetic() -> dict[str, str]:
    """Say what decides the last bits: instructions, libraries, C library."""
    features = llvmlite.binding.get_host_cpu_features()
    return {
        "machine": platform.machine(),
        "instructions": " ".join(name for name in _ROUNDING if features.get(name)),
        "libc": " ".join(platform.libc_ver()),
        **{name: version(name) for name in ("numpy", "scipy", "numba", "llvmlite")},
    }


class _StoppingOperator(ScriptedOperator):
    """Plays the script, and ends the run after a number of cycles."""

    session: Session
    cycles_left: int

    def request(self, elapsed_s: float | None, state: SchemeState) -> Request:
        self.cycles_left -= 1
        if self.cycles_left == 0:
            self.session.interrupt()
            self.session.interrupt()  # twice: at once, without parking
        return super().request(elapsed_s, state)


def play(name: str, folder: Path, cycles: int = 0) -> RunLog:
    """Play a reference run in lockstep and read its log. `cycles`: end after so many; 0: at its end."""
    settings = load_settings(str(RUNS / f"{name}.config.toml"))
    scenario = load_scenario(str(RUNS / f"{name}.scenario.toml"), settings.arm.profile)
    files = _files(name, settings)
    for file in files:
        settings = file.apply(settings)
    operator = _StoppingOperator(settings.operator)
    session = _session(settings, scenario, operator, folder, files)
    operator.session, operator.cycles_left = session, cycles
    return read_log(session.run().log.path)


def play_on_vcan(name: str, folder: Path) -> Played:
    """Play a reference run with an arm of the emulator's by the commands, on vcan0, and log it in parts of 3 s.

    A known arm's files are copied.
    """
    known = [shutil.copy(path, folder) for path in known_arm(name) if path.exists()]
    options = [word for option, path in zip(("--tare", "--history"), known, strict=False) for word in (option, path)]
    with emulator(folder, "--scenario", str(RUNS / f"{name}.scenario.toml")):
        config = folder / f"{name}.config.toml"
        config.write_text((RUNS / config.name).read_text(encoding="utf-8") + _PARTS, encoding="utf-8")
        return run_on_vcan(folder, "--clock", "lockstep", "--config", str(config), *options)


def _files(name: str, settings: Settings) -> list[UsedTare | UsedHistory]:
    """Take the tare and the history of a run whose arm is known; none for others."""
    tare, history = known_arm(name)
    if not tare.exists():
        return []
    return [use_tare(tare, settings, wall_ns()), use_history(history, wall_ns())]


def _session(
    settings: Settings,
    scenario: Scenario,
    operator: Operator,
    folder: Path,
    files: Sequence[UsedTare | UsedHistory],
) -> Session:
    """Prepare a host and its arm: alone on the bus, or behind another arm whose host sends SYNC."""
    codec = loaded_contract(settings)
    if settings.bus.follows:
        arms = TwoArms(settings, scenario)
        return Session(settings, codec, place_devices(settings), arms.end, arms.clock, operator, folder, "embedded")
    own = None if settings.devices.contract else describe_devices(codec, place_devices(settings), settings)
    rig = SessionRig(folder, settings, scenario, files=files, codec=codec, contract=own, is_modelled=True)
    rig.session.operator = operator
    return rig.session


@dataclass(frozen=True)
class Reference:
    """What one run came to. `bits`: by topic or identifier, then by field, a digest per block."""

    arithmetic: dict[str, str]
    decisions: dict[str, Any]
    bits: dict[str, dict[str, str]]

    @classmethod
    def of(cls, log: RunLog) -> "Reference":
        """Take a log's decisions and bits."""
        bits = {topic: _series_digests(log.topics[topic], log) for topic in _TOPICS}
        return cls(arithmetic(), _decisions(log), bits | {"wire": _wire_digests(log)})

    @classmethod
    def stored(cls, name: str) -> "Reference":
        """Read what is stored of a run."""
        return cls(**json.loads((RUNS / f"{name}.json").read_text(encoding="utf-8")))

    def store(self, name: str) -> None:
        """Write it in place of what is stored."""
        text = json.dumps(vars(self), indent=1, ensure_ascii=False)
        (RUNS / f"{name}.json").write_text(text + "\n", encoding="utf-8")

    def until(self, cycles: int) -> "Reference":
        """Keep the whole blocks of the first so many cycles, and no decisions."""
        count = cycles // BLOCK_CYCLES
        bits = {
            topic: {field: " ".join([*text.split(), *["-"] * count][:count]) for field, text in fields.items()}
            for topic, fields in self.bits.items()
            if topic != "/contact"  # written when there is one, so its last block may be short
        }
        return Reference(self.arithmetic, {}, bits)


def _block_of(t_ns: NDArray[np.int64], log: RunLog) -> NDArray[np.int64]:
    """Number the block of each time (n,); what comes before the first cycle is in block 0."""
    period_ns = round(float(log.metadata["period_us"]) * 1e3)
    first_ns = int(log.scheme.t_ns[0]) if len(log.scheme) else 0
    return np.maximum((t_ns - first_ns) // (period_ns * BLOCK_CYCLES), 0)


def _digests(values: list[bytes], blocks: NDArray[np.int64]) -> str:
    """Digest rows by block; `-` for a block without a row."""
    found = {}
    for value, block in zip(values, blocks.tolist(), strict=True):
        if block not in found:
            found[block] = hashlib.blake2b(digest_size=_DIGEST_BYTES)
        found[block].update(value)
    return " ".join(found[k].hexdigest() if k in found else "-" for k in range(max(found, default=-1) + 1))


def _series_digests(series: Series, log: RunLog) -> dict[str, str]:
    blocks = _block_of(series.t_ns, log)
    columns = {"t_ns": series.t_ns, **{field: series[field] for field in series.fields}}
    return {field: _digests([row.tobytes() for row in column], blocks) for field, column in columns.items()}


def _wire_digests(log: RunLog) -> dict[str, str]:
    """Digest stamps and data by direction and identifier."""
    frames = log.frames
    blocks = _block_of(frames["t_ns"].astype(np.int64), log)
    digests = {}
    for is_sent in (True, False):
        for can_id in np.unique(frames["can_id"][frames["is_tx"] == is_sent]).tolist():
            rows = np.flatnonzero((frames["can_id"] == can_id) & (frames["is_tx"] == is_sent))
            picked = frames[rows]
            name = f"{'to' if is_sent else 'from'} bus, 0x{can_id:03X}"
            digests[name] = _digests([row.tobytes() for row in picked], blocks[rows])
    return digests


def _decisions(log: RunLog) -> dict[str, Any]:
    scheme = log.scheme
    rows = np.flatnonzero(scheme["state"] != scheme["previous_state"])
    transitions = [
        [int(scheme["cycle"][row]), SchemeState(int(scheme["state"][row])).name, int(scheme["fault"][row])]
        for row in rows
    ]
    contacts = [
        {
            "cycle": report.cycle,
            "link": report.link,
            "direction": list(report.direction),
            "level": report.level.name,
            "location": report.location.name,
            "tau_ext_peak": [round(value, 5) for value in report.tau_ext_peak],
        }
        for _, report in log.contacts
        if report.is_final
    ]
    return {
        "cycles": len(scheme),
        "transitions": transitions,
        "contacts": contacts,
        "certificates": [each.event.message for each in log.events if each.event.name in CERTIFICATE_EVENTS],
        "theta_hat": [round(value, 7) for value in scheme["theta_hat"][-1].tolist()],
        "threshold": [round(value, 6) if np.isfinite(value) else None for value in scheme["threshold"][-1].tolist()],
    }


def bit_differences(stored: Reference, now: Reference) -> list[str]:
    """Say, a line for each topic and block, which fields first differ there."""
    lines = []
    for topic in sorted(stored.bits.keys() | now.bits.keys()):
        before, after = stored.bits.get(topic, {}), now.bits.get(topic, {})
        lines += [f"{topic}: {field} is gone" for field in before if field not in after]
        lines += [f"{topic}: {field} is new" for field in after if field not in before]
        by_block: dict[int, list[str]] = {}
        for field in before.keys() & after.keys():
            pairs = itertools.zip_longest(before[field].split(), after[field].split())
            at = next((block for block, (old, new) in enumerate(pairs) if old != new), None)
            if at is not None:
                by_block.setdefault(at, []).append(field)
        for block, fields in sorted(by_block.items()):
            span = f"cycles {block * BLOCK_CYCLES} to {(block + 1) * BLOCK_CYCLES - 1}"
            lines.append(f"{topic} differs first in {span}: {', '.join(sorted(fields))}")
    return lines


def decision_differences(stored: Reference, now: Reference, cycles: int = 0, share: float = 0.0) -> list[str]:
    """Say, a line each, what was decided otherwise: by more than so many cycles, or so large a share of a value."""
    return _differences("", stored.decisions, now.decisions, cycles, share)


def _differences(place: str, before: Any, after: Any, cycles: int, share: float) -> list[str]:
    if isinstance(before, dict) and isinstance(after, dict):
        pairs = {key: (before.get(key), after.get(key)) for key in before | after}
        return [line for key in pairs for line in _differences(f"{place}.{key}", *pairs[key], cycles, share)]
    if isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        pairs = enumerate(zip(before, after, strict=True))
        return [line for k, pair in pairs for line in _differences(f"{place}[{k}]", *pair, cycles, share)]
    if type(before) is type(after) and _is_near(place, before, after, cycles, share):
        return []
    return [f"{place.removeprefix('.')}: {json.dumps(before)} -> {json.dumps(after)}"]


def _is_near(place: str, before: Any, after: Any, cycles: int, share: float) -> bool:
    if isinstance(before, str) and share:
        return _NUMBER.sub("", before) == _NUMBER.sub("", after)
    if isinstance(before, float):
        return abs(after - before) <= share * max(abs(before), 0.1)
    is_cycle = place.endswith((".cycle", ".cycles")) or (".transitions" in place and place.endswith("[0]"))
    return bool(abs(after - before) <= cycles if is_cycle and isinstance(before, int) else after == before)
