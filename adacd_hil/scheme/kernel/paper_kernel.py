"""The numbers of one cycle: filters, both predictions, estimator, evidence and contact in one compiled call.

Three structured arrays of one element each carry everything, so that fields have names in compiled code and out of it:

- constants: what the settings say, never written here;
- memory: what lasts from one cycle to the next and is nobody's business outside;
- block: `records.scheme_layout`, filled in every cycle. q, dq, tau_J and the measured period_s are put there by the
  caller; a period_s of 0 was not measured.

A cycle without a fresh sample leaves filters and estimate as they were. Up to `MOST_FILLED` samples that are missing
before one are taken to lie on the straight line between their neighbours, so that a lost frame leaves nothing unseen. A
longer gap, a value that is not a number, or an interval that is not near the nominal one makes a gap from which the
filters resume as `filter_bank` says. The step says whether they took a sample in.

The measured interval goes into what integrates: filters, estimator, information, impulse. It does not go into what only
counts: T of eq. (15) is counted in cycles, whose grid keeps its phase, so it is right to a period. Nor does it into
`external_torque.undo_filter`: of the mean of five derivatives only the ends count, and the five periods between them.

**Shadow.** The paper's scheme beside the certified one: it adapts until eq. (15) holds, then compares with its
thresholds.

It decides nothing; what it comes to is in the block of the scheme in charge.
"""

from typing import Any

import numpy as np

from adacd_hil.compiled import Structured, compiled, packed, zeroed
from adacd_hil.records import JOINTS, Layout, Vector, scheme_layout
from adacd_hil.scheme.detect import external_torque
from adacd_hil.scheme.identify import estimator, termination
from adacd_hil.scheme.model import filter_bank, regressor
from adacd_hil.scheme.supervisor.transitions import CONTACT_SHIFT, Observation
from adacd_hil.settings.configuration import Settings

# What a cycle does, as bits: the estimator learns; thresholds are in force; a collision's report is not final yet.
LEARN = 1
ARMED = 2
REPORTING = 4


_NOT_A_NUMBER = int(Observation.NOT_A_NUMBER)
_OVER_LIMIT = int(Observation.OVER_LIMIT)
_AT_REST = int(Observation.AT_REST)
_UNLOADED = int(Observation.UNLOADED)
_ADAPTED = int(Observation.ADAPTED)
_COLLISION = int(Observation.CONTACT | Observation.COLLISION)
_UNSEEN = int(Observation.UNSEEN)

# Shares of the nominal period: the shortest and the longest interval of two samples that follow each other.
_SHORTEST_SHARE = 0.5
_LONGEST_SHARE = 1.5
MOST_FILLED = 4
"""Missing samples that are put on the line between their neighbours: with one more the model is blind by default. Over
5 ms the line is within 2.1e-5 Nm s of a torque of 2 Nm at 5 Hz."""


@compiled
def is_filled(steps: int, period_s: float, nominal_s: float, most: int) -> bool:
    """Tell whether a sample follows the one before it near enough. steps: periods between them, taking period_s.

    most: missing samples that may be put on the line between them.
    """
    if not 1 <= steps <= most + 1:
        return False
    return bool(_SHORTEST_SHARE * nominal_s * steps <= period_s <= _LONGEST_SHARE * nominal_s * steps)


@compiled
def put_between(last: Vector, q: Vector, dq: Vector, tau_J: Vector, share: float, between: Vector) -> None:
    """Fill `between` (3, n) with the sample at a share of the way from `last` (3, n) to q, dq, tau_J (n,)."""
    for i in range(between.shape[1]):
        between[0, i] = last[0, i] + share * (q[i] - last[0, i])
        between[1, i] = last[1, i] + share * (dq[i] - last[1, i])
        between[2, i] = last[2, i] + share * (tau_J[i] - last[2, i])


@compiled
def keep_sample(q: Vector, dq: Vector, tau_J: Vector, last: Vector) -> None:
    """Keep q, dq, tau_J (n,) in `last` (3, n)."""
    for i in range(last.shape[1]):
        last[0, i], last[1, i], last[2, i] = q[i], dq[i], tau_J[i]


