"""Computes the smallest hand that one run can tell from the arm, by the motion on which it is asked.

    python tools/campaigns/hand_bounds.py
    python tools/campaigns/hand_bounds.py --profiles P

Of the certified scheme's regressor on recorded motion, and the columns of some hands behind the same filter. What of a
hand is outside the columns of the arm, as far as the prior leaves them open, is found when it comes to SIGMAS
deviations of the fit; the rest is learnt as the arm's. Asked of the excitation alone, of more of it, and of as much of
a question: joint 1 back and forth at two values of q2. Drag on joint 1 is a column of the arm: what tells it apart here
is the rest between, not the motion. Table on stdout. Exit status: 0 printed, 2 wrong usage.
"""

import argparse
import sys

import numpy as np
from campaign_certified import CertifiedScheme
from lab import PERIOD_S, Motion, cut, join, profile_arm, record
from lab_motion import evaluate, to_rest
from numpy.typing import NDArray
from scipy.signal import lfilter

from adacd_hil.cli.output import format_table
from adacd_hil.scheme.kernel import certified_kernel, certified_memory
from adacd_hil.scheme.model import filter_bank
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings

Array = NDArray[np.float64]
SIGMAS = 5.0
BEFORE_S = 2.4
QUESTION = (
    ((-30.0, -60.0), 0.7), ((30.0, -60.0), 0.9), ((-30.0, -60.0), 0.9),
    ((-30.0, 0.0), 0.8), ((30.0, 0.0), 0.9), ((-30.0, 0.0), 0.9),
)  # fmt: skip
"""Where to, deg, and in which time, s."""
STILL_M_S = 0.004


def question(begin: Array) -> Motion:
    """Return the question's motion, from rest at `begin` (2,)."""
    count = round(sum(lasts_s for _, lasts_s in QUESTION) / PERIOD_S)
    motion = Motion("question", *np.zeros((3, count, 2)))
    cycle, at, rest = 0, begin, np.zeros(2)
    for end_deg, lasts_s in QUESTION:
        end = np.radians(end_deg)
        coefficients = to_rest(at, rest, rest, end, lasts_s)
        for step in range(round(lasts_s / PERIOD_S)):
            evaluate(coefficients, step * PERIOD_S, motion.q_d[cycle], motion.dq_d[cycle], motion.ddq_d[cycle])
            cycle += 1
        at = end
    return motion


def rows_of(settings: Settings, q: Array, dq: Array, tau_J: Array) -> Array:
    """Return what is learnt of a record (m, 2, p), without what is not learnt at rest."""
    constants, memory = certified_memory.constants_of(settings), certified_memory.new_memory(settings)
    block, rows = certified_memory.new_block(settings), []
    for k in range(len(q)):
        block["q"], block["dq"], block["tau_J"], block["period_s"] = q[k], dq[k], tau_J[k], 0.0
        certified_kernel.step(constants, memory, block, 1, 1, 0)
        if k % settings.certified.learn_every == 0:
            rows.append(memory[0].filters.W_learnt.copy())
    return np.array(rows)


def hands_of(settings: Settings, q: Array, dq: Array) -> dict[str, Array]:
    """Return the torques (n, 2) of hands of size 1."""
    l1, l2 = settings.arm.link_length_m
    q1, q12 = q[:, 0], q.sum(axis=1)
    x, y = l1 * np.cos(q1) + l2 * np.cos(q12), l1 * np.sin(q1) + l2 * np.sin(q12)
    J = np.array([[-y, -l2 * np.sin(q12)], [x, l2 * np.cos(q12)]]).transpose(2, 0, 1)
    v = np.einsum("nij,nj->ni", J, dq)
    speed = np.linalg.norm(v, axis=1, keepdims=True)
    slides = np.where(speed > STILL_M_S, v / np.maximum(speed, STILL_M_S), 0.0)
    forces = {
        "force normal to link 2 at the tip, N": np.stack([-np.sin(q12), np.cos(q12)], axis=1),
        "force along x at the tip, N": np.tile([1.0, 0.0], (len(q), 1)),
        "force along y at the tip, N": np.tile([0.0, 1.0], (len(q), 1)),
        "Coulomb drag at the tip, N": -slides,
        "viscous drag at the tip, N s/m": -v,
        "spring at the tip, N/m": np.stack([x[0] - x, y[0] - y], axis=1),
    }
    torques = {name: np.einsum("nij,ni->nj", J, force) for name, force in forces.items()}
    turns = np.where(np.abs(dq[:, 0]) > settings.certified.still_rad_s, -np.sign(dq[:, 0]), 0.0)
    torques["Coulomb drag on joint 1, Nm"] = np.stack([turns, np.zeros(len(q))], axis=1)
    return torques


def smallest(settings: Settings, rows: Array, torque: Array) -> float:
    """Return the size at which a hand (n, 2) of size 1 comes to SIGMAS deviations."""
    cutoff, smoothing = settings.certified.cutoffs_rad_s[filter_bank.LEARNT], settings.certified.smoothing_rad_s
    for rate in (cutoff, smoothing):
        decay = np.exp(-rate * PERIOD_S)
        torque = lfilter([1.0 - decay], [1.0, -decay], torque, axis=0)
    b = torque[:: settings.certified.learn_every].ravel()
    A = rows.reshape(b.size, -1)
    prior = certified_memory.prior_std_of(settings)
    variance = certified_memory.constants_of(settings)[0]["correlated"] * settings.certified.residual_Nm**2
    shown = A.T @ b / variance
    information = A.T @ A / variance + np.diag(1.0 / np.maximum(prior, 1e-9) ** 2)
    return float(SIGMAS / np.sqrt(b @ b / variance - shown @ np.linalg.solve(information, shown)))


def main() -> int:
    """Print the table of the profiles that were asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--profiles", default="PSM", help="letters; default %(default)s")
    profiles = parser.parse_args().profiles
    if set(profiles) - set("PSM"):
        parser.error(f"--profiles {profiles}: of P, S, M")
    rows: dict[str, list[str]] = {}
    head = ["hand"]
    for profile in profiles:
        settings = load_settings("certified", profile)
        arm = profile_arm(profile)
        excitation = CertifiedScheme("certified", settings).adaptation_motion(is_payload=False)
        before = cut(excitation, round(BEFORE_S / PERIOD_S))
        asked = join([before, question(before.q_d[-1])])
        longer = cut(excitation, len(asked.q_d))
        for name, motion in (("excitation", before), ("longer", longer), ("excitation, question", asked)):
            measured = record(arm, motion, seed=1, feedforward=[(0.0, arm.theta)], payloads=[])
            regressor = rows_of(settings, measured.q, measured.dq, measured.tau_J)
            head.append(f"{profile}, {name} {motion.duration_s:.1f} s")
            for hand, torque in hands_of(settings, measured.q, measured.dq).items():
                rows.setdefault(hand, []).append(f"{smallest(settings, regressor, torque):.3f}")
    print(format_table(tuple(head), [[hand, *values] for hand, values in rows.items()]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
