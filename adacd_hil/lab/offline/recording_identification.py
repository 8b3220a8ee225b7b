"""Identification of a foreign recording: fit on free motion, test on other motion, contacts in further recordings.

A touch in the fitted recording is learnt, unless the map names a column of touches; touched samples are left out. The
figure shows the external torque of each joint against its threshold, and the contacts. The thresholds of the test are
those of its margin, from noise and the parameters' covariance. Thresholds of other recordings are wider by the model
error that the test shows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from adacd_hil.lab.drawing import COLOURS, Drawing, note, plot, style
from adacd_hil.lab.offline.column_checks import column_faults
from adacd_hil.lab.offline.recorded_columns import SHORTEST_SAMPLES
from adacd_hil.lab.offline.recording_import import ForeignRecording, RecordingStretch
from adacd_hil.lab.offline.recording_map import RecordingMap
from adacd_hil.lab.offline.recording_verdict import Fitted, Verdict, judge_fit
from adacd_hil.lab.serial_arm import offline
from adacd_hil.lab.serial_arm.offline import ModelEstimate, OfflineSettings
from adacd_hil.log.log_files import LogError
from adacd_hil.records import Vector
from adacd_hil.score.judge import contacts_of_alarms, explained_until

FIT_SHARE = 0.6
"""Share of a recording that is fitted if the rest of it is the test."""


class Spell(NamedTuple):
    """A detected contact. start_s: since the recording's first row. link: from 1.

    direction (n,): sign of each joint's external torque. is_true: whether the arm was touched then; None if unknown.
    """

    start_s: float
    link: int
    direction: tuple[int, ...]
    is_true: bool | None  # None if touches are unknown


@dataclass(frozen=True)
class Watched:
    """External torques, thresholds and contacts that the model shows in a recording, fitted parts of it included.

    tau_ext_hat, threshold: of each stretch (k, n), Nm. touches, missed: numbers of touches, and of undetected ones;
    None if touches are unknown. delays_s: from the begin of each detected touch to its detection.
    """

    recording: ForeignRecording
    tau_ext_hat: tuple[Vector, ...]  # per stretch (k, n), Nm
    threshold: tuple[Vector, ...]
    contacts: tuple[Spell, ...]
    touches: int | None  # None if unknown
    missed: int | None
    delays_s: tuple[float, ...]  # of the detected touches
    faults: tuple[str, ...] = ()
    """Defects of its columns with which contacts can't be told, a line each."""

    @property
    def false_contacts(self) -> int | None:
        """Number of detected contacts that belong to no touch; None if touches are unknown."""
        return None if self.touches is None else sum(contact.is_true is False for contact in self.contacts)