def block_dtype(layout: Layout) -> np.dtype[np.void]:
    """Describe a block as a structure; its bytes are those of the float64 block."""
    return np.dtype([(field.name, np.float64, (field.size,)) for field in layout.fields])


def constants_of(settings: Settings) -> Structured:
    """Put the settings into the form that the compiled step reads."""
    count = len(settings.estimator.parameter_names)
    period_s = settings.bus.period_s
    hold = filter_bank.first_order_hold(settings.filter.a_rad_s, settings.filter.b_rad_s, period_s)
    inertia, viscous, coulomb, gravity = settings.termination.excitation_scale
    scale = (inertia,) * 3 + (viscous,) * 2 + (coulomb,) * 2 + (gravity,) * 2
    values: dict[str, Any] = {
        "period_s": period_s,
        "a_rad_s": settings.filter.a_rad_s,
        "b_rad_s": settings.filter.b_rad_s,
        "dc_gain": settings.filter.b_rad_s / settings.filter.a_rad_s,
        "decay": hold.decay,
        "weight_old": hold.weight_old,
        "weight_new": hold.weight_new,
        "is_least_squares": float(settings.estimator.law == "least_squares"),
        "P0": settings.estimator.P0,
        "theta_cad": settings.cad_theta if settings.arm.cad_theta else np.zeros(count),
        "beta_Nm": settings.termination.beta_Nm,
        "hold_cycles": round(settings.termination.hold_s / period_s),
        "travel_rad": np.radians(settings.termination.travel_deg),
        "velocity_rad_s": np.radians(settings.termination.velocity_deg_s),
        "excitation_Nm2s": settings.termination.excitation_Nm2s,
        "scale": scale[:count],
        "threshold_Nm": settings.detector.threshold_Nm,
        "standstill_rad_s": settings.detector.standstill_rad_s,
        **limits_of(settings),
    }
    return packed(values)


def limits_of(settings: Settings) -> dict[str, Any]:
    """Return the constants with which measurements alone are judged."""
    return {
        "position_limit_rad": settings.arm.position_limit_rad,
        "velocity_limit_rad_s": settings.arm.velocity_limit_rad_s,
        "rest_velocity_rad_s": settings.safety.rest_velocity_rad_s,
        "rest_torque_Nm": settings.safety.rest_torque_Nm,
    }


def new_memory(parameter_count: int) -> Structured:
    """Return the memory before the first sample: a gap, with tau_f = 0, W_f = 0 and theta_hat = 0."""
    joint, parameter = (JOINTS,), (parameter_count,)
    columns, square = (JOINTS, parameter_count), (parameter_count, parameter_count)
    shapes: dict[str, tuple[int, ...]] = {
        "has_gap": (),
        # filters
        "Y_p": columns,
        "Y_h": columns,
        "input_old": columns,
        "S": columns,
        "W_f": columns,
        "tau_old": joint,
        "last": (3, JOINTS),
        "between": (3, JOINTS),
        # estimator
        "P": square,
        "v": parameter,
        "K": parameter,
        # termination
        "q_low": joint,
        "q_high": joint,
        "dq_low": joint,
        "dq_high": joint,
        "information": square,
        "scratch": square,
        "samples": (),
        "quiet_cycles": (),
        # contact
        "standstill": joint,
        "history": (external_torque.WIDE_SAMPLES + 1, JOINTS),
        "integral": joint,
        "peak": joint,
    }
    memory = zeroed(shapes)
    memory["has_gap"] = 1.0
    return memory


def new_block(parameter_count: int) -> Structured:
    """Return a block before the first sample: zeros, and thresholds that nothing exceeds."""
    block = np.zeros(1, block_dtype(scheme_layout(parameter_count)))
    block["threshold"] = np.inf
    return block


