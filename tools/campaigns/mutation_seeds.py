"""The files that the mutation campaign begins with: one of each kind, as it should be, small."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import can
import numpy as np

from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.control.device_record import DeviceRecord
from adacd_hil.control.history_file import HISTORY_FORMAT, CertificateRecord, History, devices_digest
from adacd_hil.control.tare_file import TARE_FORMAT
from adacd_hil.lab.logs.cut import TimeWindow, cut
from adacd_hil.lab.logs.python_can_files import to_messages
from adacd_hil.log.frames.frame_log import read_frames
from adacd_hil.log.log_files import LOG_NAME, TRUTH_NAME
from adacd_hil.scheme.model.regressor import inverse_dynamics
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.toml_text import to_toml
from adacd_hil.wire.dbc_contract import contract_folder
from firmware_sim.scenario.scenario import builtin_scenarios

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "docs" / "examples" / "foreign"
PROFILES = ROOT / "adacd_hil" / "device_profiles"
_FRAMES = 400
MY_ARM = """extends = "certified"

[operator]
script = []
acknowledge_after_s = 0.0

[arm]
rated_torque_Nm = [12.0, 6.0]
torque_limit_Nm = [6.0, 3.0]
position_limit_deg = [75.0, 120.0]
cad_theta = [0.18, 0.037, 0.019, 0.0, 0.0, 0.0, 0.0]

[controller]
Kp = [250.0, 20.0]

