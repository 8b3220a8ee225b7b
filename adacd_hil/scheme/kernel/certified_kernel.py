"""The numbers of one cycle of the certified scheme: bank of filters, belief about the model, evidence, detection.

theta is not only a number here but a belief (`belief`): mean and covariance P in honest units, begun with what any such
arm may be and corrected by recursive least squares. What a filter's regressor row makes of the belief is the
uncertainty of its prediction, so every threshold follows from what is known at the time (`sensitivity`). At the start
of an adaptation P is large and nothing can be told; a fraction of a second later it can.

**A touch is not learnt.** Samples wait in a ring before they correct the belief. When a residual exceeds its threshold
the ring is thrown away, so nothing of the touch, from its beginning on, is learnt. What was known before judges what is
learnt after (`earlier`), and what is known from elsewhere judges the offsets (`anchor`).

**A certificate** is a test of the frozen model on motion that was not used for the fit (`termination`). While detection
is armed the belief goes on learning; its mean takes the place of the frozen one after a test (`belief`).

Constants, memory and block: `certified_memory`.
"""

from typing import Any

import numpy as np

from adacd_hil.compiled import Structured, compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.detect import external_torque, margin, sensitivity
from adacd_hil.scheme.identify import (
    anchor,
    belief,
    certificate,
    doubt,
    earlier,
    fit_check,
    missing_torque,
    termination,
)
from adacd_hil.scheme.kernel.kernel_samples import (
    is_filled,
    keep_sample,
    observe,
    put_between,
)
from adacd_hil.scheme.model import filter_bank, regressor
from adacd_hil.scheme.supervisor.transitions import (
    AT_REST,
    CERTIFIED,
    COLLISION,
    CONTACT,
    CONTACT_SHIFT,
    FITTED,
    NOT_A_NUMBER,
    OVER_SPEED,
    REFUTED,
    UNSEEN,
    WITHHELD,
)

# What a cycle does, as bits.
MEASURE = 1  # the arm is at rest: measure the torque sensors' noise and zero
WATCH = 2  # compare the residuals with their thresholds
LEARN = 4  # correct the belief and use it at once
TEST = 8  # test the frozen model
REFINE = 16  # correct the belief, and let its mean take over after a test
WEIGH = 32  # weigh what a contact of the certified model looks like


@compiled
def begin_adaptation(constants: Structured, memory: Structured, is_payload: bool, is_first: bool) -> None:
    """Begin to learn: from the prior, or with a payload on top of the arm as it was certified.

    is_first: of the arm as it is now; else an earlier attempt came to nothing, and its samples are evidence still.

    What was learnt before is forgotten, so a contact on the way, whenever it is noticed, leaves no trace.

    Filters that started with the old payload would mix the old theta into the new one for about 4 / a.
    """
    k, m = constants[0], memory[0]
    if is_first:
        missing_torque.clear(k, m)
    m["has_gap"] = 1.0
    m["W_f"][:] = 0.0
    m["tau_f"][:] = 0.0
    m["X_f"][:] = 0.0
    m["W_learnt"][:] = 0.0
    m["X_learnt"][:] = 0.0
    m["tau_learnt"][:] = 0.0
    m["history"][:] = 0.0
    m["is_payload"] = 1.0 if is_payload else 0.0
    if is_payload:
        m["belief"][:] = m["certified"]
        m["P_belief"][:] = m["P_certified"]
        belief.add_payload(k["payload_direction"], k["payload_std_kg"], k["payload_rest_std"], m["P_belief"])
        if int(k["base"]) > regressor.A5:
            _begin_at_rest(m)
    else:
        belief.begin(k["prior"], k["prior_std"], m["belief"], m["P_belief"])
    _use_belief(m)
    belief.discard(m)
    m["are_lags_held"] = 0.0
    earlier.begin(m)
    fit_check.begin(m)
    margin.begin_tail(m)
    m["unit"][:] = 1.0
    m["samples"] = 0.0
    m["recovering_cycles"] = 0.0
    termination.begin(m)
    m["excitation"] = 0.0
    m["condition"] = np.inf


