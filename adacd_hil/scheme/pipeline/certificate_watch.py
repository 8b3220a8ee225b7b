"""Messages about the certified scheme's certificates, and the user's replies to them."""

from typing import NamedTuple

import numpy as np

from adacd_hil.records import BEGINS_ANEW, JOINTS, BriefedEvent, Event, SchemeState, Vector
from adacd_hil.scheme.detect import sight
from adacd_hil.scheme.identify import anchor, certificate, earlier, missing_torque, place_bound
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.scheme.identify.doubt import CommonCause
from adacd_hil.scheme.memory import Constants, Memory
from adacd_hil.scheme.model.regressor import A5

THIS_RUN_ONLY = "friction and inertia: by this run only"
"""A drag or a mass held from before the first motion is learnt as these: one run alone cannot separate them."""
BY_WORD = "friction and inertia: by this run and the user's word, against "
BY_FITS_THAT_AGREE = "friction and inertia: by fits of this run that agree, other than it had learnt before a touch"
REPORT_EACH = 5
"""A lasting cause is reported once in so many refused fits, about each 7 s."""
_THE_RUN = "what the run had learnt before"
_TAKEN_BACK = "the certificate that was taken back"
_CHANGED = (
    "no one model explains the whole fit: something has touched the arm or let go while it was learnt, or the arm does "
    "what the model doesn't know"
)
_OR_MOUNTING = ", such as gravity that acts otherwise than arm.mounting_deg says"
_POSITION_REMEDY = "if it is the arm's, `arm.position_torque_Nm` lets the model have it, from the next start on"


_CONTRADICTIONS = {
    certificate.READING: ("anchor", "the drives stay off", "`accept` does without the tare"),
    certificate.ANCHOR: ("anchor", BEGINS_ANEW, "`accept` takes it for the sensor's zero"),
    certificate.CHANGED: ("touch", BEGINS_ANEW, "nobody may touch an arm that learns"),
    certificate.MORE: ("touch", BEGINS_ANEW, "`accept` says that nobody touches the arm"),
    certificate.BY_PLACE: ("position", BEGINS_ANEW, _POSITION_REMEDY),
    certificate.TOO_MUCH_BY_PLACE: (
        "position",
        BEGINS_ANEW,
        "who holds the arm shall let go, or that bound is too small",
    ),
    certificate.MORE_THAN_LAST: (
        "touch",
        BEGINS_ANEW,
        "`accept` says that nobody touches the arm, which has changed",
    ),
    certificate.BLIND: ("sight", BEGINS_ANEW, "`relearn` learns the arm anew"),
}
"""By contradiction: name of the event, consequence, remedy."""


class _Refusal(NamedTuple):
    """A refused reading at rest or fit: number of its contradiction, and its text, a line each.

    torque_Nm, std_Nm (n,): the torques that were judged, their standard deviations. times: refusals in a row.
    """

    cause: int
    torque_Nm: Vector
    std_Nm: Vector
    lines: list[str]
    times: int