@compiled
def begin_adaptation(constants: Structured, memory: Structured, block: Structured) -> None:
    """Forget the filters' past, the gain and the evidence; keep theta_hat. The arm is at rest.

    Filters that started with the old payload would mix the old theta into the new one for about 4 / a.
    """
    c, m, out = constants[0], memory[0], block[0]
    m["has_gap"] = 1.0
    m["W_f"][:] = 0.0
    out["tau_f"][:] = 0.0
    m["history"][:] = 0.0
    estimator.reset_gain(c["P0"], m["P"])
    m["q_low"][:] = np.inf
    m["q_high"][:] = -np.inf
    m["dq_low"][:] = np.inf
    m["dq_high"][:] = -np.inf
    m["information"][:] = 0.0
    m["samples"] = 0.0
    m["quiet_cycles"] = 0.0
    out["quiet_s"][0] = 0.0
    out["excitation"][0] = 0.0


@compiled
def step(constants: Structured, memory: Structured, block: Structured, is_complete: int, steps: int, mode: int) -> int:
    """Take in the block's q, dq, tau_J and fill the rest of it; return bits of `Observation`.

    is_complete: 1 if it is a fresh sample. steps: periods since the fresh sample before it. mode: LEARN, ARMED,
    REPORTING.
    """
    c, m, out = constants[0], memory[0], block[0]
    if out["period_s"][0] == 0.0:
        out["period_s"][0] = max(steps, 1) * c["period_s"]
    period_s = c["period_s"]
    observation = _observe(c, out) | _UNSEEN
    is_fresh = is_complete != 0 and observation & _NOT_A_NUMBER == 0
    if is_fresh:
        is_seen, period_s = _filter(c, m, out, steps)
        if is_seen:
            observation &= ~_UNSEEN
        if mode & LEARN:
            observation |= _learn(c, m, out, period_s)
        if not (np.all(np.isfinite(out["tau_ext_hat"])) and np.all(np.isfinite(out["theta_hat"]))):
            observation |= _NOT_A_NUMBER
    elif is_complete != 0:
        m["has_gap"] = 1.0
    if mode & ARMED:
        return observation | _watch(c, m, out, period_s, is_fresh, mode & REPORTING != 0)
    out["threshold"][:] = np.inf
    m["integral"][:] = 0.0
    m["peak"][:] = 0.0
    return observation


@compiled
def _observe(c: Any, out: Any) -> int:
    """Return what the measurements alone say."""
    observation = _AT_REST | _UNLOADED
    for i in range(JOINTS):
        q, dq, tau_J = out["q"][i], out["dq"][i], out["tau_J"][i]
        if not (np.isfinite(q) and np.isfinite(dq) and np.isfinite(tau_J)):
            observation |= _NOT_A_NUMBER
        if not (abs(q) <= c["position_limit_rad"][i] and abs(dq) <= c["velocity_limit_rad_s"][i]):
            observation |= _OVER_LIMIT
        if not (abs(dq) < c["rest_velocity_rad_s"]):
            observation &= ~_AT_REST
        if not (abs(tau_J) < c["rest_torque_Nm"]):
            observation &= ~_UNLOADED
    return observation


@compiled
def _filter(c: Any, m: Any, out: Any, steps: int) -> tuple[bool, float]:
    """Take the filters to this sample and estimate the external torque with both models.

    Return whether they took it in, and the time that it stands for: the measured interval, after a gap the nominal one.
    """
    a, b = c["a_rad_s"], c["b_rad_s"]
    nominal_s: float = c["period_s"]
    period_s: float = out["period_s"][0]
    is_seen = m["has_gap"] == 0.0 and is_filled(steps, period_s, nominal_s, MOST_FILLED)
    if is_seen:
        step_s = period_s / steps
        decay, old, new = c["decay"], c["weight_old"], c["weight_new"]
        if step_s != nominal_s:
            decay, old, new = filter_bank.first_order_hold(a, b, step_s)
        for k in range(1, steps):
            put_between(m["last"], out["q"], out["dq"], out["tau_J"], k / steps, m["between"])
            _advance(m, m["between"][0], m["between"][1], m["between"][2], a, b, decay, old, new, out["tau_f"])
            _compare(c, m, m["between"][1], decay, out)
        _advance(m, out["q"], out["dq"], out["tau_J"], a, b, decay, old, new, out["tau_f"])
        _compare(c, m, out["dq"], decay, out)
    else:
        period_s = nominal_s
        regressor.fill_momentum(out["q"], out["dq"], m["Y_p"])
        regressor.fill_remainder(out["q"], out["dq"], m["Y_h"])
        filter_bank.resume(a, b, m["Y_p"], m["Y_h"], out["tau_J"], m["input_old"], m["tau_old"], m["S"], m["W_f"])
        m["has_gap"] = 0.0
        _compare(c, m, out["dq"], c["decay"], out)
    keep_sample(out["q"], out["dq"], out["tau_J"], m["last"])
    return is_seen, period_s


