"""The state machine: its table against one written by hand, and the conditions that raise its events."""

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
from smooth_motion import settings_with

from adacd_hil.records import ArmState, FaultReason, Request, SchemeState
from adacd_hil.scheme.kernel.kernel_samples import SAMPLE, fill_sample
from adacd_hil.scheme.supervisor import findings, supervisor
from adacd_hil.scheme.supervisor.findings import CONTACT_SHIFT
from adacd_hil.scheme.supervisor.transitions import SchemeEvent, next_state
from adacd_hil.structured import zeros_of

# What each event does in each state, by hand: rows are states, columns events, "." means that nothing happens, "back"
# the state from which REACT was entered.
EVENTS = (
    "FAULT COLLISION CONTACT LATE COMPLETE COMMISSIONED ENABLED ADAPTED FITTED CERTIFIED REFUTED "
    "AT_REST CLEARED ACKNOWLEDGED PAYLOAD_ANNOUNCED PAYLOAD_CHANGED REVOKED DOUBTED MOVED CONTRADICTED"
)
EXPECTED = """
INIT        FAULT  .      .      .      COMMISSION  .       .      .        .        .        .      .        .     .     .        .        .        .         .         .
COMMISSION  FAULT  .      .      .      .           ENABLE  .      .        .        .        .      .        .     .     .        .        .        .         .         .
ENABLE      FAULT  REACT  REACT  .      .           .       ADAPT  .        .        .        .      .        .     .     .        .        .        .         COMMISSION         .
ADAPT       FAULT  REACT  REACT  .      .           .       .      MONITOR  CERTIFY  .        .      .        .     .     .        .        .        .         .         .
CERTIFY     FAULT  REACT  REACT  .      .           .       .      .        .        MONITOR  ADAPT  .        .     .     .        .        .        .         .         .
MONITOR     FAULT  REACT  REACT  REACT  .           .       .      .        .        .        .      .        .     .     PAYLOAD  .        .        STOPPED         .         REACT
REACT       FAULT  .      .      .      .           .       .      .        .        .        .      STOPPED  back  .     .        .        .        .         .         .
STOPPED     FAULT  .      .      .      .           .       .      .        .        .        .      .        .     back  PAYLOAD  ADAPT    ADAPT    .         .         .
PAYLOAD     FAULT  REACT  REACT  .      .           .       .      .        .        .        .      .        .     .     .        ADAPT    .        .         .         .
FAULT       .      .      .      .      .           .       .      .        .        .        .      .        .     .     .        .        .        .         .         .
"""  # noqa: E501
ORIGINS = ("ENABLE", "ADAPT", "CERTIFY", "MONITOR", "PAYLOAD")


def expectations():
    names = EVENTS.split()
    for line in EXPECTED.strip().splitlines():
        state, *cells = line.split()
        for event, cell in zip(names, cells, strict=True):
            yield state, event, state if cell == "." else cell


@pytest.mark.parametrize(("state", "event", "expected"), list(expectations()))
def test_every_event_in_every_state_leads_where_the_hand_written_table_says(state, event, expected):
    for origin in ORIGINS:
        following = next_state(int(SchemeState[state]), int(SchemeEvent[event]), int(SchemeState[origin]))
        assert following == SchemeState[origin if expected == "back" else expected]


@pytest.mark.parametrize("state", SchemeState)
def test_no_event_leaves_every_state_as_it_is(state):
    assert next_state(int(state), 0, int(SchemeState.MONITOR)) == state


def test_the_hand_written_table_covers_all_states_and_events():
    covered = {(state, event) for state, event, _ in expectations()}
    named = {event.name for event in SchemeEvent} - {"NONE"}
    assert covered == set(itertools.product((state.name for state in SchemeState), named))


def test_events_keep_their_numbers_which_logs_have():
    assert [(event.name, event.value) for event in SchemeEvent] == [
        (name, number) for number, name in enumerate(["NONE", *EVENTS.split()])
    ]


