"""A certificate: what contradicts it, what it says of the arm, and what the last one, of another run, says of the next.

**The last certificate.** A hand that drags from before the first motion to the end of learning, or moves like a mass,
is the arm as far as one run can tell. The last certificate knows the arm without it, or with another. As within a run,
**less is the arm's**: a fit gets no certificate while one of the quantities c of `earlier`, a joint's friction at some
speed or an inertia, or its viscous friction, which is the friction at the highest of these speeds less that at the
lowest, over their difference, is

    c theta > last + floor + LAST_SIGMAS sqrt(share² last² + std² + c P c')

until the user says that nobody touches the arm. share: `history.friction_share`, `inertia_share`, how far one run
differs from another. Not asked with a payload that was announced. It judges the fit, and never pulls it.

Shapes: quantities (q,), friction of each joint by speed first, then a1, a2, a3, then each joint's viscous friction;
parameters p.
"""

from typing import Any, NamedTuple

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.identify import anchor, earlier, missing_torque
from adacd_hil.settings.configuration import Settings

NOTHING, ANCHOR, CHANGED, MORE, MORE_THAN_LAST, BY_PLACE, TOO_MUCH_BY_PLACE, BLIND = range(8)
"""What contradicts a certificate that is withheld, or taken back: of the kernel's `withheld_by`."""
LAST_SIGMAS = 4.0
FLOOR_NM, FLOOR_KGM2, FLOOR_NM_S = 0.02, 0.006, 0.02
"""Of friction, inertia, viscous friction: less is nothing."""


class Certificate(NamedTuple):
    """What a certificate says of the arm, as it was when it was certified.

    parameters: a1 … F_c2, and those of gravity where there are any (p,); friction_Nm, their deviations (6,): joint 1 at
    `earlier.SPEEDS_RAD_S`, then joint 2; inertia_kgm2 (3,); offset_Nm (n,): of the torque sensors, the configuration's
    included.
    """

    parameters: tuple[float, ...]
    friction_Nm: tuple[float, ...]
    friction_std_Nm: tuple[float, ...]
    inertia_kgm2: tuple[float, ...]
    inertia_std_kgm2: tuple[float, ...]
    offset_Nm: tuple[float, ...]
    offset_std_Nm: tuple[float, ...]
    is_payload: bool
    text: str

    def __repr__(self) -> str:
        inertia = ", ".join(f"{value:.3g}" for value in self.inertia_kgm2)
        return f"<Certificate{' with a payload' if self.is_payload else ''}: a1, a2, a3 = {inertia} kg m²>"


def constants_of(settings: Settings, compared: Vector, prior_std: Vector) -> dict[str, Vector]:
    """Return `last_compared` (q, p), `last_prior` (q,), `last_certified`, `_std`, `_floor`; nan of no last certificate.

    compared (…, p): the quantities of `earlier`; prior_std (p,). The deviations of the two frictions that a viscous
    friction is between count as if they were independent, which is more than they make.
    """
    history = settings.history
    counts = (earlier.FRICTIONS, earlier.INERTIAS, JOINTS)
    first = sum(counts[:2])
    slope = np.zeros((JOINTS, first))
    for i, speeds in enumerate(slope):
        speeds[[len(earlier.SPEEDS_RAD_S) * i, len(earlier.SPEEDS_RAD_S) * (i + 1) - 1]] = (-1.0, 1.0)
    slope /= earlier.SPEEDS_RAD_S[-1] - earlier.SPEEDS_RAD_S[0]
    quantities = np.vstack((np.eye(first), slope))
    last, std = np.full(sum(counts), np.nan), np.zeros(sum(counts))
    if history.is_known:
        last = quantities @ (*history.friction_Nm, *history.inertia_kgm2)
        std = np.sqrt(quantities**2 @ np.square((*history.friction_std_Nm, *history.inertia_std_kgm2)))
    share = np.repeat((history.friction_share, history.inertia_share, history.friction_share), counts)
    return {
        "last_compared": quantities @ compared[:first],
        "last_prior": np.square(quantities @ compared[:first]) @ prior_std**2,
        "last_certified": last,
        "last_certified_std": np.hypot(std, share * last),
        "last_certified_floor": np.repeat((FLOOR_NM, FLOOR_KGM2, FLOOR_NM_S), counts),
    }