@compiled
def _advance(
    m: Any,
    q: Vector,
    dq: Vector,
    tau_J: Vector,
    a: float,
    b: float,
    decay: float,
    weight_old: float,
    weight_new: float,
    tau_f: Vector,
) -> None:
    """Take the filters over one period to a sample."""
    regressor.fill_momentum(q, dq, m["Y_p"])
    regressor.fill_remainder(q, dq, m["Y_h"])
    filter_bank.advance_torque(decay, weight_old, weight_new, m["tau_old"], tau_J, tau_f)
    filter_bank.advance_regressor(
        decay, weight_old, weight_new, a, b, m["Y_p"], m["Y_h"], m["input_old"], m["S"], m["W_f"]
    )


@compiled
def _compare(c: Any, m: Any, dq: Vector, decay: float, out: Any) -> None:
    """Compare the filtered torque with both predictions."""
    external_torque.follow_standstill(dq, c["standstill_rad_s"], decay, m["standstill"])
    external_torque.predict(m["W_f"], out["theta_hat"], out["tau_f_hat"])
    external_torque.predict(m["W_f"], c["theta_cad"], out["tau_f_cad"])
    external_torque.estimate_external(out["tau_f"], out["tau_f_hat"], c["dc_gain"], out["tau_ext_hat"])
    external_torque.estimate_external(out["tau_f"], out["tau_f_cad"], c["dc_gain"], out["tau_ext_hat_cad"])
    external_torque.undo_filter(out["tau_ext_hat"], c["decay"], m["history"], out["tau_ext_wide_hat"])


@compiled
def _learn(c: Any, m: Any, out: Any, period_s: float) -> int:
    """Judge the estimate of this sample by eq. (15), then correct it; return ADAPTED if the adaptation is over."""
    termination.widen(out["q"], m["q_low"], m["q_high"])
    termination.widen(out["dq"], m["dq_low"], m["dq_high"])
    termination.add_information(m["W_f"], period_s, m["information"])
    if m["samples"] % termination.EXCITATION_EVERY == termination.EXCITATION_EVERY - 1:
        out["excitation"][0] = termination.smallest_eigenvalue(m["information"], c["scale"], m["scratch"])
    m["samples"] += 1.0
    m["quiet_cycles"] = m["quiet_cycles"] + 1.0 if termination.is_quiet(out["tau_ext_hat"], c["beta_Nm"]) else 0.0
    out["quiet_s"][0] = m["quiet_cycles"] * c["period_s"]
    is_over = (
        m["quiet_cycles"] >= c["hold_cycles"]
        and out["excitation"][0] >= c["excitation_Nm2s"]
        and termination.has_moved(
            m["q_low"], m["q_high"], m["dq_low"], m["dq_high"], c["travel_rad"], c["velocity_rad_s"]
        )
    )
    R = 1.0 / period_s
    estimator.update(m["W_f"], out["tau_f"], R, c["is_least_squares"] != 0.0, out["theta_hat"], m["P"], m["v"], m["K"])
    return _ADAPTED if is_over else 0


