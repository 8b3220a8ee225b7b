"""Linear algebra of small matrices for compiled code: the same bits on every machine, which LAPACK doesn't promise.

Shapes: a, b, w, x, theta (p,); matrices (p, p), of symmetric ones and of Cholesky factors the lower half is read.
"""

import math

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector


@compiled
def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product of a and b."""
    total = 0.0
    for j in range(b.shape[0]):
        total += a[j] * b[j]
    return total


@compiled
def misfit(w: Vector, theta: Vector, tau: float) -> float:
    """Return w theta - tau: torque predicted by parameters theta and regressor row w, less measured torque tau."""
    total = -tau
    for j in range(theta.shape[0]):
        total += w[j] * theta[j]
    return total


@compiled
def quadratic(A: Vector, x: Vector) -> float:
    """Return x' A x of a symmetric A, whose lower half is read; 0 in place of a negative result."""
    total = 0.0
    for j in range(x.shape[0]):
        if x[j] != 0.0:
            total += A[j, j] * x[j] * x[j]
            for n in range(j):
                total += 2.0 * A[j, n] * x[j] * x[n]
    return max(total, 0.0)


@compiled
def add_row(v: Vector, r: float, R: float, L: Vector, b: Vector) -> None:
    """Add a measurement r, of variance R and regressor row v, to the normal equations of a least-squares fit.

    Add v v'/R to the lower half of the matrix L, v r/R to the right side b.
    """
    for j in range(v.shape[0]):
        if v[j] != 0.0:
            b[j] += v[j] * r / R
            for n in range(j + 1):
                L[j, n] += v[j] * v[n] / R


@compiled
def factor(A: Vector, least: float) -> bool:
    """Replace the lower half of A by its Cholesky factor L, A = L L'; return whether A is positive definite.

    Otherwise the lower half is of no use; so it is with NaN. least: a squared pivot below this counts as this, so that
    only NaN gives False; 0: a squared pivot of 0 or less makes A not positive definite.
    """
    for j in range(A.shape[0]):
        for n in range(j + 1):
            for i in range(n):
                A[j, n] -= A[j, i] * A[n, i]
            if n < j:
                A[j, n] /= A[n, n]
        pivot = least if A[j, j] < least else A[j, j]  # nan stays nan
        if not pivot > 0.0:
            return False
        A[j, j] = math.sqrt(pivot)
    return True


@compiled
def solve_lower(L: Vector, x: Vector) -> None:
    """Replace x by L^-1 x, L lower triangular."""
    for j in range(x.shape[0]):
        for n in range(j):
            x[j] -= L[j, n] * x[n]
        x[j] /= L[j, j]


@compiled
def solve_upper(L: Vector, x: Vector) -> None:
    """Replace x by L'^-1 x, L lower triangular."""
    for j in range(x.shape[0] - 1, -1, -1):
        for n in range(j + 1, x.shape[0]):
            x[j] -= L[n, j] * x[n]
        x[j] /= L[j, j]
