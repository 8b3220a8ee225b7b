"""Measures the regressor, its filter and a correction per step, for 2 and 7 joints, in µs.

    python tools/regressor_bench.py

Compiled: a loop in machine code, percentiles over blocks of 100 steps. From Python: single calls. Absolute figures are
this machine's; compare ratios of one run.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.lab.serial_arm import chain, offline
from adacd_hil.lab.serial_arm.urdf import read_urdf
from adacd_hil.scheme.identify import estimator
from adacd_hil.scheme.model import regressor, torque_filter

ROOT = Path(__file__).resolve().parent.parent
BLOCK, BLOCKS = 100, 300
CUTOFF_RAD_S, PERIOD_S = 10.0, 1e-3


@compiled
def closed_form(q, dq, Y_p, Y_h):
    """Fill the planar arm's columns for each state."""
    for k in range(q.shape[0]):
        regressor.fill_momentum(q[k], dq[k], Y_p)
        regressor.fill_remainder(q[k], dq[k], 0.0, Y_h)


@compiled
def by_chain(arm, columns, q, dq, Y_p, Y_h):
    """Fill a chain's columns for each state."""
    for k in range(q.shape[0]):
        momentum, remainder = chain.split_regressor(arm, q[k], dq[k])
        Y_p[:, : columns.size] = momentum[:, columns]
        Y_h[:, : columns.size] = remainder[:, columns]
        chain.fill_friction(dq[k], columns.size, Y_h)


@compiled
def filtered(count, hold, cutoff, Y_p, Y_h, input_old, S, W_f):
    """Filter the regressor `count` times."""
    for _ in range(count):
        torque_filter.advance_regressor(hold, cutoff, cutoff, Y_p, Y_h, input_old, S, W_f)


@compiled
def looked_at(count, W_f, P, noise):
    """Work out the uncertainty of the residual `count` times."""
    for _ in range(count):
        offline.residual_deviation(W_f, P, noise)


@compiled
def corrected(count, W_f, tau_f, theta_hat, P, v, K):
    """Correct the estimate `count` times."""
    for _ in range(count):
        estimator.update(W_f, tau_f, 1e3, True, theta_hat, P, v, K)


def show(name: str, block: Callable[[], object], steps: int) -> None:
    """Time blocks of so many steps and print a row."""
    clock = time.perf_counter_ns
    times_us = np.empty(BLOCKS)
    block()
    for index in range(BLOCKS):
        start_ns = clock()
        block()
        times_us[index] = (clock() - start_ns) * 1e-3 / steps
    p50, p99, p999 = np.percentile(times_us, [50.0, 99.0, 99.9])
    print(f"{name:44} {p50:8.2f} {p99:8.2f} {p999:8.2f} {times_us.max():8.1f}")


def show_rest(named: str, Y_p: np.ndarray, Y_h: np.ndarray) -> None:
    """Print what follows the regressor: one filter, the uncertainty, one correction."""
    n, p = Y_p.shape
    hold = torque_filter.first_order_hold(CUTOFF_RAD_S, CUTOFF_RAD_S, PERIOD_S)
    input_old, S, W_f = (np.zeros((n, p)) for _ in range(3))
    P, noise = np.eye(p), np.full(n, 0.02)
    show(f"{named}: one filter of it", lambda: filtered(BLOCK, hold, CUTOFF_RAD_S, Y_p, Y_h, input_old, S, W_f), BLOCK)
    show(f"{named}: w P w'", lambda: looked_at(BLOCK, W_f, P, noise), BLOCK)
    theta_hat, v, K = (np.zeros(p) for _ in range(3))
    show(f"{named}: one correction", lambda: corrected(BLOCK, W_f, np.zeros(n), theta_hat, P, v, K), BLOCK)


def planar_arm() -> chain.Chain:
    """Return the emulated arm's geometry."""
    translation = np.array([[0.0, 0.0, 0.0], [0.35, 0.0, 0.0]])
    axis = np.array([[0.0, 0.0, 1.0]] * 2)
    return chain.Chain(np.array([np.eye(3)] * 2), translation, axis, np.zeros(2), np.zeros(3))


def main() -> int:
    """Run the command line."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    print_table()
    return 0


def print_table() -> None:
    """Print what each step costs."""
    print(f"{'µs per step':44} {'p50':>8} {'p99':>8} {'p99.9':>8} {'max':>8}")
    random = np.random.default_rng(0)
    q, dq = random.uniform(-1.0, 1.0, (2, BLOCK, 2))
    Y_p, Y_h = np.zeros((2, 7)), np.zeros((2, 7))
    show("2 joints, closed form, p = 7: Y_p, Y_h", lambda: closed_form(q, dq, Y_p, Y_h), BLOCK)
    show("  from Python", lambda: closed_form(q[:1], dq[:1], Y_p, Y_h), 1)
    show_rest("  p = 7", Y_p, Y_h)
    seven = read_urdf((ROOT / "tests/scheme/seven_joint_arm.urdf").read_text()).chain
    for arm in (planar_arm(), seven):
        bench_chain(arm)


def bench_chain(arm: chain.Chain) -> None:
    """Print the rows of one arm."""
    columns, n = chain.find_base(arm).columns, len(arm.axis)
    p = columns.size + 2 * n
    q, dq = np.random.default_rng(0).uniform(-1.0, 1.0, (2, BLOCK, n))
    Y_p, Y_h = np.zeros((n, p)), np.zeros((n, p))
    show(
        f"{n} joints, chain, p = {p}: Y_p, Y_h",
        lambda: by_chain(arm, columns, q, dq, Y_p, Y_h),
        BLOCK,
    )
    show("  from Python", lambda: by_chain(arm, columns, q[:1], dq[:1], Y_p, Y_h), 1)
    show_rest(f"  p = {p}", Y_p, Y_h)


if __name__ == "__main__":
    sys.exit(main())