[profiles.P]
arm.position_limit_deg = [70.0, 110.0]
"""
SCENARIO = """
name = "mutant"
about = "a push, a payload, faults"
lasts_s = 2.0
start_deg = [-30.0, -60.0]
contacts = [{ at_s = 1.0, link = 2, point_m = 0.2, force_N = 10.0, duration_s = 0.1 }]
faults = [{ kind = "lose", node = "sensor1", frame = "torque", at_s = 0.5, duration_s = 0.2, probability = 0.5 }]
"""
TARE = f"""format = {TARE_FORMAT}
offset_Nm = [0.01, -0.02]
standard_error_Nm = [0.001, 0.001]
spread_Nm = [0.0, 0.0]
old_offset_Nm = [0.0, 0.0]
sign = [1, 1]
is_auto_zeroed = false
gravity_model = "none"
gravity_Nm = [0.0, 0.0]
condition = 1.0
samples = 2000
duration_s = 2.0
date_utc = "2026-01-31T12:00:00Z"
user = "me"
host = "here"
interface = "socketcan"
channel = "can0"
config = "paper"
profile = "P"
wire_version = 2
layout_digest = "0x12345678"
version = "0.1.0"
git = ""
[sensor1]
name = "Sensor1"
node_id = 3
vendor = 1
product = 2
revision = 3
serial = 4
temperature_C = 25.0
[sensor2]
name = "Sensor2"
node_id = 4
vendor = 1
product = 2
revision = 3
serial = 5
[[poses]]
q_rad = [0.0, 0.0]
mean_Nm = [0.01, -0.02]
std_Nm = [0.02, 0.02]
peak_to_peak_Nm = [0.1, 0.1]
drift_Nm = [0.0, 0.0]
residual_Nm = [0.0, 0.0]
samples = 2000
"""


@dataclass(frozen=True)
class Seeds:
    """`files`: of each kind. Words of commands that name a seed: `names`."""

    folder: Path
    files: dict[str, list[Path]]

    def place(self, kind: str, original: Path, folder: Path) -> Path:
        """Say where the mutant of a file lies, with what refers to it around it."""
        if kind == "profile":
            return folder / "mutant.toml"
        if kind == "eds":
            return folder / "mutant.eds"
        if kind == "urdf":
            return folder / "mutant.urdf"
        if kind in ("map", "csv"):
            shutil.copy(EXAMPLE / "planar-arm.urdf", folder)
        return folder / f"mutant{original.suffix}"

    def names(self, folder: Path) -> dict[str, str]:
        """Name the seeds that commands use, and what uses a mutant in `folder`."""
        uses_profile, uses_eds, uses_urdf = (folder / f"uses-{kind}.toml" for kind in ("profile", "eds", "urdf"))
        uses_profile.write_text('[devices]\ndrive = ["mutant.toml", "mutant.toml"]\ncontract = ""\n')
        uses_eds.write_text('[devices]\ndrive = ["own-drive.toml", "own-drive.toml"]\ncontract = ""\n')
        drive = (PROFILES / "adacd-drive.toml").read_text()
        (folder / "own-drive.toml").write_text(drive.replace('"drive.eds"', '"mutant.eds"'))
        uses_urdf.write_text((EXAMPLE / "map.toml").read_text().replace("planar-arm.urdf", "mutant.urdf"))
        return {
            "USES_PROFILE": str(uses_profile),
            "USES_EDS": str(uses_eds),
            "USES_URDF": str(uses_urdf),
            "SHORT_MCAP": str(self.folder / "short.mcap"),
            "SHORT_LOG": str(self.folder / "candump.log"),
            "MAP": str(EXAMPLE / "map.toml"),
            "CSV": str(self.folder / "foreign.csv"),
        }


def make_seeds(folder: Path, is_light: bool) -> Seeds:
    """Play a short run, and make a file of each kind."""
    folder.mkdir(parents=True)
    scenario = folder / "scenario.toml"
    scenario.write_text(SCENARIO)
    played = folder / "short.toml"
    played.write_text(
        "lasts_s = 0.2\nstart_deg = [-30.0, -60.0]\n"
        "contacts = [{ at_s = 0.1, link = 2, point_m = 0.2, force_N = 20.0, duration_s = 0.1 }]\n"
    )
    run_embedded(resolve("certified", str(played), None, 1), "lockstep", folder / "run")
    short = folder / "short.mcap"
    cut(folder / "run" / LOG_NAME, short, TimeWindow(0.0, 0.5), ())
    files = {
        "toml": _texts(folder, "config", MY_ARM, to_toml(load_settings("certified")), to_toml(load_settings("paper"))),
        "scenario": [scenario, *_scenarios()],
        "profile": sorted(PROFILES.glob("*drive*.toml")),
        "dbc": sorted(contract_folder().glob("*.dbc")),
        "eds": [contract_folder() / "drive.eds"],
        "mcap": [short] if is_light else [short, short, folder / "run" / LOG_NAME, folder / "run" / TRUTH_NAME],
        "csv": [_foreign_csv(folder / "foreign.csv")],
        "map": [EXAMPLE / "map.toml"],
        "urdf": [EXAMPLE / "planar-arm.urdf"],
        "tare": _texts(folder, "tare", TARE),
        "history": _texts(folder, "history", to_toml(_history())),
        **_frame_logs(folder, short),
    }
    files["bytes"] = files["toml"][:1]
    return Seeds(folder, files)


def _texts(folder: Path, name: str, *texts: str) -> list[Path]:
    paths = [folder / f"{name}{number}.toml" for number in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    return paths


def _history() -> History:
    """Return the history of an arm with two runs."""
    names = ("Drive1", "Drive2", "Sensor1", "Sensor2")
    devices = tuple(DeviceRecord(name, node_id, 1, 2, 3, node_id) for node_id, name in enumerate(names, start=1))
    digest, records = devices_digest(devices), []
    for month in (1, 2):
        record = CertificateRecord(
            date_utc=f"2026-0{month}-01T12:00:00Z", log=LOG_NAME, profile="P", version="0.1.0", parameters=(0.1,) * 7,
            friction_Nm=(0.1,) * 6, friction_std_Nm=(0.01,) * 6, inertia_kgm2=(0.2, 0.05, 0.02),
            inertia_std_kgm2=(0.001,) * 3, offset_Nm=(0.01, -0.02), offset_std_Nm=(0.003, 0.002), is_payload=False,
            text="torque offsets anchored",
        )  # fmt: skip
        digest = record.digest_after(digest)
        records.append(replace(record, digest=digest))
    return History(HISTORY_FORMAT, devices, tuple(records))


def _scenarios() -> list[Path]:
    folder = ROOT / "firmware_sim" / "scenarios"
    return [folder / f"{name}.toml" for name in builtin_scenarios()]


def _frame_logs(folder: Path, log: Path) -> dict[str, list[Path]]:
    """Write the first frames of a log in every format that others have."""
    frames = read_frames(log)
    messages = list(to_messages(frames.frames[:_FRAMES], list(frames.channels)))
    for message in messages:
        message.channel = 0
        message.timestamp += 1.7e9
    found = {}
    for kind, name in (
        ("blf", "x.blf"),
        ("asc", "x.asc"),
        ("candump", "candump.log"),
        ("can_csv", "x.csv"),
        ("trc", "x.trc"),
    ):
        with can.Logger(folder / name) as writer:
            for message in messages:
                writer(message)
        found[kind] = [folder / name]
    return found


def _foreign_csv(path: Path) -> Path:
    """Write 6 s of two sines per joint, as the example's map wants it."""
    time_s = 0.004 * np.arange(1500)
    theta = np.array([0.19205, 0.034125, 0.020175, 0.03, 0.015, 0.0375, 0.02])
    amplitudes, rates = np.array([[0.5, 0.9], [0.15, 0.2]]), np.array([[1.7, 1.1], [4.1, 3.3]])
    phase = rates[:, None, :] * time_s[None, :, None] + np.array([[[0.3, 1.0]], [[0.0, 2.0]]])
    factors = amplitudes[:, None, :] * rates[:, None, :] ** np.arange(3)[:, None, None, None]
    q, dq, ddq = (
        (factors[0] * np.sin(phase)).sum(axis=0),
        (factors[1] * np.cos(phase)).sum(axis=0),
        (-factors[2] * np.sin(phase)).sum(axis=0),
    )
    tau_J = np.array([inverse_dynamics(*row, theta, 0.0) for row in zip(q, dq, ddq, strict=True)])
    turned = np.array([1.0, -1.0])
    touched = np.zeros(len(time_s))
    rows = np.column_stack([time_s * 1e3, np.degrees(q) * turned, tau_J * 1e3 * turned, touched])
    head = "time_ms,j1_deg,j2_deg,j1_mNm,j2_mNm,touched"
    np.savetxt(path, rows, delimiter=",", header=head, comments="", fmt="%.6f")
    return path