@dataclass(frozen=True)
class Identified(Fitted):
    """A fit with its verdict. test: contacts found in the test, which should be none.

    watched: those in further recordings.
    """

    verdict: Verdict
    test: Watched
    watched: tuple[Watched, ...]

    def __repr__(self) -> str:
        return f"<Identified: {self.verdict.headline}>"

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints (n,)."""
        return self.described.urdf.joint_names

    @property
    def notes(self) -> dict[Path, tuple[str, ...]]:
        """Dropped rows and assumptions, by path of the fitted and tested recordings; watched ones are left out."""
        return {recording.path: recording.notes for recording in (*self.fitted, self.tested)}

    @property
    def is_explained(self) -> bool:
        """Whether the verdict is that the model explains the torque of the test; see `recording_verdict`."""
        return self.verdict.is_explained

    @property
    def explained(self) -> Vector:
        """Share (n,) of each joint's torque that the model explains in the test; negative if worse than a constant.

        nan for a joint without torque.
        """
        return np.array([joint.share for joint in self.verdict.joints])

    def by_key(self) -> dict[str, Any]:
        """Return the result by the keys of identify.json; values are numpy arrays, paths and tuples, too."""
        names, certificate, verdict = self.model.parameter_names, self.certificate, self.verdict
        return {
            "parameters": {
                name: {"value": value, "std": std}
                for name, value, std in zip(names, self.estimate.theta, self.deviation, strict=True)
            },
            "fit_s": self.fit_s,
            "period_s": self.settings.period_s,
            "noise_Nm": self.settings.noise_Nm,
            "velocity_noise_rad_s": self.settings.velocity_noise_rad_s,
            "test": {
                "seconds": self.test.recording.duration_s,
                "verdict": {
                    "is_explained": verdict.is_explained,
                    "headline": verdict.headline,
                    "reasons": verdict.reasons,
                    "remarks": verdict.remarks,
                    "next": verdict.remedy,
                },
                "margin": certificate.margin,
                "margins": dict(zip(self.joint_names, certificate.margins, strict=True)),
                "explained": dict(zip(self.joint_names, self.explained, strict=True)),
                "residual_rms_Nm": certificate.residual_rms_Nm,
                "residual_max_Nm": certificate.residual_max_Nm,
                "lack_Nm": certificate.lack_Nm,
            },
            "left_out": self.notes,
            "watched": [
                {
                    "recording": watched.recording.path,
                    "contacts": watched.contacts,
                    "touches": watched.touches,
                    "missed": watched.missed,
                    "false_contacts": watched.false_contacts,
                    "delays_s": watched.delays_s,
                    "faults": watched.faults,
                }
                for watched in self.watched
            ],
        }


def identify(
    described: RecordingMap,
    fitted: Sequence[ForeignRecording],
    tested: ForeignRecording | None,
    watched: Sequence[ForeignRecording] = (),
) -> Identified:
    """Fit one model to all recordings, test it on another one, and detect contacts in further ones.

    tested: None: of the last recording the first `FIT_SHARE` of its time is fitted, and the rest tested. watched:
    further recordings. Samples during a known touch are neither fitted nor tested. Period and noise are those of the
    last fitted recording, except noise that the map gives. Raises LogError if a fitted recording has no stretch, or too
    little free motion is left to fit or to test; ConfigError if the map's settings of the scheme are invalid.
    """
    for recording in fitted:
        if not recording.stretches:
            raise LogError(f"{recording.path}: no {SHORTEST_SAMPLES} samples in a row lie in the part to fit")
    recordings = [recording.free for recording in fitted]
    if tested is None:
        last = recordings[-1]
        if not last.stretches:
            raise LogError(f"{last.path}: no part is free of touches")
        start_s, end_s = last.span_s
        split_s = start_s + FIT_SHARE * (end_s - start_s)
        recordings[-1], tested = last.between(-np.inf, split_s), last.between(split_s, np.inf)
    tested = tested.free
    if not tested.stretches or not any(recording.stretches for recording in recordings):
        raise LogError(
            f"too little free motion to fit or to test: both need {SHORTEST_SAMPLES} samples in a row, "
            f"{SHORTEST_SAMPLES * tested.period_s:g} s at {tested.period_s * 1e3:g} ms"
        )
    source = recordings[-1]
    settings = described.settings(source.noise_Nm, source.period_s, source.velocity_noise_rad_s)
    model = offline.model_of(described.urdf.chain, described.arm.has_rotors)
    before = estimate = offline.prior(model)
    records = [record for recording in recordings for record in recording.records]
    for record in records:
        estimate = offline.identify(model, record, estimate, settings)
    deviation = offline.parameter_deviation(model, records, before, estimate, settings)
    certificate = offline.certify(model, tested.records, estimate, settings)
    fit = Fitted(described, model, settings, before, estimate, deviation, certificate, tuple(recordings), tested)
    return Identified(
        **vars(fit),
        verdict=judge_fit(fit),
        test=watch(model, settings, estimate, np.zeros(model.joints), tested),
        watched=tuple(
            examined(described, watch(model, settings, estimate, certificate.lack_Nm, recording))
            for recording in watched
        ),
    )


_MOST_OVER: Final = 0.5
"""Share of the time over a threshold from which on the model, not a touch, is taken for the cause."""


def examined(described: RecordingMap, watched: Watched) -> Watched:
    """Return a watched recording with the defects for which its contacts can't be told, in `faults`.

    Those are dead or wrong columns, else a torque over a threshold for over `_MOST_OVER` of the time.
    """
    faults = [fault.text for fault in column_faults(described, [watched.recording]) if fault.is_dead or fault.is_wrong]
    pairs = zip(watched.tau_ext_hat, watched.threshold, strict=True)
    is_over = np.concatenate([(np.abs(tau) > threshold).any(axis=1) for tau, threshold in pairs])
    if not faults and is_over.mean() > _MOST_OVER:
        faults.append(f"the torque is over a threshold for {is_over.mean():.0%} of the time: is it of this arm?")
    return replace(watched, faults=tuple(faults))


def watch(
    model: offline.ArmModel,
    settings: OfflineSettings,
    estimate: ModelEstimate,
    lack_Nm: Vector,
    recording: ForeignRecording,
) -> Watched:
    """Detect contacts in a recording, and compare them with its touches if these are known.

    The first contact of a touch detects it; a contact of no touch is false. lack_Nm: model error (n,), by which the
    thresholds are widened; 0: thresholds from noise and covariance only. `faults` of the result is empty: columns
    aren't checked.
    """
    detections = [offline.detect(model, part.record, estimate, settings, lack_Nm) for part in recording.stretches]
    spells: list[Spell] = []
    delays: list[float] = []
    touches: int | None = None
    for stretch, detection in zip(recording.stretches, detections, strict=True):
        samples = np.array([sample for sample, _, _ in detection.contacts], np.int64)
        about = _touch_indices(stretch, samples, recording, settings)
        for (sample, link, direction), place in zip(detection.contacts, about.tolist(), strict=True):
            is_true = None if stretch.is_touched is None else place >= 0
            start_s = stretch.start_s + sample * recording.period_s
            spells.append(Spell(start_s, link + 1, direction, is_true))
        if stretch.is_touched is not None:
            touches = (touches or 0) + len(stretch.touches)
            places, firsts = np.unique(about, return_index=True)
            found = zip(places.tolist(), samples[firsts].tolist(), strict=True)
            delays += [(at - stretch.touches[k][0]) * recording.period_s for k, at in found if k >= 0]
    return Watched(
        recording=recording,
        tau_ext_hat=tuple(detection.tau_ext_hat for detection in detections),
        threshold=tuple(detection.threshold for detection in detections),
        contacts=tuple(spells),
        touches=touches,
        missed=None if touches is None else touches - len(delays),
        delays_s=tuple(delays),
    )


def _touch_indices(
    stretch: RecordingStretch, samples: NDArray[np.int64], recording: ForeignRecording, settings: OfflineSettings
) -> NDArray[np.int64]:
    """Return the index of the touch to which each contact belongs, -1 without one.

    samples: index of each contact's first sample. A touch explains contacts from `blur_s` before it, for derived
    velocities, to `isolation_s` after it. From `blur_s` before the next touch on, it explains no more.
    """
    firsts, ends = np.array(stretch.touches, np.int64).reshape(-1, 2).T
    onsets = firsts - round(recording.blur_s / recording.period_s)
    return contacts_of_alarms(
        samples, onsets, explained_until(onsets, ends - 1 + round(settings.isolation_s / settings.period_s))
    )


def draw_watched(identified: Identified, watched: Watched, name: str) -> Drawing:
    """Draw a recording's external torques, thresholds, contacts and touches over time, a panel per joint.

    name: of the drawing.
    """
    n = identified.model.joints
    with style():
        figure = Figure(figsize=(7.2, 0.9 + 1.3 * n), layout="constrained")
        panels = np.atleast_1d(figure.subplots(n, 1, sharex=True))
        for joint, axes in enumerate(panels):
            for stretch, tau_ext_hat, threshold in zip(
                watched.recording.stretches, watched.tau_ext_hat, watched.threshold, strict=True
            ):
                time_s = stretch.start_s + watched.recording.period_s * np.arange(len(tau_ext_hat), dtype=np.float64)
                plot(axes, time_s, tau_ext_hat[:, joint], color=COLOURS["joint1"], linewidth=0.8)
                for sign in (-1.0, 1.0):
                    plot(axes, time_s, sign * threshold[:, joint], color=COLOURS["muted"], linewidth=0.6)
                if stretch.is_touched is not None:
                    axes.fill_between(
                        time_s, 0.0, 1.0, where=stretch.is_touched, transform=axes.get_xaxis_transform(), alpha=0.15
                    )
            for contact in watched.contacts:
                axes.axvline(contact.start_s, color=COLOURS["joint2"], linewidth=0.6)
            axes.set_ylabel("Nm")
            note(axes, identified.joint_names[joint])
        panels[-1].set_xlabel("time, s")
    caption = (
        f"Estimated external torque between its thresholds; lines: {len(watched.contacts)} contacts found; "
        "shaded: touches, where they are known."
    )
    return Drawing(name, watched.recording.path.name, caption, figure)
