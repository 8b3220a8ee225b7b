"""One cycle of the scheme, compiled: the kernel, the paper's kernel beside it, the supervisor, and a contact's course.

Live calls `certified_cycle` or `paper_cycle` for one sample; a replay calls `run_certified` or `run_paper`, which run
many. A cycle returns bits, `LEFT` to `PUSHED`: tasks for Python before the decision is issued. They are rare. Some come
before the contact's course (`BEFORE_CONTACT`), because Python may hold the arm: a state was left, a fit is refused, a
model has been replaced, the user accepts. Then `end_certified` or `end_paper` ends the cycle. The others come after the
course: a report is due, a second of monitoring is over, the arm is pushed at rest.

Samples and decisions are structured arrays with an element per cycle, `kernel_samples.SAMPLE` and `DECISION`; blocks
are (n, size). Course: constants and memory common to both schemes, one element each.
"""

from typing import Annotated, Any

import numpy as np

from adacd_hil.compiled import compiled, released
from adacd_hil.records import JOINTS, REACTING, ContactLevel, Request, SchemeState, Vector
from adacd_hil.scheme.contact import contact_report, course
from adacd_hil.scheme.contact.course import CourseConstants, CourseMemory
from adacd_hil.scheme.kernel import certified_kernel, paper_kernel
from adacd_hil.scheme.kernel.kernel_samples import put_sample
from adacd_hil.scheme.memory import Memory, Sample
from adacd_hil.scheme.model import filter_bank
from adacd_hil.scheme.supervisor import supervisor
from adacd_hil.scheme.supervisor.findings import CONTACT_SHIFT, WITHHELD
from adacd_hil.scheme.supervisor.supervisor import IS_LEARNING, IS_REACTING, SupervisorConstants, SupervisorMemory
from adacd_hil.settings.configuration import Settings
from adacd_hil.structured import Structured, described, zeros_of

# Tasks for Python in a cycle, as bits.
LEFT = 1  # a state was left
REFUSED = 2  # a fit, or the reading at rest, is refused
TOOK_OVER = 4  # a refined model has replaced the one in use
ACCEPTED = 8  # the user accepts the refused fit or reading
REPORT = 16  # a contact's report is due
FORGET = 32  # the contact that disturbed an adaptation is reported: its learnt model is to be forgotten
SECOND = 64  # a second of monitoring is over
PUSHED = 128  # the arm is pushed at rest
BEFORE_CONTACT = LEFT | REFUSED | TOOK_OVER | ACCEPTED


class Decision:
    """The result of a cycle. observation: bits of an observation (`findings`).

    contact_joints: bit i for joint i + 1.
    """

    state: Annotated[int, np.uint8]
    previous_state: Annotated[int, np.uint8]
    fault: Annotated[int, np.uint8]
    reaction: Annotated[int, np.uint8]
    contact_joints: int
    observation: int
    is_model_valid: bool


DECISION = described(Decision, {})


class RunConstants:
    """Constants common to both schemes."""

    supervisor: SupervisorConstants
    contact: CourseConstants


class RunMemory:
    """Memory common to both schemes.

    is_measured: intervals of samples are measured; sampled_ns: time of the last complete one, is_sampled: there was
    one. is_model_valid: the model may be fed forward. is_refusing: a refusal is pending that the user may accept.
    """

    supervisor: SupervisorMemory
    contact: CourseMemory
    is_measured: int
    is_sampled: int
    sampled_ns: int
    is_model_valid: int
    is_refusing: int


_SIZES = {"n": JOINTS, "states": len(SchemeState), "levels": len(ContactLevel)}
_CERTIFIED_MODE = np.zeros(len(SchemeState), np.int64)
for _state, _mode in (
    (SchemeState.COMMISSION, certified_kernel.MEASURE),
    (SchemeState.ENABLE, certified_kernel.WATCH),
    (SchemeState.ADAPT, certified_kernel.WATCH | certified_kernel.LEARN),
    (SchemeState.CERTIFY, certified_kernel.WATCH | certified_kernel.TEST),
    (SchemeState.MONITOR, certified_kernel.WATCH | certified_kernel.REFINE),
    (SchemeState.REACT, certified_kernel.WATCH),
    (SchemeState.STOPPED, certified_kernel.WATCH),
    (SchemeState.PAYLOAD, certified_kernel.WATCH),
):
    _CERTIFIED_MODE[_state] = _mode
_PAPER_MODE = np.zeros(len(SchemeState), np.int64)
_PAPER_MODE[SchemeState.ADAPT] = paper_kernel.LEARN
_PAPER_MODE[[SchemeState.MONITOR, *REACTING]] = paper_kernel.ARMED


def new_course(settings: Settings) -> tuple[Structured, Structured]:
    """Return constants and memory (1,) of supervisor, contact reports and reactions, before the first cycle."""
    constants, memory = zeros_of(RunConstants, _SIZES), zeros_of(RunMemory, _SIZES)
    k: RunConstants = constants[0]
    m: RunMemory = memory[0]
    supervisor.fill_constants(settings, k.supervisor)
    course.fill_constants(settings, k.contact)
    course.begin(m.contact)
    m.is_measured = settings.realtime.sample_period == "measured"
    return constants, memory


