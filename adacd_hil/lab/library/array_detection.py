"""Arrays of any serial arm through the offline scheme: a model from free motion, its test, contacts in the rest.

The steps and their equations: `adacd_hil.lab.serial_arm.offline`. Only the arm's geometry must be known; masses,
friction and the torque sensors' offsets are identified.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from adacd_hil.file_access import read_input
from adacd_hil.lab.offline.column_checks import IN_MAP
from adacd_hil.lab.offline.recorded_columns import LARGEST, SHORTEST_SAMPLES, RecordedColumns
from adacd_hil.lab.offline.recording_identification import Identified, examined, identify, watch
from adacd_hil.lab.offline.recording_import import (
    LONGEST_PERIOD_S,
    SHORTEST_PERIOD_S,
    ForeignRecording,
    recording_of,
)
from adacd_hil.lab.offline.recording_map import ArmSection, ColumnsSection, RecordingMap, checked_scheme
from adacd_hil.lab.offline.recording_verdict import Verdict
from adacd_hil.lab.serial_arm.urdf import STANDARD_GRAVITY_M_S2, SerialArm, read_urdf
from adacd_hil.log.log_files import LogError
from adacd_hil.log.robot_description import robot_description
from adacd_hil.printable import number_of
from adacd_hil.records import Vector
from adacd_hil.remedies import hint
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError

FIT_SHARE: Final = 0.4
"""Share of the arrays, from the beginning, that is taken for free motion by default."""
_REQUIRED: Final = ("t", "q", "tau_J")
_OPTIONAL: Final = ("dq", "touched")
_ALIASES: Final = {"t_s": "t", "time": "t", "qd": "dq", "tau": "tau_J"}
_KNOWN: Final = (*_REQUIRED, *_OPTIONAL, *_ALIASES)
_LONGEST_LAG_S: Final = 0.05
_UNITS: Final = {"t": "s", "q": "rad", "dq": "rad/s", "tau_J": "Nm"}


class ArrayError(ValueError):
    """Arrays or options can't be used; the message is one line with the reason."""