@compiled
def _begin_at_rest(m: Any) -> None:
    """Begin with filters that have seen this pose, and the torque that gravity makes there, for ever.

    From 0, that torque would be a step: the columns of the lag would have its derivative.
    """
    m["X_f"][:] = m["X"]
    for c in range(m["tau_f"].shape[0]):
        m["W_f"][c] = m["Y_h"]
        m["tau_f"][c] = m["tau_old"][c]


@compiled
def begin_test(constants: Structured, memory: Structured) -> None:
    """Freeze the belief, as far as it is physically possible, as the model in use, and begin its test."""
    k, m = constants[0], memory[0]
    first_viscous, last_coulomb = int(k["first_coulomb"]) - JOINTS, int(k["first_coulomb"]) + JOINTS
    belief.keep_non_negative(first_viscous, last_coulomb, m["belief"], m["P_belief"])
    _use_belief(m)
    belief.discard(m)
    m["tested"] = 0.0
    margin.begin_sight(m)
    m["test_limit_Nm"] = termination.test_limit_Nm(k, earlier.late_square(m))
    m["dq_low"][:] = np.inf
    m["dq_high"][:] = -np.inf


@compiled
def begin_refinement(constants: Structured, memory: Structured) -> None:
    """Begin to refine the model that has just been certified."""
    k, m = constants[0], memory[0]
    m["promotions"] = 0.0
    m["certified"][:] = m["theta"]
    m["P_certified"][:] = m["P"]
    belief.hold_lags(k, m)
    earlier.forget(m)
    missing_torque.clear(k, m)
    belief.restart_candidate(m)


@compiled
def _use_belief(m: Any) -> None:
    m["theta"][:] = m["belief"]
    m["P"][:] = m["P_belief"]


@compiled
def step(constants: Structured, memory: Structured, block: Structured, is_complete: int, steps: int, mode: int) -> int:
    """Take in the block's q, dq, tau_J and fill the rest of it; return bits of `Observation`.

    is_complete: 1 if it is a fresh sample. steps: periods since the fresh sample before it. mode: MEASURE to REFINE.
    """
    k, m, out = constants[0], memory[0], block[0]
    observation = observe(k, out, steps, OVER_SPEED)
    is_fresh = is_complete != 0 and observation & NOT_A_NUMBER == 0
    if is_fresh:
        m["anchor_age_s"] += out["period_s"][0]
        m["kept_age_s"][:] += out["period_s"][0]
        if mode & MEASURE:
            sensitivity.measure_noise(k, m, out["tau_J"])
            anchor.measure(k, m, out["tau_J"], observation & AT_REST != 0)
        if _filter(k, m, out, steps):
            observation &= ~UNSEEN
        if not (np.all(np.isfinite(m["r"])) and np.all(np.isfinite(m["theta"]))):
            observation |= NOT_A_NUMBER
    elif is_complete != 0:
        m["has_gap"] = 1.0
    if mode & MEASURE and anchor.is_rest_refused(k, m):
        m["withheld_by"] = certificate.ANCHOR
        observation |= WITHHELD
    if mode & WATCH:
        observation |= _watch(k, m, out, is_fresh)
    else:
        out["threshold"][:] = np.inf
        out["threshold_bank"][:] = np.inf
        m["wide_threshold"][:] = np.inf
    if mode & WEIGH and not observation & UNSEEN:
        doubt.weigh(k, m)
    if is_fresh and mode & (LEARN | TEST | REFINE):
        observation |= improve(k, m, out, observation & CONTACT != 0, mode)
    _fill_model(k, m, out)
    return observation