SETTINGS = settings_with(
    safety={"commission_s": 0.02, "phase_timeout_s": 0.1},
    termination={"timeout_s": 1.0},
    reaction={"clear_s": 0.2, "patience_s": 3.0, "rebound_s": 0.1},
    bus={"max_age_cycles": 3},
)
"""Cycles of 1 ms: 20 to commission, 100 for a phase, 1000 to learn, 50 until the arm counts as at rest, 200 until a
contact has cleared, 3000 until it needs an acknowledgement."""
UPRIGHT = replace(
    SETTINGS,
    arm=replace(SETTINGS.arm, cad_theta=()),
    estimator=replace(SETTINGS.estimator, gravity=True, P0=(*SETTINGS.estimator.P0, 50.0, 50.0)),
)
PATIENT = replace(SETTINGS, safety=replace(SETTINGS.safety, enable_timeout_s=0.3))

GOOD = ArmState(0, 0, 1, np.zeros(2), np.zeros(2), np.zeros(2), (0, 0), (0, 0), True, True, FaultReason.NONE)
ARM = {
    "off": {"is_enabled": False},
    "late": {"is_late": True},
    "incomplete": {"is_complete": False},
    "sensor": {"fault": FaultReason.SENSOR},
    "drive": {"fault": FaultReason.DRIVE},
    "aged": {"age_q": (1, 1), "age_tau_J": (1, 1)},
    "old": {"age_q": (2, 2), "age_tau_J": (2, 2)},
    "older": {"age_q": (3, 3), "age_tau_J": (3, 3)},
    "q1-too-old": {"age_q": (4, 0)},
    "q2-too-old": {"age_q": (0, 4)},
    "tau1-too-old": {"age_tau_J": (4, 0)},
    "tau2-too-old": {"age_tau_J": (0, 4)},
    "skips": {"periods": 60},
    "skips-999": {"periods": 999},
}
FOUND = {
    "rest": findings.AT_REST,
    "unloaded": findings.UNLOADED,
    "resting": findings.AT_REST | findings.UNLOADED,
    "contact": findings.CONTACT,
    "collision": findings.CONTACT | findings.COLLISION,
    "nan": findings.NOT_A_NUMBER,
    "over-limit": findings.OVER_LIMIT,
    "over-speed": findings.OVER_SPEED,
    "unseen": findings.UNSEEN,
    "adapted": findings.ADAPTED,
    "fitted": findings.FITTED,
    "certified": findings.CERTIFIED,
    "refuted": findings.REFUTED,
    "withheld": findings.WITHHELD,
}
ASKED = {request.name.lower(): request for request in Request}
WAY = {
    SchemeState.INIT: "off",
    SchemeState.COMMISSION: "off+resting*20",
    SchemeState.ENABLE: "good",
    SchemeState.ADAPT: "adapted",
    SchemeState.MONITOR: "collision",
    SchemeState.REACT: "rest*50",
    SchemeState.STOPPED: "payload",
}
"""How an arm gets from state to state the usual way; to CERTIFY and FAULT: `Run.to`."""


class Run:
    """A supervisor driven cycle by cycle, by words.

    A step is what is found, asked or wrong in a cycle, joined by +, times a number of cycles; `= STATE`: where it
    leads, `~ STATE`: through which. `is`: the cause by which that state was entered.
    """

    def __init__(self, settings=SETTINGS):
        self.k = zeros_of(supervisor.SupervisorConstants, {"states": len(SchemeState)})
        self.memory = zeros_of(supervisor.SupervisorMemory, {})
        self.m = self.memory[0]
        supervisor.fill_constants(settings, self.k[0])
        self.sample = np.zeros(1, SAMPLE)

    @property
    def state(self):
        return SchemeState(self.m.state)

    @property
    def fault(self):
        return FaultReason(self.m.fault)

    def cycle(self, words):
        arm, request, found, flags = GOOD, Request.NONE, 0, {"reporting": False, "goes-on": False}
        for word in words.split("+"):
            if word in ARM:
                arm = arm._replace(**ARM[word])
            elif word in FOUND:
                found |= FOUND[word]
            elif word in ASKED:
                request = ASKED[word]
            elif word in flags:
                flags[word] = True
            else:
                assert word == "good", word
        fill_sample(self.sample, arm, request)
        supervisor.supervise(self.k[0], self.m, self.sample[0], found, *flags.values())
        assert {int(self.m[name]) for name in self.memory.dtype.names if name.startswith("is_")} <= {0, 1}

    def play(self, steps):
        """Play steps, separated by commas, and check the states that they name."""
        for step in steps.split(","):
            what, sign, state = (part.strip() for part in re.split(r"([=~]|$)", step, maxsplit=1))
            words, _, count = what.partition("*")
            for _ in range(int(count or 1)):
                if sign == "~" and self.state.name == state:
                    break
                self.cycle(words)
            if state:
                assert self.state.name == state, f"after {step.strip()} of: {steps}"
        return self

    def to(self, state):
        """Walk to a state the usual way."""
        if state is SchemeState.FAULT:
            return self.to(SchemeState.MONITOR).play("sensor")
        if state is SchemeState.CERTIFY:
            return self.to(SchemeState.ADAPT).play("fitted")
        for _ in WAY:
            if self.state is not state:
                self.play(WAY[self.state])
        assert self.state is state
        return self