@compiled
def interval_s(m: RunMemory, sample: Sample) -> float:
    """Return the time from the last complete sample to this one, s, and store this one's time in `m`.

    For an incomplete sample, or in a run that doesn't measure intervals (`m.is_measured` = 0), return 0 and store no
    time. 0 also for the first sample.
    """
    if m.is_measured == 0 or sample.is_complete == 0:
        return 0.0
    period_s = (sample.sampled_ns - m.sampled_ns) * 1e-9 if m.is_sampled != 0 else 0.0
    m.is_sampled, m.sampled_ns = 1, sample.sampled_ns
    return period_s


@compiled
def certified_cycle(
    samples: Structured,
    decisions: Structured,
    blocks: Vector,
    place: int,
    constants: Structured,
    memory: Structured,
    block: Structured,
    values: Vector,
    paper_constants: Structured,
    paper_memory: Structured,
    paper_block: Structured,
    course_constants: Structured,
    course_memory: Structured,
    rows: Vector,
) -> int:
    """Run one cycle of the certified scheme; return bits of tasks for Python, or 0.

    With a bit of BEFORE_CONTACT the cycle is not over: Python runs the tasks, then `end_certified`. place: index of the
    cycle in samples, decisions and blocks; `decisions` and `blocks` are filled there. values: the numbers of `block`
    (size,), same memory. paper_*: the paper's scheme, which runs beside. course_*: supervisor and contact. rows: see
    `contact_report.put_row`.
    """
    sample, decision, run = samples[place], decisions[place], course_memory[0]
    period_s = interval_s(run, sample)
    mode = _CERTIFIED_MODE[run.supervisor.state]
    if run.supervisor.state == SchemeState.REACT and run.supervisor.origin == SchemeState.MONITOR:
        mode |= certified_kernel.WEIGH
    put_sample(block, sample, period_s)
    promotions = memory[0].models.promotions
    observation = certified_kernel.step(constants, memory, block, sample.is_complete, sample.steps, mode)
    paper_kernel.step_beside(paper_constants, paper_memory, paper_block, sample, period_s, block[0])
    for j in range(values.size):
        blocks[place, j] = values[j]
    asked = decide(course_constants[0], run, sample, observation, decision)
    if memory[0].models.promotions != promotions:
        asked |= TOOK_OVER
    if asked:
        return asked
    return end_certified(samples, decisions, place, constants, memory, block, course_constants, course_memory, rows)


@compiled
def end_certified(
    samples: Structured,
    decisions: Structured,
    place: int,
    constants: Structured,
    memory: Structured,
    block: Structured,
    course_constants: Structured,
    course_memory: Structured,
    rows: Vector,
) -> int:
    """End a cycle of the certified scheme: follow the contact's reports and reaction, and fill the decision.

    Write the cycle's row into `rows`, see `contact_report.put_row`. Return bits of further tasks for Python, or 0:
    REPORT, a report is due; FORGET, once, when the contact that interrupted an adaptation has its last report; SECOND,
    a second of monitoring is over; PUSHED, the stopped arm is over a threshold at the check asked for. place: index of
    the cycle.
    """
    k, m, out, run = constants[0], memory[0], block[0], course_memory[0]
    decision, contact, state = decisions[place], run.contact, run.supervisor.state
    contact_report.put_row(
        rows,
        contact.kept_rows,
        out.q,
        out.tau_ext_wide_hat,
        m.sensitivity.wide_sigma,
        m.sensitivity.wide_threshold,
    )
    contact.kept_rows += 1
    asked = follow_contact(
        course_constants[0], run, samples[place], decision, m.filters.y[filter_bank.WIDE], out.tau_ext_wide_hat
    )
    is_disturbed = IS_REACTING[state] and IS_LEARNING[run.supervisor.origin]
    is_reported = is_disturbed and contact.is_open == 0
    if is_reported and m.watch.has_forgotten == 0.0:
        asked |= FORGET
    m.watch.has_forgotten = 1.0 if is_reported else 0.0
    if state == SchemeState.MONITOR:
        m.watch.monitored_cycles += 1.0
        if m.watch.monitored_cycles >= k.second_cycles:
            m.watch.monitored_cycles = 0.0
            asked |= SECOND
    if m.watch.until_push_cycles > 0.0:
        m.watch.until_push_cycles = m.watch.until_push_cycles - 1.0 if state == SchemeState.STOPPED else 0.0
        if m.watch.until_push_cycles == 0.0 and decision.contact_joints != 0 and state == SchemeState.STOPPED:
            asked |= PUSHED
    return asked


