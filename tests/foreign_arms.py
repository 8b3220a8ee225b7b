"""Recordings of arms that there are not: any URDF moved on a multisine, with friction, offsets and noise."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from adacd_hil.lab.serial_arm import chain
from adacd_hil.lab.serial_arm.urdf import SerialArm, read_urdf

AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 0 1")


def urdf_text(
    joints: int, axes=AXES, has_masses: bool = True, effort: float = 60.0, density: float = 1.0, names=()
) -> str:
    """Write an arm of links of 0.3 m and less and less mass; its joints are joint1, joint2 … unless they have names."""
    text = '<robot name="made"><link name="base"/>'
    for i in range(joints):
        mass = 3.0 * density / (1 + i)
        inertial = (
            f'<inertial><origin xyz="0.12 0.02 0.03"/><mass value="{mass}"/><inertia ixx="{0.004 * mass}" '
            f'iyy="{0.01 * mass}" izz="{0.01 * mass}" ixy="0" ixz="0" iyz="0"/></inertial>'
        )
        text += (
            f'<link name="link{i + 1}">{inertial if has_masses else ""}</link>'
            f'<joint name="{names[i] if names else f"joint{i + 1}"}" type="revolute">'
            f'<parent link="{f"link{i}" if i else "base"}"/>'
            f'<child link="link{i + 1}"/><origin xyz="{0.3 if i else 0.0} 0 0"/><axis xyz="{axes[i]}"/>'
            f'<limit lower="-2" upper="2" velocity="5" effort="{effort}"/></joint>'
        )
    return text + "</robot>"


@dataclass
class Motion:
    """A recording: time (k,) s, and q, dq, tau (k, n)."""

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    truth: dict[str, np.ndarray] = field(default_factory=dict)


def sines(joints: int, seconds: float, period_s: float, seed: int, amplitude_rad: float = 0.7):
    """Return t, and q, dq, ddq (3, k, n), of five sines per joint."""
    random = np.random.default_rng(seed)
    rates = random.uniform(0.8, 6.0, (5, joints))
    sizes = random.uniform(0.5, 1.0, (5, joints)) / rates
    sizes *= amplitude_rad / sizes.sum(axis=0)
    phases = random.uniform(0.0, 6.0, (5, joints))
    t = period_s * np.arange(round(seconds / period_s))
    angle = rates[:, None, :] * t[None, :, None] + phases[:, None, :]
    q = (sizes[:, None] * np.sin(angle)).sum(axis=0)
    dq = (sizes[:, None] * rates[:, None] * np.cos(angle)).sum(axis=0)
    ddq = -(sizes[:, None] * rates[:, None] ** 2 * np.sin(angle)).sum(axis=0)
    return t, np.array([q, dq, ddq])


def rigid_torque(arm: SerialArm, motion) -> np.ndarray:
    """Return the torque (k, n) of the URDF's masses along q, dq, ddq (3, k, n)."""
    theta = arm.theta_full
    return np.array([chain.regressor(arm.chain, *state) @ theta for state in motion.swapaxes(0, 1).copy()])


def record(
    urdf: str, seconds: float = 12.0, period_s: float = 5e-3, seed: int = 1, noise_Nm: float = 0.02, amplitude_rad=0.7
) -> Motion:
    """Move an arm and record it; friction falls from joint to joint."""
    arm = read_urdf(urdf)
    n = len(arm.joint_names)
    t, motion = sines(n, seconds, period_s, seed, amplitude_rad)
    F_v, F_c = 0.3 / (1.0 + np.arange(n)), 0.5 / (1.0 + np.arange(n))
    offset = 0.05 * np.cos(np.arange(n))
    q, dq, _ = motion
    tau = rigid_torque(arm, motion) + F_v * dq + F_c * np.sign(dq) + offset
    tau += noise_Nm * np.random.default_rng(seed + 100).standard_normal(tau.shape)
    return Motion(t, q, dq, tau, {"F_v": F_v, "F_c": F_c, "offset": offset})


def write_recording(folder: Path, urdf: str, motion: Motion, has_dq: bool = False, more: str = "") -> tuple[Path, Path]:
    """Write arm.urdf, map.toml and r.csv, and return the last two. more: further lines of the map."""
    n = motion.q.shape[1]
    names = [f"{kind}{i + 1}" for kind in ("q", "tau", *(("dq",) if has_dq else ())) for i in range(n)]
    (folder / "arm.urdf").write_text(urdf)
    table = np.column_stack([motion.t, motion.q, motion.tau, *((motion.dq,) if has_dq else ())])
    np.savetxt(folder / "r.csv", table, delimiter=",", header=",".join(["t", *names]), comments="", fmt="%.7g")
    lists = {key: [f"{kind}{i + 1}" for i in range(n)] for key, kind in (("q", "q"), ("tau_J", "tau"), ("dq", "dq"))}
    keys = "".join(f"{key} = {names}\n" for key, names in lists.items() if key != "dq" or has_dq).replace("'", '"')
    (folder / "map.toml").write_text(f'[arm]\nurdf = "arm.urdf"\n[columns]\ntime = "t"\n{keys}{more}')
    return folder / "r.csv", folder / "map.toml"