def run_in(state):
    return Run().to(state)


POWERED = tuple(SchemeState[name] for name in ("ADAPT", "CERTIFY", "MONITOR", "REACT", "STOPPED", "PAYLOAD"))
BAD = {
    "off": FaultReason.DRIVE,
    "drive": FaultReason.DRIVE,
    "sensor": FaultReason.SENSOR,
    "nan": FaultReason.NOT_A_NUMBER,
    "over-limit": FaultReason.LIMIT,
    "q1-too-old": FaultReason.DATA_AGE,
    "q2-too-old": FaultReason.DATA_AGE,
    "tau1-too-old": FaultReason.DATA_AGE,
    "tau2-too-old": FaultReason.DATA_AGE,
    "fault_torque": FaultReason.TORQUE,
    "fault_following": FaultReason.FOLLOWING,
    "fault_tampered": FaultReason.TAMPERED,
    "fault_misconfigured": FaultReason.MISCONFIGURED,
}
"""A cycle that ends the run of an arm that may have torque, and the reason."""


@pytest.mark.parametrize("state", POWERED)
@pytest.mark.parametrize("words", BAD)
def test_a_powered_arm_that_is_not_well_faults_whatever_else_there_is(state, words):
    run = run_in(state)
    assert run.fault is FaultReason.NONE
    everything = "" if words in ASKED else "+acknowledge"
    run.play(f"{words}+collision+adapted+rest{everything} = FAULT")
    assert run.fault is BAD[words]
    run.play("sensor+over-limit")
    assert run.fault is BAD[words]  # the first reason is kept


@pytest.mark.parametrize("words", [words for words in BAD if words != "off"])
def test_an_arm_that_is_not_well_while_its_drives_enable_faults(words):
    run = run_in(SchemeState.ENABLE).play(f"off+{words} = FAULT")
    assert run.fault is BAD[words]


@pytest.mark.parametrize("state", POWERED)
def test_a_model_without_a_fresh_sample_is_a_fault_in_the_fifth_cycle_and_so_is_one_with_old_ones(state):
    name = state.name
    blind = run_in(state).play(f"incomplete+unseen*4 = {name}, good = {name}, incomplete+unseen*4 = {name}")
    assert blind.play("incomplete+unseen = FAULT").fault is FaultReason.BLIND
    old = run_in(state).play(f"older = {name}, good = {name}, old*5 = {name}, old = FAULT")
    assert old.fault is FaultReason.DATA_AGE
    if state is not SchemeState.REACT:
        assert run_in(state).play("over-speed = FAULT").fault is FaultReason.LIMIT


@pytest.mark.parametrize("request_", ASKED)
def test_a_faulted_run_stays_faulted(request_):
    run_in(SchemeState.FAULT).play(f"resting+adapted+{request_}*300 = FAULT")


@pytest.mark.parametrize("words", ["rest", "unloaded", "resting+sensor", "resting+tau1-too-old", "resting+nan",
                                   "resting+over-limit", "resting+late", "resting+withheld"])  # fmt: skip
