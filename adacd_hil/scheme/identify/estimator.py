"""The parameter estimator of eq. (10): least squares in recursive form, or the gradient law with constant gain.

The paper's law is in continuous time, P' = -P W_f' W_f P and theta_hat' = P W_f' epsilon. Integrated over a period T
with W_f and epsilon of its sample, it is the recursive least squares of a measurement of variance R = 1 / T:

    K = P W_f' (R I + W_f P W_f')^-1,    theta_hat += K epsilon,    P = (I - K W_f) P (I - K W_f)' + K R K'

whose solution is theta_tilde = (I + P(0) sum T W_f' W_f)^-1 theta_tilde(0) whatever T is. R = 1 in place of 1 / T would
be a thousand times the gain at 1 kHz. The two rows of W_f are taken one after the other, which is the same because
R I is diagonal, and needs no inverse. With v = P w' and s = R + w v the last equation (Joseph's form) is

    P - K v' - v K' + s K K'

written for one triangle and mirrored: P stays symmetric, and an error of K enters only squared.

The gradient law leaves P as it is. In this implicit form it is stable at any gain and any period.

Shapes: W_f (2, p), theta_hat (p,), P (p, p), epsilon = tau_f - W_f theta_hat (2,) in filtered Nm.
"""

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import Vector


@compiled
def update(
    W_f: Vector, tau_f: Vector, R: float, is_least_squares: bool, theta_hat: Vector, P: Vector, v: Vector, K: Vector
) -> None:
    """Correct theta_hat (p,) in place by the rows of one sample, W_f and tau_f.

    R: variance of a row. is_least_squares: correct P (p, p), too; False: the gradient law, with constant P. v, K (p,):
    overwritten as scratch.
    """
    for i in range(W_f.shape[0]):
        correct(W_f[i], tau_f[i], R, is_least_squares, theta_hat, P, v, K)


@compiled
def correct(
    w: Vector, tau: float, R: float, is_least_squares: bool, theta_hat: Vector, P: Vector, v: Vector, K: Vector
) -> tuple[float, float]:
    """Correct theta_hat (p,) in place by one row w (p,) of variance R; return its residual epsilon before, and s.

    s: variance of epsilon. is_least_squares: correct P (p, p), too; False: the gradient law, with constant P. v, K
    (p,): overwritten as scratch.
    """
    count = theta_hat.shape[0]
    epsilon = -linalg.misfit(w, theta_hat, tau)
    s = R
    for j in range(count):
        v[j] = linalg.dot(P[j], w)
        s += w[j] * v[j]
    for j in range(count):
        K[j] = v[j] / s
        theta_hat[j] += K[j] * epsilon
    if is_least_squares:
        for j in range(count):
            for k in range(j + 1):
                P[j, k] += s * K[j] * K[k] - (K[j] * v[k] + v[j] * K[k])
                P[k, j] = P[j, k]
    return epsilon, s