@compiled
def _watch(c: Any, m: Any, out: Any, period_s: float, is_fresh: bool, is_reporting: bool) -> int:
    """Compare with the thresholds; return the joints that are over, and that any of it is a collision."""
    F_c = out["theta_hat"][regressor.F_C1 : regressor.F_C2 + 1]
    external_torque.fill_threshold(c["threshold_Nm"], m["standstill"], F_c, out["threshold"])
    if is_fresh:
        external_torque.follow_contact(
            out["tau_ext_hat"],
            out["tau_ext_wide_hat"],
            out["threshold"],
            period_s,
            is_reporting,
            m["integral"],
            m["peak"],
        )
    joints = external_torque.joints_over(out["tau_ext_hat"], out["threshold"])
    return _COLLISION | joints << CONTACT_SHIFT if joints else 0


@compiled
def step_record(
    constants: Structured,
    memory: Structured,
    q: Vector,
    dq: Vector,
    tau_J: Vector,
    is_complete: Vector,
    steps: Vector,
    period_s: Vector,
    mode: int,
    blocks: Structured,
) -> None:
    """Run `step` over n samples in one mode; fills blocks (n,).

    q, dq, tau_J (n, 2); is_complete, steps (n,) int64; period_s (n,), 0 where it was not measured.

    blocks[0] must hold the theta_hat to begin with.
    """
    for k in range(q.shape[0]):
        if k > 0:
            blocks[k] = blocks[k - 1]
        block = blocks[k : k + 1]
        block[0]["q"][:] = q[k]
        block[0]["dq"][:] = dq[k]
        block[0]["tau_J"][:] = tau_J[k]
        block[0]["period_s"][0] = period_s[k]
        step(constants, memory, block, is_complete[k], steps[k], mode)


@compiled
def step_shadow(
    constants: Structured,
    memory: Structured,
    block: Structured,
    mode: int,
    main: Structured,
    is_complete: int,
    steps: int,
) -> int:
    """Take in the sample that the main scheme's block has, fill that block's fields, and return the next mode.

    constants, memory, block: of the paper's kernel. main: after the main kernel's step.
    """
    own, out = block[0], main[0]
    for i in range(JOINTS):
        own["q"][i], own["dq"][i], own["tau_J"][i] = out["q"][i], out["dq"][i], out["tau_J"][i]
    own["period_s"][0] = out["period_s"][0]
    observation = step(constants, memory, block, is_complete, steps, mode)
    if observation & _ADAPTED:
        mode = ARMED
    out["paper_is_armed"][0] = 1.0 if mode == ARMED else 0.0
    for i in range(JOINTS):
        out["paper_tau_ext_hat"][i] = own["tau_ext_hat"][i]
        out["paper_threshold"][i] = own["threshold"][i]
    for j in range(own["theta_hat"].size):
        out["paper_theta_hat"][j] = own["theta_hat"][j]
    return mode


class PaperShadow:
    """The paper's scheme on the same stream."""

    def __init__(self, settings: Settings) -> None:
        count = len(settings.estimator.parameter_names)
        self.constants = constants_of(settings)
        self.memory = new_memory(count)
        self.block = new_block(count)
        self.mode = 0

    @property
    def numbers(self) -> tuple[Structured, Structured, Structured]:
        """What its kernel works on: constants, memory, block."""
        return self.constants, self.memory, self.block

    def compile(self, main: Structured) -> None:
        """Run every compiled function once, on copies. main: the block of the scheme in charge."""
        memory, block = self.memory.copy(), self.block.copy()
        begin_adaptation(self.constants, memory, block)
        step_shadow(self.constants, memory, block, LEARN, main.copy(), 1, 1)

    def begin_adaptation(self) -> None:
        """Forget the past, as the scheme does whenever it adapts."""
        begin_adaptation(self.constants, self.memory, self.block)
        self.mode = LEARN

    def step(self, main: Structured, is_complete: int, steps: int) -> None:
        """Take in one cycle, and put what it comes to into the block of the scheme in charge."""
        self.mode = step_shadow(self.constants, self.memory, self.block, self.mode, main, is_complete, steps)