def test_one_bad_cycle_begins_commissioning_anew(words):
    run_in(SchemeState.COMMISSION).play(
        f"off+resting*19, off+{words}, off+resting*19 = COMMISSION, off+resting = ENABLE"
    )


@pytest.mark.parametrize(
    ("state", "words", "cycles", "reason"),
    [
        ("INIT", "off+incomplete", 100, FaultReason.COMMISSION_TIMEOUT),
        ("INIT", "incomplete", 100, FaultReason.COMMISSION_TIMEOUT),
        ("COMMISSION", "off", 100, FaultReason.COMMISSION_TIMEOUT),
        ("ENABLE", "off+resting", 100, FaultReason.ENABLE_TIMEOUT),
        ("ADAPT", "good", 1000, FaultReason.ADAPT_TIMEOUT),
        ("CERTIFY", "good", 999, FaultReason.ADAPT_TIMEOUT),
        ("ADAPT", "certified", 1000, FaultReason.ADAPT_TIMEOUT),
        ("ADAPT", "refuted", 1000, FaultReason.ADAPT_TIMEOUT),
        ("CERTIFY", "adapted", 999, FaultReason.ADAPT_TIMEOUT),
        ("CERTIFY", "fitted", 999, FaultReason.ADAPT_TIMEOUT),
    ],
)
def test_a_phase_that_takes_too_long_faults(state, words, cycles, reason):
    run = run_in(SchemeState[state]).play(f"{words}*{cycles - 1} = {state}, {words} = FAULT")
    assert run.fault is reason


TOUCHABLE = {name: "ADAPT" if name == "CERTIFY" else name for name in ORIGINS}
"""States in which a touch is reacted to, and where the arm goes on: a test of a fit is broken off."""


@pytest.mark.parametrize("state", TOUCHABLE)
def test_a_touch_is_reacted_to_wherever_it_is_found_and_the_arm_goes_on_where_it_was(state):
    contact = run_in(SchemeState[state]).play("contact = REACT")
    assert (contact.m.origin, contact.m.is_latched) == (SchemeState[TOUCHABLE[state]], 0)
    contact.play(f"contact+rest*500, rest*199 = REACT, rest = {TOUCHABLE[state]}")
    collision = run_in(SchemeState[state]).play("collision = REACT")
    assert collision.m.is_latched == 1
    collision.play(f"rest*200 = STOPPED, good*1000 = STOPPED, acknowledge = {TOUCHABLE[state]}")


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        ("INIT", "COMMISSION"), ("COMMISSION", "COMMISSION"), ("ENABLE", "FAULT"), ("ADAPT", "FAULT"),
        ("CERTIFY", "FAULT"), ("MONITOR", "REACT"), ("REACT", "REACT"), ("STOPPED", "STOPPED"), ("PAYLOAD", "FAULT"),
    ],
)  # fmt: skip
def test_a_host_that_is_late_holds_the_arm_or_faults(state, expected):
    run = run_in(SchemeState[state]).play(f"late = {expected}")
    assert (run.fault is FaultReason.DEADLINE) == (expected == "FAULT")
    if expected == "FAULT":  # it outranks its own effect
        assert run_in(SchemeState[state]).play("late+q1-too-old = FAULT").fault is FaultReason.DEADLINE