@dataclass(frozen=True)
class OfflineArm:
    """A serial arm of n joints: its geometry, and whether the torques are those of geared motors."""

    serial: SerialArm
    has_rotors: bool = False

    @classmethod
    def from_urdf(
        cls,
        urdf: str | Path,
        *,
        gravity_m_s2: tuple[float, float, float] = STANDARD_GRAVITY_M_S2,
        locked: tuple[str, ...] = (),
        has_rotors: bool = False,
    ) -> Self:
        """Return the arm that a URDF describes. Inertias in it are not needed.

        urdf: a file, or its text, which has a "<". gravity_m_s2: in the axes of the root link. locked: joints that do
        not move, as of a gripper. has_rotors: the torques are those of geared motors, which turn their rotors too.
        Raises UrdfError, a ValueError, if it is no usable URDF; ConfigError, a ValueError, for another argument;
        OSError if the file can't be read.
        """
        given = {"gravity_m_s2": gravity_m_s2, "locked": locked, "has_rotors": has_rotors}
        parse(ArmSection, {"urdf": ""} | {key: _plain(value) for key, value in given.items()}, "")
        text = urdf if isinstance(urdf, str) and "<" in urdf else read_input(Path(urdf))
        return cls(read_urdf(text, gravity_m_s2, locked), has_rotors)

    @classmethod
    def from_config(cls, config: str | Path, profile: str | None = None) -> Self:
        """Return the two-joint arm of a configuration, without rotors.

        config: a name or a TOML file. profile: of an emulated arm; None: the configuration's. Raises ConfigError, a
        ValueError, if it can't be used.
        """
        return cls(read_urdf(robot_description(load_settings(str(config), profile))))

    def __repr__(self) -> str:
        name = self.serial.name or "without a name"
        return f"<Arm {name}: {number_of(self.joints, 'joint')}, {' '.join(self.joint_names)}>"

    @property
    def joints(self) -> int:
        """Number of joints, n."""
        return len(self.serial.joint_names)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints (n,), from the base outward."""
        return self.serial.joint_names


def _plain(value: Any) -> Any:
    """Return a setting as TOML would give it: tuples and arrays as lists, numpy's numbers as Python's.

    The elements of a tuple, and other values, stay as they are.
    """
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return list(value) if isinstance(value, tuple) else value


class ArrayContact(NamedTuple):
    """A contact: time of detection, on the arrays' time; link from 1; sign of each joint's external torque (n,).

    A sign is 0 if that joint did not cross its threshold.
    """

    t_s: float
    link: int
    direction: tuple[int, ...]


@dataclass(frozen=True)
class FittedModel:
    """A model fitted to free motion, and tested on other motion.

    names, theta, std: parameters (p,) and their standard deviations. margin: smallest threshold over residual in the
    test; below 1 the model lacks more than noise. explained: share (n,) of each joint's torque that the model explains
    in the test, nan without torque. identified: fit, test and settings in full.
    """

    arm: OfflineArm
    names: tuple[str, ...]
    theta: Vector
    std: Vector
    margin: float
    explained: Vector
    identified: Identified

    @property
    def verdict(self) -> Verdict:
        """The verdict of the test: whether the model explains the torque, with reasons, remarks and the next step.

        A step that is a line of a recording's map names it as a conversion of the arrays.
        """
        verdict = self.identified.verdict
        remedy = verdict.remedy.replace(IN_MAP, "convert the arrays, as the map of a recording would: ")
        return replace(verdict, remedy=remedy)

    def __repr__(self) -> str:
        return f"<Model of {number_of(self.arm.joints, 'joint')}: {self.verdict.headline}>"


@dataclass(frozen=True)
class ArrayDetection:
    """Contacts in arrays, in the order of time, and external torques with their thresholds of m samples.

    t_s (m,), s; tau_ext_hat, threshold (m, n), Nm. Their period is fixed; if that of the arrays is, they are the
    samples of the arrays. Gaps split them, and parts of fewer than `SHORTEST_SAMPLES` are left out. faults: defects of
    the arrays with which contacts can't be told, such as a dead sensor, a line each; () without one.
    """

    model: FittedModel
    t_s: Vector
    tau_ext_hat: Vector
    threshold: Vector
    contacts: tuple[ArrayContact, ...]
    faults: tuple[str, ...] = ()

    def __repr__(self) -> str:
        seconds = self.t_s.size * self.model.identified.settings.period_s
        found = f"{number_of(len(self.contacts), 'contact')} in {seconds:.1f} s"
        found += f", not judged: {self.faults[0]}" if self.faults else ""
        return f"<Detection: {found}; model {self.model.verdict.headline}>"


def fit(
    arrays: Mapping[str, ArrayLike],
    arm: OfflineArm,
    *,
    fit_s: tuple[float, float] | None = None,
    velocity_lag_s: float = 0.0,
    **scheme: Any,
) -> FittedModel:
    """Fit a model to the first 60 % of the free motion in arrays, and test it on the rest.

    Free motion: the span `fit_s` of `t`, by default the first 40 %, without touched samples. Arguments: as of `detect`.
    Raises ArrayError, a ValueError, for unusable input or too little motion. Look at the model's `verdict` first: it
    tells whether the model explains the torque.
    """
    return _fitted(_taken(arrays, arm, velocity_lag_s), arm, fit_s, scheme)


def _fitted(
    recording: ForeignRecording, arm: OfflineArm, fit_s: tuple[float, float] | None, scheme: Mapping[str, Any]
) -> FittedModel:
    """Fit a model to the first 60 % of the free motion of a recording, and test it on the rest.

    fit_s: its span in the arrays' time; None: the first `FIT_SHARE` of the recording. Touched samples are left out.
    Raises ArrayError if that is too little motion or no span, or `scheme` has an invalid setting.
    """
    start_s, end_s = _span(recording, fit_s)
    described = _described(arm, recording.columns.values.shape[1] > 2 * arm.joints, scheme)
    try:
        found = identify(described, [recording.between(start_s, end_s)], None)
    except LogError:
        begin_s = recording.columns.begin_s
        bounds = f"{begin_s + start_s:g} to {begin_s + end_s:g} s"
        raise ArrayError(
            f"too little free motion to fit from {bounds}: {2 * SHORTEST_SAMPLES} samples in a row are the least"
        ) from None
    return FittedModel(
        arm=arm,
        names=found.model.parameter_names,
        theta=found.estimate.theta,
        std=found.deviation,
        margin=found.certificate.margin,
        explained=found.explained,
        identified=found,
    )


def detect(
    arrays: Mapping[str, ArrayLike],
    arm: OfflineArm,
    *,
    model: FittedModel | None = None,
    fit_s: tuple[float, float] | None = None,
    velocity_lag_s: float = 0.0,
    **scheme: Any,
) -> ArrayDetection:
    """Run the offline scheme over recorded arrays: fit, test, then detect contacts from the first sample to the last.

    arrays: `t` (k,) s, increasing; `q` (k, n) rad; `tau_J` (k, n) Nm, positive along the joint's axis; optionally `dq`
    (k, n) rad/s, else derived from q; `touched` (k,) bool, true while the arm is touched, left out of the fit. `time`,
    `qd` and `tau` stand for `t`, `dq` and `tau_J`. All finite; except t, at most 1e6 in size. Gaps in time split them;
    parts of fewer than `SHORTEST_SAMPLES` are left out.

    model: of `fit`, with dq as here, instead of a fit here; it excludes fit_s and scheme. fit_s: span of `t` in which
    the arm moves freely; default: the first 40 %. A touch in it is learnt. velocity_lag_s: time by which dq is older
    than tau_J, as behind a tracking loop; 1.25e-3 for the emulated drives. scheme: `OfflineSettings` by name, such as
    detection_cutoff_rad_s=20.0, deviations=6.0, noise_Nm=(0.02, 0.02); the default noise is estimated from the arrays.

    Raises ArrayError, a ValueError, for unusable input, too little free motion, or a model of another arm, period or
    kind of velocity.
    """
    recording = _taken(arrays, arm, velocity_lag_s)
    begin_s = recording.columns.begin_s
    if not isinstance(model, FittedModel | None):
        raise ArrayError(f"model is of {type(model).__name__}, a Model is expected, as of `fit`")
    if model is None:
        model = _fitted(recording, arm, fit_s, scheme)
    elif fit_s is not None or scheme:
        raise ArrayError(
            f"model is given, and so is {'fit_s' if fit_s is not None else next(iter(scheme))}: choose one"
        )
    found = model.identified
    _check_arm(model, arm)
    if (has_dq := recording.columns.values.shape[1] > 2 * arm.joints) != bool(found.described.columns.dq):
        given, fitted = ("given", "without") if has_dq else ("missing", "with")
        raise ArrayError(f"dq is {given}, the model was fitted {fitted} it: thresholds hold for one kind of velocity")
    period_s = found.settings.period_s
    if not math.isclose(recording.period_s, period_s, rel_tol=0.05):
        raise ArrayError(f"t has a period of {recording.period_s:g} s, the model was fitted at {period_s:g} s")
    watched = watch(found.model, found.settings, found.estimate, found.certificate.lack_Nm, recording)
    watched = examined(found.described, watched)
    stretches = recording.stretches
    t_s = [begin_s + each.start_s + recording.period_s * np.arange(len(each.record.q)) for each in stretches]
    return ArrayDetection(
        model=model,
        t_s=np.concatenate(t_s),
        tau_ext_hat=np.concatenate(watched.tau_ext_hat),
        threshold=np.concatenate(watched.threshold),
        contacts=tuple(ArrayContact(begin_s + each.start_s, each.link, each.direction) for each in watched.contacts),
        faults=watched.faults,
    )


def _check_arm(model: FittedModel, arm: OfflineArm) -> None:
    """Raise ArrayError if a model is of an arm with another number of joints, geometry, gravity or `has_rotors`."""
    if model.arm.joints != arm.joints:
        raise ArrayError(f"model is of {model.arm.joints} joints, the arm has {arm.joints}")
    if model.arm.has_rotors != arm.has_rotors or not all(map(np.allclose, model.arm.serial.chain, arm.serial.chain)):
        raise ArrayError("model is of another arm: geometry, gravity or `has_rotors` differ")


def _named(arrays: Mapping[str, ArrayLike]) -> dict[str, ArrayLike]:
    """Return the arrays by the names `t`, `q`, `tau_J`, `dq` and `touched`, whatever synonym was given.

    Raises ArrayError for one that is unknown, missing or given twice, and for no mapping.
    """
    if not isinstance(arrays, Mapping):
        raise ArrayError(f"arrays are of {type(arrays).__name__}, a mapping from names is expected, as `run.motion`")
    named: dict[str, ArrayLike] = {}
    for given, values in arrays.items():
        name = _ALIASES.get(given, given)
        if name not in (*_REQUIRED, *_OPTIONAL):
            raise ArrayError(f"unknown array {given!r}; {hint(str(given), _KNOWN)}")
        if name in named:
            raise ArrayError(f"array {name!r} is given twice, once as {given!r}")
        named[name] = values
    for name in _REQUIRED:
        if name not in named:
            raise ArrayError(f"array {name!r} is missing; there are {', '.join(arrays) or 'none'}")
    return named


def _taken(arrays: Mapping[str, ArrayLike], arm: OfflineArm, velocity_lag_s: float) -> ForeignRecording:
    """Return arrays as a recording at a fixed period, the median one of `t`; move velocities to the torques' times.

    velocity_lag_s: time by which velocities are older than torques; they are interpolated, and the last one is held.
    Raises ArrayError if an array is unknown, missing or given twice, or has a wrong shape, type or value; if times
    don't grow, their period is outside `SHORTEST_PERIOD_S` to `LONGEST_PERIOD_S`, gaps leave too few samples in a row,
    the lag is out of its range, or `arm` is no OfflineArm.
    """
    named = _named(arrays)
    if not isinstance(arm, OfflineArm):
        raise ArrayError(f"arm is of {type(arm).__name__}, an Arm is expected, as of Arm.from_urdf")
    t_s = _numbers("t", named["t"])
    if t_s.ndim != 1 or t_s.size < SHORTEST_SAMPLES:
        raise ArrayError(f"t has shape {t_s.shape}, (k,) with k ≥ {SHORTEST_SAMPLES} is expected")
    backward = np.flatnonzero(~(np.diff(t_s) > 0.0))
    if backward.size:
        row = int(backward[0]) + 1
        raise ArrayError(f"t[{row}] = {t_s[row]:.9g} s is not after t[{row - 1}] = {t_s[row - 1]:.9g} s")
    period_s = float(np.median(np.diff(t_s)))
    if not SHORTEST_PERIOD_S <= period_s <= LONGEST_PERIOD_S:
        bounds = f"{SHORTEST_PERIOD_S:g} to {LONGEST_PERIOD_S:g} s are expected"
        raise ArrayError(f"t has a median period of {period_s:g} s, {bounds}")
    _check_lag(velocity_lag_s, "dq" in named)
    columns = []
    for name in ("q", "tau_J", *(("dq",) if "dq" in named else ())):
        values = _numbers(name, named[name])
        if values.shape != (t_s.size, arm.joints):
            raise ArrayError(f"{name} has shape {values.shape}, ({t_s.size}, {arm.joints}) is expected")
        columns.append(values)
    if velocity_lag_s:
        columns[-1] = np.column_stack([np.interp(t_s + velocity_lag_s, t_s, column) for column in columns[-1].T])
    touched = None
    if "touched" in named:
        try:
            touched = np.asarray(named["touched"])
        except ValueError as error:
            raise ArrayError(f"touched can't be read: {error}") from None
        if touched.shape != t_s.shape or touched.dtype.kind not in "bui":
            raise ArrayError(f"touched has shape {touched.shape} of {touched.dtype}, ({t_s.size},) of bool is expected")
        touched = touched.astype(np.bool_)
    described = _described(arm, "dq" in named, {})
    try:
        given = RecordedColumns(t_s, float(t_s[0]), np.hstack(columns), touched, ())
        return recording_of(Path("arrays"), described, given)
    except LogError as error:
        raise ArrayError(str(error)) from None


def _check_lag(velocity_lag_s: Any, has_dq: bool) -> None:
    """Raise ArrayError if a lag is no number, outside its range, or not 0 without velocities."""
    longest_s = _LONGEST_LAG_S if has_dq else 0.0
    if not isinstance(velocity_lag_s, int | float | np.number) or not 0.0 <= velocity_lag_s <= longest_s:
        missing = "" if has_dq else ", as dq is not given"
        raise ArrayError(f"velocity_lag_s = {velocity_lag_s!r} is no time within 0 to {longest_s:g} s{missing}")


def _numbers(name: str, given: ArrayLike) -> Vector:
    """Return an array as float64 values of at most `LARGEST` in size; times may be larger, but finite.

    name: of the array, for the error. Raises ArrayError for other values, masked ones, or no real numbers.
    """
    try:
        values = np.asarray(given)
        if values.dtype.kind not in "fiu" or np.ma.is_masked(given):
            raise TypeError
        values = np.ascontiguousarray(values, np.float64)
    except (TypeError, ValueError):
        kind = "masked values" if np.ma.is_masked(given) else getattr(given, "dtype", type(given).__name__)
        raise ArrayError(f"{name} is of {kind}, real numbers in {_UNITS[name]} are expected") from None
    bad = np.argwhere(~(np.abs(values) <= LARGEST)) if name != "t" else np.argwhere(~np.isfinite(values))
    if len(bad):
        place = tuple(bad[0].tolist())
        bound = "finite" if name == "t" else f"at most {LARGEST:g} {_UNITS[name]}"
        raise ArrayError(f"{name}[{', '.join(map(str, place))}] = {values[place]:g} {_UNITS[name]} is not {bound}")
    return np.asarray(values, np.float64)


def _span(recording: ForeignRecording, fit_s: tuple[float, float] | None) -> tuple[float, float]:
    """Return begin and end of the free motion, s since the first row; by default of the first `FIT_SHARE` of the time.

    fit_s: in the arrays' time. Raises ArrayError if it is no pair of growing times, or ends more than two periods after
    the last sample. It may begin before the first.
    """
    last = recording.stretches[-1]
    length_s = last.start_s + len(last.record.q) * recording.period_s
    if fit_s is None:
        return 0.0, FIT_SHARE * length_s
    begin_s = recording.columns.begin_s
    try:
        start_s, end_s = (float(bound) - begin_s for bound in fit_s)
    except (TypeError, ValueError):
        start_s = end_s = math.nan
    if not start_s < end_s <= length_s + recording.period_s:
        raise ArrayError(f"fit_s = {fit_s!r} must be two growing times, s, up to {begin_s + length_s:g}, the end of t")
    return start_s, end_s


def _described(arm: OfflineArm, has_dq: bool, scheme: Mapping[str, Any]) -> RecordingMap:
    """Return a recording map for arrays, as a file would have. has_dq: velocities are among them.

    Raises ArrayError for an invalid setting of the scheme.
    """
    names = tuple(f"{place}" for place in range(1, arm.joints + 1))
    try:
        plain = checked_scheme({key: _plain(value) for key, value in scheme.items()}, "")
    except ConfigError as error:
        raise ArrayError(str(error)) from None
    if len(plain.get("noise_Nm", names)) != arm.joints:
        raise ArrayError(f"noise_Nm has {len(plain['noise_Nm'])} values, the arm {arm.joints} joints")
    return RecordingMap(
        urdf=arm.serial,
        arm=ArmSection(urdf="", has_rotors=arm.has_rotors),
        columns=ColumnsSection(time="t", q=names, tau_J=names, dq=names if has_dq else ()),
        scheme=plain,
    )