@compiled
def _filter(k: Any, m: Any, out: Any, steps: int) -> bool:
    """Take the bank to this sample and estimate the external torque that each filter sees.

    Return whether the filters took it in; after a gap they only resume.
    """
    nominal_s: float = k["period_s"]
    period_s: float = out["period_s"][0]
    is_seen = m["has_gap"] == 0.0 and is_filled(steps, period_s, nominal_s, sensitivity.MOST_FILLED)
    each_s = period_s / steps if is_seen else period_s
    if is_seen:
        _choose_rates(k, m, each_s)
        for between in range(1, steps):
            put_between(m["last"], out["q"], out["dq"], out["tau_J"], between / steps, m["between"])
            m["is_steady"] = 0.0
            q, dq, tau_J = m["between"][0], m["between"][1], m["between"][2]
            _take_sample(k, m, q, dq, tau_J, each_s, is_seen, out["tau_ext_wide_hat"])
    sensitivity.follow_lost(k, m, out["dq"], max(steps, 1), period_s, is_seen)
    sensitivity.follow_torque_step(k, m, out["tau_J"])
    if not is_seen and np.max(np.abs(out["dq"])) > regressor.SLOW_RAD_S:
        m["recovering_cycles"] = max(m["recovering_cycles"], k["settle_cycles"])
    m["is_steady"] = 1.0 if is_seen and steps == 1 else 0.0
    q, dq, tau_J = out["q"][:], out["dq"][:], out["tau_J"][:]  # arrays as those above: it is compiled once
    _take_sample(k, m, q, dq, tau_J, each_s, is_seen, out["tau_ext_wide_hat"])
    m["has_gap"] = 0.0
    keep_sample(out["q"], out["dq"], out["tau_J"], m["last"])
    out["tau_f"][:] = m["tau_f"][filter_bank.SLOW]
    external_torque.predict(m["W_f"][filter_bank.SLOW], k["theta_cad"], out["tau_f_cad"])
    for i in range(out["q"].shape[0]):
        out["tau_ext_hat"][i] = m["r"][filter_bank.SLOW, i]
        out["tau_f_hat"][i] = m["r"][filter_bank.SLOW, i] + out["tau_f"][i]
        out["tau_ext_hat_cad"][i] = out["tau_f_cad"][i] - out["tau_f"][i]
    return bool(is_seen)


@compiled
def _choose_rates(k: Any, m: Any, period_s: float) -> None:
    """Fill what one period does to each filter."""
    decay, old, new = m["rates"][0], m["rates"][1], m["rates"][2]
    if period_s == k["period_s"]:
        decay[:] = k["decay"]
        old[:] = k["weight_old"]
        new[:] = k["weight_new"]
    else:
        filter_bank.discretise(k["cutoff"], period_s, decay, old, new)


@compiled
def _take_sample(
    k: Any,
    m: Any,
    q: Vector,
    dq: Vector,
    tau_J: Vector,
    period_s: float,
    is_seen: bool,
    tau_ext_wide_hat: Vector,
) -> None:
    """Take the bank over one period to a sample, or let it resume from there, and compare with the model in use."""
    cutoff = k["cutoff"]
    regressor.bend_bristles(dq, period_s, k["still_rad_s"], k["dahl_rad"], m["bent"])
    _fill_regressor(k, m, q, dq, tau_J)
    filter_bank.take_sample(k, m, tau_J, is_seen)
    missing_torque.follow(m, q, m["rates"][:, filter_bank.LEARNT], k["smoothing"], is_seen)
    filter_bank.fill_lag(cutoff, tau_J, m["tau_f"], int(k["base"]) + q.shape[0], m["W_f"])
    if k["has_cross_talk"] != 0.0:
        filter_bank.fill_cross_talk(m["tau_f"], int(k["first_cross_talk"]), m["W_f"])
    filter_bank.smooth_learnt(k["smoothing"], m["W_f"], m["tau_f"], m["W_learnt"], m["tau_learnt"])
    filter_bank.estimate_external(m["tau_f"], m["W_f"], m["theta"], m["r"])
    filter_bank.smooth(k["smoothing"], m["r"], m["y"])
    still_rad_s, decay, smoothing = k["still_rad_s"], k["decay"], k["smoothing"]
    sensitivity.follow_standstill(
        dq, m["dq_old"], still_rad_s, decay, smoothing, m["still"], m["still_smooth"], m["low_speed"]
    )
    sensitivity.follow_velocity_noise(k, m, dq, m["is_steady"] != 0.0)
    sensitivity.follow_friction(k, m, tau_J)
    external_torque.undo_filter(m["r"][filter_bank.WIDE], k["decay"][filter_bank.WIDE], m["history"], tau_ext_wide_hat)