# A sentence about the arm, the state in which it begins, and what happens.
STORIES = """
the first complete cycle begins commissioning | INIT | off+incomplete*50 = INIT, off = COMMISSION
commissioning takes as many good cycles as asked | COMMISSION | off+resting*19 = COMMISSION, off+resting = ENABLE
a cycle without all its data does not count and begins nothing anew | COMMISSION | off+resting*19, off+incomplete+resting+unseen*3 = COMMISSION, off+resting = ENABLE
a blind model is not commissioned | COMMISSION | off+resting*19, off+incomplete+resting+unseen*5, off+resting*19 = COMMISSION
before there can be torque the host's checks ask for nothing | COMMISSION | off+fault_torque = COMMISSION, off+fault_tampered = COMMISSION
an arm that moves before its drives are enabled must lie still again | ENABLE | off*19 = ENABLE, off+resting = ENABLE, off*19 = ENABLE, off = COMMISSION, off+resting*19 = COMMISSION, off+resting = ENABLE, resting = ADAPT
an arm that sags until its drives hold it is enabled | ENABLE | off*19 = ENABLE, good = ADAPT
an arm whose drives are still off does not react to a touch | ENABLE | off+collision = ENABLE
skipped periods count toward a timeout | ADAPT | skips-999 = ADAPT, good = FAULT
success in the last moment is no timeout | ADAPT | good*999, adapted = MONITOR
the other states have no time limit: monitoring | MONITOR | good*5000 = MONITOR
the other states have no time limit: reacting | REACT | good*5000 = REACT
the other states have no time limit: stopped | STOPPED | good*5000 = STOPPED
the other states have no time limit: a payload | PAYLOAD | good*5000 = PAYLOAD, rest*200 = PAYLOAD
a touch outranks what the estimate says in the same cycle | ADAPT | contact+adapted+fitted+certified+refuted = REACT
a touch outranks what a test says in the same cycle | CERTIFY | contact+adapted+fitted+certified+refuted = REACT
a contact that comes back clears anew | MONITOR | contact, rest*199, contact+rest, rest*199 = REACT, rest = MONITOR
a contact does not clear before the arm rests and its report is final | MONITOR | contact, good*1000 = REACT, rest+reporting*500 = REACT, rest = MONITOR
a contact of an arm that goes on clears without rest | MONITOR | contact, goes-on*199 = REACT, goes-on = MONITOR
a contact that grows is to be acknowledged | ADAPT | contact, collision, rest*1000 = STOPPED
a contact with a late host is to be acknowledged | ADAPT | contact, contact+late, rest*1000 = STOPPED
a contact that lasts is to be acknowledged | ADAPT | contact, contact*3000, rest*1000 = STOPPED
a contact that lasts a little less is not | ADAPT | contact, contact*2799, rest*199 = REACT, rest = ADAPT
a contact that lasts just as long is | ADAPT | contact, contact*2800, rest*199 = REACT, rest = STOPPED
data one cycle old are fresh | MONITOR | aged*100 = MONITOR
a contact after a collision is not latched by it | STOPPED | acknowledge, contact, rest*1000 = MONITOR
a fit is tested and a refuted one is learnt on | CERTIFY | adapted+fitted = CERTIFY, refuted+certified = ADAPT, fitted, certified = MONITOR
a test and the learning before it share one time limit | ADAPT | good*500, fitted, good*300, refuted, good*197 = ADAPT, good = FAULT
a contact stops the clock of the adaptation and does not set it back | ADAPT | good*600, contact, rest*200, good*398 = ADAPT, good = FAULT
an adaptation after a payload has its own time | ADAPT | good*900, adapted, payload, rest*50, rest+payload_changed = ADAPT, good*999 = ADAPT, good = FAULT
hands that change the payload do not make the arm forget it: a contact | PAYLOAD | contact, payload_changed, rest*200, rest+acknowledge, rest*2 = ADAPT
hands that change the payload do not make the arm forget it: a collision | PAYLOAD | collision, payload_changed, rest*200, rest+acknowledge, rest*2 = ADAPT
a blow may throw the arm faster than its limit for a moment | MONITOR | collision, collision+over-speed*100 = REACT, over-speed = FAULT
a collision outranks the announcement of a payload | MONITOR | payload+collision = REACT
a late host outranks the announcement of a payload | MONITOR | late+payload = REACT
the arm counts as stopped after fifty milliseconds at rest | REACT | rest*49 = REACT, rest = STOPPED
rest counts from the first cycle on | INIT | off+resting*21, rest, rest+adapted, rest+collision = REACT, rest*25 = REACT, rest = STOPPED
a twitch begins the fifty milliseconds anew | REACT | rest*49, good, rest*49 = REACT, rest = STOPPED
skipped periods do not count as rest | REACT | skips+rest = REACT
the arm is not stopped before the report is final | REACT | rest+reporting*500 = REACT, rest = STOPPED
an arm that is held rests and waits for an acknowledgement | MONITOR | late, rest*50 = STOPPED, good*100 = STOPPED, acknowledge = MONITOR
an acknowledgement waits until the host is on time | STOPPED | late+acknowledge = STOPPED, late*300 = STOPPED, good = MONITOR
an acknowledgement waits until nothing pushes | STOPPED | acknowledge+contact = STOPPED, contact*300 = STOPPED, good = MONITOR
an acknowledgement while the arm monitors releases no later stop | MONITOR | acknowledge, collision, rest*50 = STOPPED, good*100 = STOPPED
an acknowledgement before the stop does not release it | REACT | acknowledge, rest*50 = STOPPED, good*100 = STOPPED
an acknowledgement is good for one stop | STOPPED | acknowledge = MONITOR, collision, rest*50 = STOPPED, good*100 = STOPPED
later evidence against the certificate stops the arm for the user | MONITOR | withheld = REACT is CONTRADICTED, rest*50 = STOPPED
a stopped arm is learnt anew at a word even while something seems to push | STOPPED | relearn+contact = STOPPED, contact+rest*49 = STOPPED, contact+rest = ADAPT is REVOKED
a changed payload means nothing in a stop that nothing doubts | STOPPED | payload_changed, rest*100 = STOPPED
a payload is announced to an arm that monitors | MONITOR | payload = PAYLOAD
a payload is announced to an arm that is stopped | STOPPED | payload = PAYLOAD
a payload announced during the test of the fit waits for its end | CERTIFY | payload, refuted, fitted, certified = MONITOR, good = PAYLOAD
a payload announced during adaptation waits for its end | ADAPT | payload = ADAPT, adapted = MONITOR, good = PAYLOAD
a payload announced before a stop does not release it: learning | ADAPT | payload+collision, rest*50 = STOPPED, good*300 = STOPPED, payload = PAYLOAD
a payload announced before a stop does not release it: testing | CERTIFY | payload+collision, rest*50 = STOPPED, good*300 = STOPPED, payload = PAYLOAD
a payload announced before a stop is served once that is acknowledged | MONITOR | payload+collision, rest*50 = STOPPED, good*300 = STOPPED, acknowledge = MONITOR, good = PAYLOAD
a payload announced while the arm reacts is served once that is acknowledged | REACT | payload+collision, rest*50 = STOPPED, good*300 = STOPPED, acknowledge = MONITOR, good = PAYLOAD
a payload announced again while it is changed is the same change | PAYLOAD | payload, rest*50, rest+payload_changed = ADAPT, adapted, good*10 = MONITOR
evidence against the certificate keeps no stopped arm | STOPPED | withheld+acknowledge = MONITOR
an adaptation asked for has its own time | ADAPT | good*900, adapted, collision, rest*50 = STOPPED, relearn, rest*50 = ADAPT, good*998 = ADAPT
a payload announced in one stop does not release another | STOPPED | payload, collision, rest*50 = STOPPED, good*300 = STOPPED
a changed payload waits until the arm rests | PAYLOAD | good*10, payload_changed = PAYLOAD, rest*49 = PAYLOAD, rest = ADAPT
a changed payload that was not announced is ignored while the arm monitors | MONITOR | payload_changed+rest*200 = MONITOR
a changed payload that was not announced is ignored in a stop | STOPPED | payload_changed+rest*200 = STOPPED
the end of the run is left to the control layer: learning | ADAPT | finish*10 = ADAPT
the end of the run is left to the control layer: monitoring | MONITOR | finish*10 = MONITOR
the end of the run is left to the control layer: stopped | STOPPED | finish*10 = STOPPED
without gravity a payload's weight is no contact: the touch holds the arm | PAYLOAD | contact+rest*10, contact+rest+payload_changed, contact+rest*100 = REACT, rest*199 = REACT, rest = PAYLOAD
without gravity the same of a collision | PAYLOAD | collision+rest*10, collision+rest+payload_changed, collision+rest*100 = STOPPED
"""  # noqa: E501
UPRIGHT_STORIES = """
the weight of a changed payload does not hold the arm: a contact | PAYLOAD | contact+rest*10, contact+rest+payload_changed, contact+rest*100 ~ ADAPT
the weight of a changed payload does not hold the arm: a collision | PAYLOAD | collision+rest*10, collision+rest+payload_changed, collision+rest*100 ~ ADAPT
the weight holds the arm until somebody says that the payload was changed | PAYLOAD | contact+rest*12000, contact+rest+acknowledge = STOPPED, contact+rest+payload_changed = ADAPT
a word of before a touch does not let the arm go on beneath it: a contact | PAYLOAD | payload_changed, contact = REACT, contact+rest*100 = REACT, contact+rest+payload_changed, contact+rest*100 ~ ADAPT
a word of before a touch does not let the arm go on beneath it: a collision | PAYLOAD | payload_changed, collision = REACT, collision+rest*100 = STOPPED, collision+rest+payload_changed, collision+rest*100 ~ ADAPT
a word of an earlier touch does not let the arm go on beneath a later one | PAYLOAD | contact, contact+rest+payload_changed, contact+rest*100 ~ ADAPT, adapted, payload = PAYLOAD, payload_changed, contact = REACT, contact+rest*100 = REACT
another announcement of a payload is no word of its weight | PAYLOAD | payload_changed, contact, contact+payload = REACT, contact+rest*100 = REACT
a touch outside of a payload change wants to be acknowledged | MONITOR | collision+rest*51 = STOPPED, rest+payload_changed, rest*12000 = STOPPED
"""  # noqa: E501
PATIENT_STORIES = """
drives may be given longer to be enabled than the other phases | ENABLE | off+resting*299 = ENABLE, off+resting = FAULT
the other phases then take no longer | COMMISSION | off*99 = COMMISSION, off = FAULT
"""
TOLD = [
    pytest.param(settings, *(part.strip() for part in line.split("|")[1:]), id=line.split("|")[0].strip())
    for settings, stories in (
        (SETTINGS, STORIES), (UPRIGHT, UPRIGHT_STORIES), (PATIENT, PATIENT_STORIES)
    )
    for line in stories.strip().splitlines()
]  # fmt: skip


