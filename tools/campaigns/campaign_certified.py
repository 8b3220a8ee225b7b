"""The certified scheme behind the campaign's one call; see `campaign_schemes`."""

from dataclasses import replace

import numpy as np
from campaign_schemes import ADAPTING, ARMED, TESTING, Outcome
from lab import PERIOD_S, Motion, Recording, paper_motion
from played_record import play_record

from adacd_hil.control.motions import Excitation
from adacd_hil.records import JOINTS, SchemeState
from adacd_hil.scheme.detect.undone_filter import WIDE_SAMPLES
from adacd_hil.scheme.model.filter_bank import WIDE
from adacd_hil.scheme.supervisor.findings import CONTACT_SHIFT
from adacd_hil.settings.configuration import Settings

_PHASES = {int(SchemeState.CERTIFY): TESTING, int(SchemeState.MONITOR): ARMED}


class CertifiedScheme:
    """The certified scheme as a configuration has it."""

    patience_s = 12.0

    def __init__(self, name: str, settings: Settings) -> None:
        self.name = name
        self._settings = settings

    def adaptation_motion(self, is_payload: bool) -> Motion:  # noqa: ARG002
        """Return the excitation of the configuration, or where it has none the paper's motion."""
        excitation = Excitation(self._settings)
        if not excitation.is_on:
            return paper_motion(self.patience_s)
        q_d, dq_d, ddq_d = (np.zeros((round(self.patience_s / PERIOD_S), JOINTS)) for _ in range(3))
        for k in range(len(q_d)):
            excitation.evaluate(k * PERIOD_S, q_d[k], dq_d[k], ddq_d[k])
        return Motion("excitation", q_d, dq_d, ddq_d)

    def run(self, recording: Recording, begins: tuple[int, ...]) -> Outcome:
        """Play a recording through the compiled step; the second of `begins` is a payload's."""
        settings = replace(
            self._settings, arm=replace(self._settings.arm, link_length_m=recording.arm.arm.link_length_m)
        )
        n = len(recording.q)
        payload_at = begins[1] if len(begins) > 1 else -1
        played = play_record(settings, recording.q, recording.dq, recording.tau_J, payload_at)
        y, h = played.y, played.h
        phase = np.full(n, ADAPTING)
        for number, its in _PHASES.items():
            phase[played.state == number] = its
        armed = []
        for begin, end in zip(begins, (*begins[1:], n), strict=True):
            cycles = np.flatnonzero(phase[begin:end] == ARMED)
            armed.append(begin + int(cycles[0]) if cycles.size else -1)
        over = played.observation.astype(np.int64) >> CONTACT_SHIFT
        wide = self._undo(y[:, WIDE], settings.certified.cutoffs_rad_s[WIDE])
        most = np.argmax(np.abs(y) / h, axis=1)[:, np.newaxis]
        direction = np.sign(np.take_along_axis(y, most, axis=1)[:, 0])
        return Outcome(phase, over, y[:, 0], wide, h[:, 0], direction, tuple(armed), played.theta[np.maximum(armed, 0)])

    @staticmethod
    def _undo(y: np.ndarray, cutoff_rad_s: float) -> np.ndarray:
        """Undo a filter, as `adacd_hil.scheme.detect.undone_filter.undo_filter` does."""
        decay = np.exp(-cutoff_rad_s * PERIOD_S)
        sharp = y.copy()
        sharp[1:] = (y[1:] - decay * y[:-1]) / (1.0 - decay)
        total = np.cumsum(np.vstack((np.zeros((WIDE_SAMPLES, JOINTS)), sharp)), axis=0)
        wide: np.ndarray = (total[WIDE_SAMPLES:] - total[:-WIDE_SAMPLES]) / WIDE_SAMPLES
        return wide