@compiled
def _fill_regressor(k: Any, m: Any, q: Vector, dq: Vector, tau_J: Vector) -> None:
    """Fill Y_p, Y_h (2, p) and M (2, 2) of the 2R arm, offsets and further friction included."""
    base, first_coulomb, count = int(k["base"]), int(k["first_coulomb"]), q.shape[0]
    regressor.fill_momentum(q, dq, m["Y_p"][:, :base])
    regressor.fill_remainder(q, dq, k["level_rad"], m["Y_h"][:, :base])
    for i in range(count):
        m["Y_h"][i, first_coulomb + i] = regressor.smooth_sign(dq[i], k["still_rad_s"], k["width_rad_s"])
        m["Y_h"][i, base + i] = 1.0
    speeds = k["still_rad_s"], k["width_rad_s"], k["stribeck_rad_s"]
    regressor.fill_terms(dq, tau_J, k["terms"], speeds, m["bent"], base + 2 * count, m["Y_h"])
    if k["position_torque_Nm"] != 0.0:
        regressor.fill_position(q, m["X"])
        regressor.put_position_columns(m["X"], int(k["first_position"]), m["Y_h"])
    regressor.fill_mass_matrix(q, m["theta"], m["M"])


@compiled
def _watch(k: Any, m: Any, out: Any, is_fresh: bool) -> int:
    """Compare with the thresholds; return CONTACT, COLLISION and the joints that are over, if any."""
    if is_fresh:
        sensitivity.fill_thresholds(k, m, m["h"])
        out["threshold"][:] = m["h"][filter_bank.SLOW]
        sensitivity.fill_wide(k, m, filter_bank.WIDE)
    joints = sensitivity.joints_over(m["y"], m["h"])
    if not joints:
        return 0
    observation = CONTACT | joints << CONTACT_SHIFT
    for c in range(m["r"].shape[0], m["y"].shape[0]):
        for i in range(m["y"].shape[1]):
            if not (abs(m["y"][c, i]) <= max(k["collision_Nm"][i], m["h"][c, i])):
                observation |= COLLISION
    return observation


@compiled
def improve(k: Any, m: Any, out: Any, is_touched: bool, mode: int) -> int:
    """Learn, test or refine by this sample; return what that has come to."""
    is_free_before = m["recovering_cycles"] == 0.0
    if is_touched:
        m["recovering_cycles"] = k["recover_cycles"]
    elif m["recovering_cycles"] > 0.0:
        m["recovering_cycles"] -= 1.0
    is_free = m["recovering_cycles"] == 0.0
    if is_touched and is_free_before and mode & (LEARN | TEST):
        sensitivity.strain(m, sensitivity.LARGEST_STRAIN)
        earlier.keep(k, m)
    if is_touched and mode & REFINE:
        doubt.begin(k, m)
    _follow_noise(k, m, is_free, mode)
    if mode & TEST:
        return _test(k, m, out["dq"])
    if mode & REFINE:
        return _refine(k, m) if is_free else 0
    if is_free and belief.learn(k, m):
        _use_belief(m)
        earlier.follow(k, m)
        fit_check.keep(m, m["W_f"][filter_bank.SLOW], m["tau_f"][filter_bank.SLOW])
    if not (is_free and _gather_evidence(k, m, out)):
        return 0
    m["withheld_by"] = certificate.contradicted_by(k, m)
    return FITTED if m["withheld_by"] == certificate.NOTHING else WITHHELD


@compiled
def _follow_noise(k: Any, m: Any, is_free: bool, mode: int) -> None:
    """Take in the noise of a sample that nothing touches, or throw away what waits to be told from a contact."""
    if not is_free:
        belief.discard(m)
        margin.discard_tail(m)
        return
    sensitivity.keep_velocity_noise(k, m)
    if mode & (TEST | REFINE):
        margin.follow_tail(k, m)