@compiled
def paper_cycle(
    samples: Structured,
    decisions: Structured,
    blocks: Vector,
    place: int,
    constants: Structured,
    memory: Structured,
    block: Structured,
    values: Vector,
    course_constants: Structured,
    course_memory: Structured,
) -> int:
    """Run one cycle of the paper's scheme; return bits of tasks for Python, or 0.

    With a bit of BEFORE_CONTACT the cycle is not over: Python runs the tasks, then `end_paper`. place: index of the
    cycle in samples, decisions and blocks; `decisions` and `blocks` are filled there. values: the numbers of `block`
    (size,), same memory. course_*: supervisor and contact.
    """
    sample, decision, run = samples[place], decisions[place], course_memory[0]
    period_s = interval_s(run, sample)
    mode = _PAPER_MODE[run.supervisor.state]
    if run.contact.is_open != 0:
        mode |= paper_kernel.REPORTING
    put_sample(block, sample, period_s)
    observation = paper_kernel.step(constants, memory, block, sample.is_complete, sample.steps, mode)
    for j in range(values.size):
        blocks[place, j] = values[j]
    asked = decide(course_constants[0], run, sample, observation, decision)
    if asked:
        return asked
    return end_paper(samples, decisions, place, block, course_constants, course_memory)


@compiled
def end_paper(
    samples: Structured,
    decisions: Structured,
    place: int,
    block: Structured,
    course_constants: Structured,
    course_memory: Structured,
) -> int:
    """End a cycle of the paper's scheme: follow the contact's reports and reaction, and complete the decision.

    `decide` has filled the decision's other fields, see `follow_contact`. Return REPORT if a report is due, else 0.
    place: index of the cycle.
    """
    tau_ext_hat = block[0].tau_ext_hat
    return follow_contact(
        course_constants[0], course_memory[0], samples[place], decisions[place], tau_ext_hat, tau_ext_hat
    )


def await_push(m: Memory, cycles: int) -> None:
    """Let the stopped arm be checked for a push after so many cycles, see PUSHED."""
    m.watch.until_push_cycles = cycles


@compiled
def decide(k: RunConstants, m: RunMemory, sample: Sample, observation: int, decision: Decision) -> int:
    """Run the supervisor; return LEFT, REFUSED or ACCEPTED as bits, tasks for Python before the contact's course; or 0.

    ACCEPTED: the user asks to accept a refusal, pending or not; a pending one is not refused again in this cycle.
    REFUSED: a certificate is withheld, and the state before wasn't MONITOR. observation: the kernel's findings, see
    `findings`. Fill previous state, findings and joints in contact of `decision`.
    """
    asked, previous = 0, m.supervisor.state
    if sample.request == Request.ACCEPT:
        asked |= ACCEPTED
        if m.is_refusing != 0:  # this cycle doesn't withhold a certificate
            observation &= ~WITHHELD
    is_reporting = m.contact.is_open != 0
    supervisor.supervise(k.supervisor, m.supervisor, sample, observation, is_reporting, course.goes_on(m.contact))
    decision.previous_state = previous
    decision.observation = observation
    decision.contact_joints = observation >> CONTACT_SHIFT
    if m.supervisor.state != previous:
        asked |= LEFT
    if observation & WITHHELD and previous != SchemeState.MONITOR:
        asked |= REFUSED
    return asked


@compiled
def follow_contact(
    k: RunConstants, m: RunMemory, sample: Sample, decision: Decision, tau_ext_hat: Vector, tau_ext: Vector
) -> int:
    """Follow a contact's reports and reaction by one cycle; return REPORT if a report is due, else 0.

    Fill state, fault, reaction and `is_model_valid` of `decision`. tau_ext_hat (2,): for the reaction; tau_ext (2,):
    gives the direction of a joint when it crosses its threshold.
    """
    is_due = course.follow(
        k.contact,
        m.contact,
        m.supervisor,
        sample.cycle,
        decision.observation,
        m.is_model_valid != 0,
        tau_ext_hat,
        tau_ext,
    )
    decision.state = m.supervisor.state
    decision.fault = m.supervisor.fault
    decision.reaction = m.contact.reaction
    decision.is_model_valid = m.is_model_valid != 0
    return REPORT if is_due else 0


@released
def run_certified(
    samples: Structured, decisions: Structured, blocks: Vector, first: int, arrays: tuple[Any, ...]
) -> tuple[int, int]:
    """Run cycles of the certified scheme from `first` until one has a task for Python; return its place and its bits.

    Without such a cycle return (samples.size, 0). After a bit of BEFORE_CONTACT that cycle is not over, see
    `certified_cycle`. arrays: arguments of `certified_cycle` from `constants` on, in its order.
    """
    for place in range(first, samples.size):
        asked = certified_cycle(samples, decisions, blocks, place, *arrays)
        if asked:
            return place, asked
    return samples.size, 0


@released
def run_paper(
    samples: Structured, decisions: Structured, blocks: Vector, first: int, arrays: tuple[Any, ...]
) -> tuple[int, int]:
    """Run cycles of the paper's scheme from `first` until one has a task for Python; return its place and its bits.

    Without such a cycle return (samples.size, 0). After a bit of BEFORE_CONTACT that cycle is not over, see
    `paper_cycle`. arrays: arguments of `paper_cycle` from `constants` on, in its order.
    """
    for place in range(first, samples.size):
        asked = paper_cycle(samples, decisions, blocks, place, *arrays)
        if asked:
            return place, asked
    return samples.size, 0
