"""The motion of an adaptation: ranges of the joints, and what the filtered regressor shows of each parameter.

Without it a small residual proves little, since an arm that stands still fulfils eq. (15) with any parameters:

- each joint must have travelled far enough;
- each joint must have moved fast enough in both directions, which shows both signs of its Coulomb friction;
- no combination of parameters may stay hidden. The information matrix sum T W_f' W_f is scaled by a parameter error of
  each kind (`TerminationSettings.excitation_scale`): D I D with D = diag(scale). Its smallest eigenvalue is the least
  energy, in (filtered Nm)² s, with which an error of that size has shown in the residual, whatever its direction. The
  scale is not P(0): with a gain a hundred times as high, the evidence must not become a hundred times as easy.
  The paper's motion, as printed or synchronous, reaches 6.7e-4 to 7.9e-4 in 5.2 s on the profiles P, S and M; the
  default of 2e-4 is a third of that, and is passed only after joint 1 has gone back and forth once.

Shapes: q, dq (2,); W_f (2, p); information (p, p).
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.scheme.memory import Motion

EXCITATION_EVERY = 64
"""Samples between two looks at the smallest eigenvalue: it takes 4 µs, the rest of a step less than 1 µs."""
_SWEEPS = 12
"""Most sweeps of Jacobi's method. Convergence is quadratic; 6 sweeps reach rounding for 9 x 9."""


@compiled
def begin(motion: Motion) -> None:
    """Clear the ranges of the joints' position and velocity, the information matrix, and the count of samples."""
    motion.samples = 0.0
    motion.q_low[:] = np.inf
    motion.q_high[:] = -np.inf
    begin_speeds(motion)
    motion.information[:] = 0.0


@compiled
def begin_speeds(motion: Motion) -> None:
    """Clear the ranges of the joints' velocity alone."""
    motion.dq_low[:] = np.inf
    motion.dq_high[:] = -np.inf


@compiled
def widen(value: Vector, low: Vector, high: Vector) -> None:
    """Widen the range low .. high (2,) in place, so that it contains `value` (2,)."""
    for i in range(value.shape[0]):
        low[i] = min(low[i], value[i])
        high[i] = max(high[i], value[i])


@compiled
def has_moved(motion: Motion, travel_rad: float, velocity_rad_s: float) -> bool:
    """Return whether each joint has covered at least `travel_rad`, and reached `velocity_rad_s` in both directions."""
    has_travelled = np.all(motion.q_high - motion.q_low >= travel_rad)
    is_fast = np.all(motion.dq_high >= velocity_rad_s) and np.all(motion.dq_low <= -velocity_rad_s)
    return bool(has_travelled and is_fast)


@compiled
def add_information(W_f: Vector, period_s: float, information: Vector) -> None:
    """Add T W_f' W_f to the lower triangle of `information` (p, p) in place; T: period_s."""
    for j in range(W_f.shape[1]):
        for k in range(j + 1):
            for i in range(W_f.shape[0]):
                information[j, k] += period_s * W_f[i, j] * W_f[i, k]


@compiled
def gather(motion: Motion, q: Vector, dq: Vector, W_f: Vector, period_s: float) -> bool:
    """Add a sample to the ranges of motion and the information matrix.

    Return True at every EXCITATION_EVERY-th sample.
    """
    widen(q, motion.q_low, motion.q_high)
    widen(dq, motion.dq_low, motion.dq_high)
    add_information(W_f, period_s, motion.information)
    motion.samples += 1.0
    return bool(motion.samples % EXCITATION_EVERY == 0.0)


@compiled
def eigenvalue_range(information: Vector, scale: Vector, scratch: Vector) -> tuple[float, float]:
    """Return the smallest and the largest eigenvalue of D I D, D = diag(scale), each at least 0.

    I (p, p): `information`, of which only the lower triangle is read; it is kept. `scratch` (p, p) is overwritten, by
    Jacobi's cyclic rotations: they give the same bits on every machine, which LAPACK does not promise.
    """
    count = scale.shape[0]
    trace = 0.0
    for j in range(count):
        for k in range(j + 1):
            scratch[j, k] = scale[j] * information[j, k] * scale[k]
            scratch[k, j] = scratch[j, k]
        trace += scratch[j, j]
    for _ in range(_SWEEPS):
        off_diagonal = 0.0
        for j in range(count):
            for k in range(j):
                off_diagonal = max(off_diagonal, abs(scratch[j, k]))
        if off_diagonal <= 1e-15 * trace:
            break
        for j in range(count):
            for k in range(j):
                _rotate(scratch, j, k)
    values = np.diag(scratch)[:count]
    return max(np.min(values), 0.0), max(np.max(values), 0.0)


@compiled
def _rotate(matrix: Vector, j: int, k: int) -> None:
    """Rotate the symmetric `matrix` in place in the plane of axes j and k so that its element (j, k) becomes zero."""
    if matrix[j, k] == 0.0:
        return
    half_difference = 0.5 * (matrix[k, k] - matrix[j, j])
    ratio = half_difference / matrix[j, k]
    tangent = 1.0 / (abs(ratio) + np.sqrt(1.0 + ratio * ratio))
    if ratio < 0.0:
        tangent = -tangent
    cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    for i in range(matrix.shape[0]):
        at_j, at_k = matrix[i, j], matrix[i, k]
        matrix[i, j] = cosine * at_j - sine * at_k
        matrix[i, k] = sine * at_j + cosine * at_k
    for i in range(matrix.shape[0]):
        at_j, at_k = matrix[j, i], matrix[k, i]
        matrix[j, i] = cosine * at_j - sine * at_k
        matrix[k, i] = sine * at_j + cosine * at_k