class CertificateWatch:
    """Makes events of the kernel's findings on certificates, stores the certificates, and accepts a refused fit.

    last_utc: date of the last run's certificate, for texts.
    """

    def __init__(self, k: Constants, m: Memory, last_utc: str) -> None:
        self._k, self._m = k, m
        self._last = f"the certificate of {last_utc}"
        self._last_utc = last_utc
        self._refusal: _Refusal | None = None
        self._vouched_against = ""
        self._certificates: list[Certificate] = []
        self._is_standing = False

    @property
    def certificates(self) -> tuple[Certificate, ...]:
        """The run's certificates that were not taken back, oldest first."""
        return tuple(self._certificates)

    @property
    def is_refusing(self) -> bool:
        """Whether a refused reading at rest or fit still waits for the user.

        The user's `accept`, a new certificate, or the enabling of the drives ends the refusal.
        """
        return self._refusal is not None

    def enter(self, previous: SchemeState, state: SchemeState) -> Event | None:
        """Store a certificate and return its event if the state changes from CERTIFY to MONITOR; else return None.

        The event is a warning if no anchor bounds a joint's torque offset. A certificate, or the enabling of the
        drives, ends a refusal.
        """
        if state is SchemeState.ENABLE:
            self._refusal = None
        if state is not SchemeState.MONITOR or previous is not SchemeState.CERTIFY:
            return None
        self._refusal = None
        known_by, self._vouched_against = self._known_by(), ""
        k, m = self._k, self._m
        level = "warning" if anchor.open_joints(k, m) else "info"
        by_place = place_bound.describe(k, m)
        text = f"{anchor.describe(k, m)}; {sight.describe_sight(m)}; {known_by}{by_place}"
        self._is_standing = True
        self._certificates.append(certificate.certificate_of(k, m, text))
        return BriefedEvent.of(Event(level, "certificate", text), self._certified_in_brief(known_by))

    def _certified_in_brief(self, known_by: str) -> str:
        """Return a certificate's short text: unanchored joints, the smallest push, and a weak basis of its friction."""
        texts = [sight.describe_push(self._m)]
        joints = " and ".join(f"joint {i + 1}" for i in anchor.open_joints(self._k, self._m))
        if joints:
            texts.insert(0, f"warning: a lean on {joints} from before the start counts as a torque offset")
        return "; ".join([*texts, *[known_by] * known_by.startswith((BY_WORD, BY_FITS_THAT_AGREE))])

    def _known_by(self) -> str:
        """Return the evidence for the fit's friction and inertia as text.

        That is the user's word, fits that agree, the last certificate, or this run only.
        """
        if self._vouched_against:
            return BY_WORD + self._vouched_against
        if self._m.earlier.has_lapsed:
            return BY_FITS_THAT_AGREE
        is_compared = certificate.is_compared(self._m)
        return f"friction and inertia: within what {self._last} allows" if is_compared else THIS_RUN_ONLY

    def refuse(self) -> Event | None:
        """Store a refusal of the reading at rest or of a fit, with its cause; return the event to report, or None.

        None if the refusal before had the same cause; but each REPORT_EACH-th refusal of a fit in a row is reported
        again. Call it before the kernel forgets the fit.
        """
        before, m, cause = self._refusal, self._m, int(self._m.withheld_by)
        offsets = slice(int(self._k.first_offset), int(self._k.first_offset) + JOINTS)
        std_Nm = np.sqrt(np.diag(m.models.P_belief)[offsets])
        times = 1 if before is None else before.times + 1
        lines = self._describe(cause)
        self._refusal = _Refusal(cause, anchor.judged_Nm(m), std_Nm, lines, times)
        is_known = before is not None and before.cause == cause
        if is_known and (cause == certificate.READING or times % REPORT_EACH != 0):
            return None
        name, consequence, remedy = _CONTRADICTIONS[cause]
        again = [f"the {times}th fit in a row that is refused"] * is_known
        return Event("warning", name, "; ".join((*lines, *again, consequence, remedy)))

    def doubt(self, verdict: CommonCause) -> Event:
        """Take the certificate back because of contacts, and return the event with their common cause."""
        self._take_back()
        remedy = "`changed` learns it" if verdict.is_payload else "`relearn` learns the arm anew"
        return Event("warning", "revoked", f"{verdict.text}: the certificate is taken back, {remedy}")

    def revoke(self) -> Event:
        """Take the certificate back for the user and return the event; call it before kept beliefs are dropped.

        The next certificate names the user's word if a certificate stood or beliefs are kept.
        """
        if earlier.is_keeping(self._m):
            self._vouched_against = _THE_RUN
        self._take_back()
        return Event("warning", "revoked", "at the user's word the arm is learnt anew")

    def _take_back(self) -> None:
        """Remove the last certificate from `certificates` if it still stands.

        The next certificate then names the user's word against it.
        """
        if self._is_standing:
            self._certificates.pop()
            self._vouched_against = _TAKEN_BACK
        self._is_standing = False

    def push(self, torque_Nm: Vector) -> Event:
        """Return the event that something still pushes the stopped arm. torque_Nm (n,): external, filtered.

        Stores nothing.
        """
        torque = ", ".join(f"{value:.2f}" for value in torque_Nm)
        remedy = "if nobody touches it the model is wrong, and `relearn` learns it anew"
        text = f"something still pushes the arm at rest, {torque} Nm by joint: {remedy}"
        rounded = " / ".join(f"{round(float(value), 1) + 0.0:.1f}" for value in torque_Nm)
        brief = (
            f"something still pushes the arm, {rounded} Nm at the joints: let go; if nothing touches it, the model has "
            "become wrong: `relearn`"
        )
        return BriefedEvent.of(Event("warning", "touch", text), brief)

    def contradiction(self) -> CommonCause:
        """Return the kernel's contradiction of a certificate in MONITOR, `withheld_by`, as a common cause.

        It is an offset, a torque that depends on the position, or a smallest push that has grown.
        """
        return CommonCause("; ".join(self._describe(int(self._m.withheld_by))), is_payload=False)

    def _describe(self, cause: int) -> list[str]:
        """Return the lines of a contradiction: the quantities that contradict each other, with their bounds.

        cause: its number in `certificate`.
        """
        k, m = self._k, self._m
        match cause:
            case certificate.READING | certificate.ANCHOR:
                lines = anchor.describe_refused(m, is_reading=cause == certificate.READING)
            case certificate.CHANGED:
                lines = [_CHANGED + (_OR_MOUNTING if k.first_offset > A5 else "")]
            case certificate.MORE:
                lines = earlier.describe_more(m)
            case certificate.BY_PLACE:
                lines = missing_torque.describe(m)
            case certificate.TOO_MUCH_BY_PLACE:
                lines = place_bound.describe_refused(k, m)
            case certificate.MORE_THAN_LAST:
                lines = certificate.describe_more(m, self._last_utc)
            case _:
                lines = sight.describe_dim(m)
        return lines

    def accept(self) -> Event:
        """Drop the evidence that refuses a fit or reading, at the user's request; return a warning to report.

        By cause: a reading at rest drops the tare; an excluded offset makes the refused offsets the only anchor; an
        excess over the last certificate drops that certificate; any other cause drops the kept beliefs. This ends the
        refusal. In the last two cases the next certificate names the user's word. Without a refusal change no evidence.
        """
        refusal, self._refusal = self._refusal, None
        if refusal is None:
            return Event("warning", "anchor", "nothing to accept: no certificate is withheld")
        torque = ", ".join(f"{value:.3f}" for value in refusal.torque_Nm)
        match refusal.cause:
            case certificate.READING:
                anchor.accept_reading(self._m)
                text = f"the user accepts {torque} Nm at rest: the tare is not used"
            case certificate.ANCHOR:
                anchor.accept(self._m, refusal.torque_Nm, refusal.std_Nm)
                text = f"the user accepts {torque} Nm as the zero of the sensors"
            case certificate.MORE_THAN_LAST:
                certificate.forget(self._m)
                self._vouched_against = self._last
                text = f"the user says that nobody touches the arm: {self._last} is not compared"
            case _:
                earlier.forget(self._m)
                self._vouched_against = _THE_RUN
                text = "the user says that nobody touches the arm: what was learnt before is not compared"
        return Event("warning", _CONTRADICTIONS[refusal.cause][0], text)

    def describe(self) -> list[str]:
        """Return the lines of the present refusal: causes, number of refused fits, remedy; [] without a refusal.

        A refused reading at rest has no such number.
        """
        if self._refusal is None:
            return []
        is_reading = self._refusal.cause == certificate.READING
        withheld = [] if is_reading else [f"certificates withheld: {self._refusal.times}"]
        return [*self._refusal.lines, *withheld, _CONTRADICTIONS[self._refusal.cause][2]]