@compiled
def _test(k: Any, m: Any, dq: Vector) -> int:
    """Take this sample into the test of the frozen model; return what that has come to.

    Where a joint rests nothing is proven.
    """
    m["tested"] += 1.0
    termination.widen(dq, m["dq_low"], m["dq_high"])
    sensitivity.follow_unit(k, m, filter_bank.SLOW, k["unit_test_share"], False)
    margin.follow_test(k, m)
    has_moved = True
    for i in range(dq.shape[0]):
        if not (abs(m["r"][filter_bank.SLOW, i]) <= m["test_limit_Nm"]):
            if m["is_payload"] == 0.0:  # of a new one hands have been on the arm, and friction may depend on it
                earlier.keep(k, m)
            is_by_place = missing_torque.is_found(k, m)
            m["withheld_by"] = certificate.BY_PLACE if is_by_place else certificate.NOTHING
            return REFUTED | WITHHELD if is_by_place else REFUTED
        fastest = max(m["dq_high"][i], -m["dq_low"][i])
        has_moved = has_moved and fastest >= k["velocity_rad_s"]
    is_long = m["tested"] >= k["test_cycles"][int(m["is_payload"])]
    return CERTIFIED if is_long and has_moved else 0


@compiled
def _refine(k: Any, m: Any) -> int:
    """Learn on beside the model in use, and let what was learnt take over after its test; return what is against it."""
    sensitivity.follow_unit(k, m, filter_bank.SLOW, k["unit_share"], True)
    sensitivity.relax(k, m)
    m["withheld_by"] = certificate.BLIND if margin.follow_sight(k, m) else certificate.NOTHING
    if belief.learn(k, m):
        belief.wander(k["drift_std"], m["W_learnt"], k["period_s"] * k["learn_every"], m["P_belief"])
        if missing_torque.is_found_in_time(k, m):
            m["withheld_by"] = certificate.BY_PLACE
    if belief.test_candidate(k, m):
        m["withheld_by"] = certificate.ANCHOR
    return 0 if m["withheld_by"] == certificate.NOTHING else WITHHELD


@compiled
def _gather_evidence(k: Any, m: Any, out: Any) -> bool:
    """Take this sample into the evidence and tell whether it is complete and the model can be an arm's."""
    termination.widen(out["q"], m["q_low"], m["q_high"])
    termination.widen(out["dq"], m["dq_low"], m["dq_high"])
    termination.add_information(m["W_f"][filter_bank.SLOW], k["period_s"], m["information"])
    if m["samples"] % termination.EXCITATION_EVERY == termination.EXCITATION_EVERY - 1:
        smallest, largest = termination.eigenvalue_range(m["information"], k["scale"], m["scratch"])
        m["excitation"] = smallest
        m["condition"] = largest / smallest if smallest > 0.0 else np.inf
    m["samples"] += 1.0
    return bool(termination.is_complete(k, m) and regressor.is_positive_definite(m["belief"]))


@compiled
def _fill_model(k: Any, m: Any, out: Any) -> None:
    """Fill what the block says of the model and the bank."""
    base, joints = int(k["base"]), m["y"].shape[1]
    for j in range(m["theta"].shape[0]):
        if j < base:
            out["theta_hat"][j] = m["theta"][j]
        else:
            out["theta_further"][j - base] = m["theta"][j]
        out["theta_std"][j] = np.sqrt(max(m["P"][j, j], 0.0))
    for c in range(m["y"].shape[0]):
        for i in range(joints):
            out["tau_ext_bank"][c * joints + i] = m["y"][c, i]
            if out["threshold"][i] != np.inf:
                out["threshold_bank"][c * joints + i] = m["h"][c, i]
    out["excitation"][0] = m["excitation"]
    out["condition"][0] = m["condition"]
    out["promotions"][0] = m["promotions"]
    out["quiet_s"][0] = m["tested"] * k["period_s"]