def shapes_of() -> dict[str, tuple[int, ...]]:
    """Return the shapes of what is remembered, by name."""
    quantities = (earlier.FRICTIONS + earlier.INERTIAS + JOINTS,)
    return {"is_last_believed": (), "last_change": quantities, "last_limit": quantities}


def begin(k: Any, m: Any) -> None:
    """Believe the last certificate, if there is one."""
    m["is_last_believed"] = float(np.isfinite(k["last_certified"]).all())


def forget(m: Any) -> None:
    """Compare no more with the last certificate: the user says that nobody touches the arm."""
    m["is_last_believed"] = 0.0


@compiled
def contradicted_by(k: Any, m: Any) -> int:
    """Return what contradicts the fit: an anchor, the fit itself, what was kept, the last certificate, or nothing."""
    cause = NOTHING
    if not anchor.is_within(k, m, m["belief"], m["P_belief"]):
        cause = ANCHOR
    elif not (earlier.is_steady(m) and earlier.is_explained(k, m) and earlier.is_borne_out(k, m)):
        cause = CHANGED
    elif not earlier.is_no_more(k, m):
        cause = MORE
    if cause != NOTHING:
        return BY_PLACE if missing_torque.is_found(k, m) and cause == CHANGED else cause
    if not anchor.is_place_bounded(k, m):
        return TOO_MUCH_BY_PLACE
    return NOTHING if is_no_more(k, m) else MORE_THAN_LAST


@compiled
def is_no_more(k: Any, m: Any) -> bool:
    """Tell whether the fit has no more friction and inertia than the last certificate."""
    if m["is_last_believed"] == 0.0 or m["is_payload"] != 0.0:
        return True
    unit = earlier.unit_of(m["fit_square"], m["fit_rows"])
    is_agreed = True
    for q in range(m["last_change"].shape[0]):
        row = k["last_compared"][q]
        fitted = earlier.split(earlier.variance_of(row, m["P_belief"]), k["last_prior"][q], unit)
        m["last_change"][q] = earlier.value_of(row, m["belief"]) - k["last_certified"][q]
        m["last_limit"][q] = k["last_certified_floor"][q] + LAST_SIGMAS * np.sqrt(
            k["last_certified_std"][q] ** 2 + fitted
        )
        is_agreed = is_agreed and m["last_change"][q] <= m["last_limit"][q]
    return bool(is_agreed)


def describe_more(m: Any, date_utc: str) -> list[str]:
    """Say of which quantities the fit has more than the last certificate, and by how much, a line each."""
    excess = m["last_change"] / m["last_limit"]
    first = earlier.FRICTIONS + earlier.INERTIAS
    viscous = [(first + i, f"viscous friction of joint {i + 1}", "Nm s/rad") for i in range(JOINTS)]
    found = [*earlier.foremost(excess[:first]), *(row for row in viscous if excess[row[0]] > 1.0)]
    return [
        f"{what} is {float(m['last_change'][q]):.3f} {unit} more than in the certificate of {date_utc}, "
        f"bound {float(m['last_limit'][q]):.3f} {unit}"
        for q, what, unit in found
    ]


def certificate_of(k: Any, theta: Vector, P: Vector, is_payload: bool, text: str) -> Certificate:
    """Return what a model that was certified says. theta (p,), P (p, p): with the offsets; text: its event."""
    base, first = int(k["base"]), earlier.FRICTIONS
    rows = k["compared"][: first + earlier.INERTIAS]
    values = rows @ theta
    std = np.sqrt([row @ P @ row for row in rows])
    offsets = slice(base, base + JOINTS)
    return Certificate(
        parameters=tuple(theta[:base].tolist()),
        friction_Nm=tuple(values[:first].tolist()),
        friction_std_Nm=tuple(std[:first].tolist()),
        inertia_kgm2=tuple(values[first:].tolist()),
        inertia_std_kgm2=tuple(std[first:].tolist()),
        offset_Nm=tuple((k["zero_Nm"] + theta[offsets]).tolist()),
        offset_std_Nm=tuple(np.sqrt(np.diag(P)[offsets]).tolist()),
        is_payload=is_payload,
        text=text,
    )