@pytest.mark.parametrize(("settings", "state", "steps"), TOLD)
def test_a_story(settings, state, steps):
    told, _, cause = steps.partition(" is ")
    run = Run(settings).to(SchemeState[state]).play(told)
    if cause:
        cause, _, rest = cause.partition(",")
        assert SchemeEvent(run.m.cause).name == cause
        if rest:
            run.play(rest)


@pytest.mark.parametrize("state", [state for state in SchemeState if state is not SchemeState.STOPPED])
def test_only_a_stopped_arm_is_learnt_anew(state):
    asked, plain = run_in(state).play("relearn, rest*100"), run_in(state).play("good, rest*100")
    assert asked.state is plain.state
    assert asked.m.cause != SchemeEvent.REVOKED


@pytest.mark.parametrize(
    ("steps", "cause"),
    [
        ("good*1000 = STOPPED, acknowledge = ADAPT", SchemeEvent.REVOKED),
        ("payload_changed, rest*50 = ADAPT", SchemeEvent.PAYLOAD_CHANGED),
        ("acknowledge = ADAPT, adapted, collision, rest*50 = STOPPED, payload_changed, rest*100 = STOPPED", None),
        ("acknowledge = ADAPT, adapted, contact, payload_changed, contact+rest*100 = REACT", None),
    ],
    ids=[
        "it holds until the user says how to go on",
        "a payload needs no announcement",
        "it ends with its stop",
        "it says nothing of a later contact",
    ],
)
def test_a_doubted_arm(steps, cause):
    run = run_in(SchemeState.MONITOR)
    supervisor.doubt(run.m)
    assert (run.state, run.m.is_latched, run.m.is_doubted) == (SchemeState.STOPPED, 1, 1)
    run.play(steps)
    assert cause is None or run.m.cause == cause


def test_the_joints_of_an_observation_are_beyond_its_flags():
    assert findings.WITHHELD < 1 << CONTACT_SHIFT
