"""The state machine: its table against one written by hand, and the conditions that raise its events."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from smooth_motion import settings_with

from adacd_hil.records import ArmState, FaultReason, Request, SchemeState
from adacd_hil.scheme.kernel.kernel_samples import SAMPLE, fill_sample
from adacd_hil.scheme.supervisor import supervisor
from adacd_hil.scheme.supervisor.supervisor import REST_HOLD_S, UNREST_S, Supervisor
from adacd_hil.scheme.supervisor.transitions import CONTACT_SHIFT, TRANSITIONS, Observation, SchemeEvent, next_state
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


def test_react_is_entered_from_these_states_only():
    entered_from = {state.name for state, row in TRANSITIONS.items() if SchemeState.REACT in row.values()}
    assert entered_from == set(ORIGINS)


@pytest.mark.parametrize("state", SchemeState)
def test_no_event_leaves_every_state_as_it_is(state):
    assert next_state(int(state), 0, int(SchemeState.MONITOR)) == state


def test_the_hand_written_table_covers_all_states_and_events():
    covered = {(state, event) for state, event, _ in expectations()}
    named = {event.name for event in SchemeEvent} - {"NONE"}
    assert covered == set(itertools.product((state.name for state in SchemeState), named))


def test_events_are_numbered_in_order_of_precedence():
    assert [(event.name, event.value) for event in SchemeEvent] == [
        (name, number) for number, name in enumerate(["NONE", *EVENTS.split()])
    ]


SETTINGS = settings_with(
    safety={"commission_s": 0.02, "phase_timeout_s": 0.1},
    termination={"timeout_s": 1.0},
    reaction={"clear_s": 0.2, "patience_s": 3.0, "rebound_s": 0.1},
    bus={"max_age_cycles": 3},
)
REST_CYCLES = round(REST_HOLD_S / SETTINGS.bus.period_s)
UNREST_CYCLES = round(UNREST_S / SETTINGS.bus.period_s)
CLEAR_CYCLES = 200
PATIENCE_CYCLES = 3000
RESTING = Observation.AT_REST | Observation.UNLOADED
CONTACT = Observation.CONTACT
COLLISION = Observation.CONTACT | Observation.COLLISION

GOOD = ArmState(
    cycle=0,
    t_ns=0,
    periods=1,
    q=np.zeros(2),
    dq=np.zeros(2),
    tau_J=np.zeros(2),
    age_q=(0, 0),
    age_tau_J=(0, 0),
    is_enabled=True,
    is_complete=True,
    fault=FaultReason.NONE,
)
DISABLED = GOOD._replace(is_enabled=False)


class Run:
    """A supervisor driven cycle by cycle."""

    def __init__(self, settings=SETTINGS):
        self.k = zeros_of(supervisor.SupervisorConstants, {"states": len(SchemeState)})
        self.memory = zeros_of(supervisor.SupervisorMemory, {})
        supervisor.fill_constants(settings, self.k[0])
        supervisor.begin(self.memory[0])
        self.supervisor = Supervisor(self.memory)
        self.sample = np.zeros(1, SAMPLE)

    @property
    def state(self):
        return self.supervisor.state

    @property
    def fault(self):
        return FaultReason(self.memory[0].fault)

    @property
    def is_latched(self):
        return bool(self.memory[0].is_latched)

    def step(
        self, arm=GOOD, request=Request.NONE, observation=Observation.NONE, is_reporting=False, goes_on=False, cycles=1
    ):
        fill_sample(self.sample, arm, request)
        for _ in range(cycles):
            supervisor.supervise(self.k[0], self.memory[0], self.sample[0], int(observation), is_reporting, goes_on)
        return self.state

    def to(self, state):
        """Walk to a state the usual way."""
        if state is SchemeState.FAULT:
            self.to(SchemeState.MONITOR).step(GOOD._replace(fault=FaultReason.SENSOR))
            return self
        if state is SchemeState.CERTIFY:
            assert self.to(SchemeState.ADAPT).step(observation=Observation.FITTED) is state
            return self
        next_step = {
            SchemeState.INIT: lambda: self.step(DISABLED),
            SchemeState.COMMISSION: lambda: self.step(DISABLED, observation=RESTING, cycles=20),
            SchemeState.ENABLE: self.step,
            SchemeState.ADAPT: lambda: self.step(observation=Observation.ADAPTED),
            SchemeState.MONITOR: lambda: self.step(observation=COLLISION),
            SchemeState.REACT: lambda: self.step(observation=Observation.AT_REST, cycles=REST_CYCLES),
            SchemeState.STOPPED: lambda: self.step(request=Request.PAYLOAD),
        }
        for _ in next_step:
            if self.state is not state:
                next_step[self.state]()
        assert self.state is state
        return self


def run_in(state):
    return Run().to(state)


POWERED = (
    SchemeState.ADAPT,
    SchemeState.CERTIFY,
    SchemeState.MONITOR,
    SchemeState.REACT,
    SchemeState.STOPPED,
    SchemeState.PAYLOAD,
)
CHECKED = (SchemeState.ENABLE, *POWERED)
BAD = [
    (GOOD._replace(is_enabled=False), Observation.NONE, FaultReason.DRIVE),
    (GOOD._replace(fault=FaultReason.DRIVE), Observation.NONE, FaultReason.DRIVE),
    (GOOD._replace(fault=FaultReason.SENSOR), Observation.NONE, FaultReason.SENSOR),
    (GOOD, Observation.NOT_A_NUMBER, FaultReason.NOT_A_NUMBER),
    (GOOD, Observation.OVER_LIMIT, FaultReason.LIMIT),
    (GOOD._replace(age_q=(4, 0)), Observation.NONE, FaultReason.DATA_AGE),
    (GOOD._replace(age_q=(0, 4)), Observation.NONE, FaultReason.DATA_AGE),
    (GOOD._replace(age_tau_J=(4, 0)), Observation.NONE, FaultReason.DATA_AGE),
    (GOOD._replace(age_tau_J=(0, 4)), Observation.NONE, FaultReason.DATA_AGE),
]
LATE = GOOD._replace(is_late=True)


@pytest.mark.parametrize("state", POWERED)
@pytest.mark.parametrize(("arm", "observation", "reason"), BAD)
def test_a_powered_arm_that_is_not_well_faults(state, arm, observation, reason):
    run = run_in(state)
    assert run.step(arm, observation=observation) is SchemeState.FAULT
    assert run.fault is reason


@pytest.mark.parametrize(("arm", "observation", "reason"), BAD[1:])
def test_an_arm_that_is_not_well_while_its_drives_enable_faults(arm, observation, reason):
    run = run_in(SchemeState.ENABLE)
    run.step(arm._replace(is_enabled=False), observation=observation)
    assert run.fault is reason


@pytest.mark.parametrize("state", CHECKED)
def test_data_as_old_as_allowed_is_no_fault(state):
    run = run_in(state)
    assert run.step(GOOD._replace(age_q=(3, 3), age_tau_J=(3, 3))) is not SchemeState.FAULT


@pytest.mark.parametrize("state", [state for state in POWERED if state is not SchemeState.REACT])
def test_an_arm_that_is_too_fast_without_a_blow_faults(state):
    assert run_in(state).step(observation=Observation.OVER_SPEED) is SchemeState.FAULT


@pytest.mark.parametrize("state", POWERED)
def test_a_fault_outranks_everything_else_in_its_cycle(state):
    run = run_in(state)
    everything = COLLISION | Observation.ADAPTED | Observation.AT_REST | Observation.OVER_LIMIT
    assert run.step(observation=everything, request=Request.ACKNOWLEDGE) is SchemeState.FAULT


@pytest.mark.parametrize("request_", Request)
def test_a_faulted_run_stays_faulted(request_):
    run = run_in(SchemeState.FAULT)
    good_news = RESTING | Observation.ADAPTED
    assert run.step(observation=good_news, request=request_, cycles=300) is SchemeState.FAULT


def test_a_fault_keeps_its_first_reason():
    run = run_in(SchemeState.FAULT)
    run.step(observation=Observation.OVER_LIMIT)
    assert run.fault is FaultReason.SENSOR


@pytest.mark.parametrize("state", [SchemeState.INIT, SchemeState.COMMISSION, SchemeState.ENABLE, *POWERED])
def test_without_a_fault_there_is_no_reason(state):
    assert run_in(state).fault is FaultReason.NONE


def test_the_first_complete_cycle_begins_commissioning():
    run = Run()
    assert run.step(DISABLED._replace(is_complete=False), cycles=50) is SchemeState.INIT
    assert run.step(DISABLED) is SchemeState.COMMISSION


def test_commissioning_takes_as_many_good_cycles_as_asked():
    run = run_in(SchemeState.COMMISSION)
    assert run.step(DISABLED, observation=RESTING, cycles=19) is SchemeState.COMMISSION
    assert run.step(DISABLED, observation=RESTING) is SchemeState.ENABLE


@pytest.mark.parametrize(
    ("arm", "observation"),
    [
        (DISABLED, Observation.AT_REST),
        (DISABLED, Observation.UNLOADED),
        (DISABLED._replace(fault=FaultReason.SENSOR), RESTING),
        (DISABLED._replace(age_tau_J=(9, 0)), RESTING),
        (DISABLED, RESTING | Observation.NOT_A_NUMBER),
        (DISABLED, RESTING | Observation.OVER_LIMIT),
        (DISABLED._replace(is_late=True), RESTING),
    ],
)
def test_one_bad_cycle_begins_commissioning_anew(arm, observation):
    run = run_in(SchemeState.COMMISSION)
    run.step(DISABLED, observation=RESTING, cycles=19)
    run.step(arm, observation=observation)
    assert run.step(DISABLED, observation=RESTING, cycles=19) is SchemeState.COMMISSION
    assert run.step(DISABLED, observation=RESTING) is SchemeState.ENABLE


def test_an_arm_that_moves_before_its_drives_are_enabled_must_lie_still_again():
    run = run_in(SchemeState.ENABLE)
    assert run.step(DISABLED, cycles=UNREST_CYCLES - 1) is SchemeState.ENABLE
    assert run.step(DISABLED, observation=RESTING) is SchemeState.ENABLE
    assert run.step(DISABLED, cycles=UNREST_CYCLES - 1) is SchemeState.ENABLE
    assert run.step(DISABLED) is SchemeState.COMMISSION
    assert run.step(DISABLED, observation=RESTING, cycles=19) is SchemeState.COMMISSION
    assert run.step(DISABLED, observation=RESTING) is SchemeState.ENABLE
    assert run.step(observation=RESTING) is SchemeState.ADAPT


def test_an_arm_that_sags_until_its_drives_hold_it_is_enabled():
    run = run_in(SchemeState.ENABLE)
    assert run.step(DISABLED, cycles=UNREST_CYCLES - 1) is SchemeState.ENABLE
    assert run.step() is SchemeState.ADAPT


def test_a_cycle_without_all_its_data_does_not_count_and_begins_nothing_anew():
    run = run_in(SchemeState.COMMISSION)
    run.step(DISABLED, observation=RESTING, cycles=19)
    missing = DISABLED._replace(is_complete=False)
    assert run.step(missing, observation=RESTING | Observation.UNSEEN, cycles=3) is SchemeState.COMMISSION
    assert run.step(DISABLED, observation=RESTING) is SchemeState.ENABLE


def test_a_blind_model_is_not_commissioned():
    run = run_in(SchemeState.COMMISSION)
    run.step(DISABLED, observation=RESTING, cycles=19)
    run.step(DISABLED._replace(is_complete=False), observation=RESTING | Observation.UNSEEN, cycles=5)
    assert run.step(DISABLED, observation=RESTING, cycles=19) is SchemeState.COMMISSION


@pytest.mark.parametrize("state", sorted(POWERED))
def test_a_model_without_a_fresh_sample_is_a_fault_in_the_fifth_cycle_and_so_is_one_with_old_ones(state):
    unseen = Observation.UNSEEN
    run = run_in(state)
    assert run.step(GOOD._replace(is_complete=False), observation=unseen, cycles=4) is state
    assert run.step(GOOD) is state
    assert run.step(GOOD._replace(is_complete=False), observation=unseen, cycles=4) is state
    assert run.step(GOOD._replace(is_complete=False), observation=unseen) is SchemeState.FAULT
    assert run.fault is FaultReason.BLIND
    run = run_in(state)
    old = GOOD._replace(age_q=(2, 2), age_tau_J=(2, 2))
    assert run.step(old, cycles=5) is state
    assert run.step(old) is SchemeState.FAULT
    assert run.fault is FaultReason.DATA_AGE


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (Request.FAULT_TORQUE, FaultReason.TORQUE),
        (Request.FAULT_FOLLOWING, FaultReason.FOLLOWING),
        (Request.FAULT_TAMPERED, FaultReason.TAMPERED),
        (Request.FAULT_MISCONFIGURED, FaultReason.MISCONFIGURED),
    ],
)
def test_the_host_s_own_checks_ask_for_a_fault_of_an_arm_that_may_have_torque(request_, reason):
    for state in POWERED:
        run = run_in(state)
        assert run.step(GOOD, request=request_) is SchemeState.FAULT
        assert run.fault is reason
    run = run_in(SchemeState.COMMISSION)
    assert run.step(DISABLED, request=request_) is SchemeState.COMMISSION


@pytest.mark.parametrize(
    ("state", "cycles", "reason"),
    [
        (SchemeState.COMMISSION, 100, FaultReason.COMMISSION_TIMEOUT),
        (SchemeState.ENABLE, 100, FaultReason.ENABLE_TIMEOUT),
        (SchemeState.ADAPT, 1000, FaultReason.ADAPT_TIMEOUT),
        (SchemeState.CERTIFY, 1000 - 1, FaultReason.ADAPT_TIMEOUT),
    ],
)
def test_a_phase_that_takes_too_long_faults(state, cycles, reason):
    run = run_in(state)
    arm = DISABLED if reason in (FaultReason.COMMISSION_TIMEOUT, FaultReason.ENABLE_TIMEOUT) else GOOD
    observation = RESTING if state is SchemeState.ENABLE else Observation.NONE
    assert run.step(arm, observation=observation, cycles=cycles - 1) is state
    assert run.step(arm, observation=observation) is SchemeState.FAULT
    assert run.fault is reason


def test_drives_may_be_given_longer_to_be_enabled_than_the_other_phases():
    patient = replace(SETTINGS, safety=replace(SETTINGS.safety, enable_timeout_s=0.3))
    run = Run(patient).to(SchemeState.ENABLE)
    assert run.step(DISABLED, observation=RESTING, cycles=299) is SchemeState.ENABLE
    assert run.step(DISABLED, observation=RESTING) is SchemeState.FAULT
    run = Run(patient).to(SchemeState.COMMISSION)
    assert run.step(DISABLED, cycles=100) is SchemeState.FAULT


def test_an_arm_that_never_completes_a_cycle_faults_in_time():
    run = Run()
    arm = DISABLED._replace(is_complete=False)
    assert run.step(arm, cycles=99) is SchemeState.INIT
    assert run.step(arm) is SchemeState.FAULT
    assert run.fault is FaultReason.COMMISSION_TIMEOUT


def test_skipped_periods_count_toward_a_timeout():
    run = run_in(SchemeState.ADAPT)
    assert run.step(GOOD._replace(periods=999)) is SchemeState.ADAPT
    assert run.step() is SchemeState.FAULT


def test_success_in_the_last_moment_is_no_timeout():
    run = run_in(SchemeState.ADAPT)
    run.step(cycles=999)
    assert run.step(observation=Observation.ADAPTED) is SchemeState.MONITOR


@pytest.mark.parametrize("state", [SchemeState.MONITOR, SchemeState.REACT, SchemeState.STOPPED, SchemeState.PAYLOAD])
def test_a_state_without_a_time_limit_lasts(state):
    assert run_in(state).step(cycles=5000) is state


def test_an_arm_that_rests_in_payload_waits_until_the_payload_has_been_changed():
    assert run_in(SchemeState.PAYLOAD).step(observation=Observation.AT_REST, cycles=200) is SchemeState.PAYLOAD


def test_each_step_returns_the_state_that_it_leads_to():
    run = Run()
    assert run.step(DISABLED._replace(is_complete=False)) is SchemeState.INIT
    assert run.step(DISABLED) is SchemeState.COMMISSION


TOUCHABLE = [SchemeState[name] for name in ORIGINS]


def goes_on_in(state):
    """Return where an arm goes on that was touched in a state: where it was, but a test of a fit is broken off."""
    return SchemeState.ADAPT if state is SchemeState.CERTIFY else state


@pytest.mark.parametrize("state", TOUCHABLE)
@pytest.mark.parametrize(("observation", "is_latched"), [(CONTACT, False), (COLLISION, True)])
def test_a_touch_is_reacted_to_wherever_it_is_found(state, observation, is_latched):
    run = run_in(state)
    assert run.step(observation=observation) is SchemeState.REACT
    assert run.supervisor.origin is goes_on_in(state)
    assert run.is_latched is is_latched


def test_an_arm_whose_drives_are_still_off_does_not_react_to_a_touch():
    run = run_in(SchemeState.ENABLE)
    assert run.step(DISABLED, observation=COLLISION) is SchemeState.ENABLE


@pytest.mark.parametrize("state", [SchemeState.ADAPT, SchemeState.CERTIFY])
def test_a_touch_outranks_whatever_the_estimate_says_in_the_same_cycle(state):
    verdicts = Observation.ADAPTED | Observation.FITTED | Observation.CERTIFIED | Observation.REFUTED
    assert run_in(state).step(observation=CONTACT | verdicts) is SchemeState.REACT


@pytest.mark.parametrize("state", TOUCHABLE)
def test_a_contact_that_has_cleared_lets_the_arm_go_on_where_it_was(state):
    run = run_in(state)
    run.step(observation=CONTACT | Observation.AT_REST, cycles=500)
    assert run.step(observation=Observation.AT_REST, cycles=CLEAR_CYCLES - 1) is SchemeState.REACT
    assert run.step(observation=Observation.AT_REST) is goes_on_in(state)


@pytest.mark.parametrize("state", TOUCHABLE)
def test_an_acknowledged_collision_lets_the_arm_go_on_where_it_was(state):
    run = run_in(state)
    run.step(observation=COLLISION)
    assert run.step(observation=Observation.AT_REST, cycles=CLEAR_CYCLES) is SchemeState.STOPPED
    assert run.step(cycles=1000) is SchemeState.STOPPED
    assert run.step(request=Request.ACKNOWLEDGE) is goes_on_in(state)


def test_a_contact_that_comes_back_clears_anew():
    run = run_in(SchemeState.MONITOR)
    run.step(observation=CONTACT)
    run.step(observation=Observation.AT_REST, cycles=CLEAR_CYCLES - 1)
    run.step(observation=CONTACT | Observation.AT_REST)
    assert run.step(observation=Observation.AT_REST, cycles=CLEAR_CYCLES - 1) is SchemeState.REACT
    assert run.step(observation=Observation.AT_REST) is SchemeState.MONITOR


def test_a_contact_does_not_clear_before_the_arm_rests_and_its_report_is_final():
    run = run_in(SchemeState.MONITOR)
    run.step(observation=CONTACT)
    assert run.step(cycles=1000) is SchemeState.REACT
    assert run.step(observation=Observation.AT_REST, is_reporting=True, cycles=500) is SchemeState.REACT
    assert run.step(observation=Observation.AT_REST) is SchemeState.MONITOR


def test_a_contact_of_an_arm_that_goes_on_clears_without_rest():
    run = run_in(SchemeState.MONITOR)
    run.step(observation=CONTACT)
    assert run.step(goes_on=True, cycles=CLEAR_CYCLES - 1) is SchemeState.REACT
    assert run.step(goes_on=True) is SchemeState.MONITOR


@pytest.mark.parametrize(
    ("arm", "observation", "cycles"),
    [(GOOD, COLLISION, 1), (LATE, CONTACT, 1), (GOOD, CONTACT, PATIENCE_CYCLES)],
)
def test_a_contact_that_grows_or_lasts_is_to_be_acknowledged(arm, observation, cycles):
    run = run_in(SchemeState.ADAPT)
    run.step(observation=CONTACT)
    run.step(arm, observation=observation, cycles=cycles)
    assert run.is_latched
    assert run.step(observation=Observation.AT_REST, cycles=1000) is SchemeState.STOPPED


def test_a_contact_after_a_collision_is_not_latched_by_it():
    run = run_in(SchemeState.STOPPED)
    run.step(request=Request.ACKNOWLEDGE)
    run.step(observation=CONTACT)
    assert run.step(observation=Observation.AT_REST, cycles=1000) is SchemeState.MONITOR


def test_a_fit_is_tested_and_a_refuted_one_is_learnt_on():
    run = run_in(SchemeState.CERTIFY)
    assert run.step(observation=Observation.ADAPTED | Observation.FITTED) is SchemeState.CERTIFY
    assert run.step(observation=Observation.REFUTED | Observation.CERTIFIED) is SchemeState.ADAPT
    run.step(observation=Observation.FITTED)
    assert run.step(observation=Observation.CERTIFIED) is SchemeState.MONITOR


def test_a_test_and_what_was_learnt_before_it_share_one_time_limit():
    run = run_in(SchemeState.ADAPT)
    run.step(cycles=500)
    run.step(observation=Observation.FITTED)
    run.step(cycles=300)
    run.step(observation=Observation.REFUTED)
    assert run.step(cycles=197) is SchemeState.ADAPT
    assert run.step() is SchemeState.FAULT


def test_a_contact_stops_the_clock_of_the_adaptation_and_does_not_set_it_back():
    run = run_in(SchemeState.ADAPT)
    run.step(cycles=600)
    run.step(observation=CONTACT)
    run.step(observation=Observation.AT_REST, cycles=CLEAR_CYCLES)
    assert run.step(cycles=398) is SchemeState.ADAPT
    assert run.step() is SchemeState.FAULT


def test_an_adaptation_after_a_payload_has_its_own_time():
    run = run_in(SchemeState.ADAPT)
    run.step(cycles=900)
    run.step(observation=Observation.ADAPTED)
    run.step(request=Request.PAYLOAD)
    run.step(observation=Observation.AT_REST, cycles=REST_CYCLES)
    assert run.step(observation=Observation.AT_REST, request=Request.PAYLOAD_CHANGED) is SchemeState.ADAPT
    assert run.step(cycles=999) is SchemeState.ADAPT


@pytest.mark.parametrize("observation", [CONTACT, COLLISION])
def test_hands_that_change_the_payload_do_not_make_the_arm_forget_that_it_was_changed(observation):
    run = run_in(SchemeState.PAYLOAD)
    run.step(observation=observation)
    run.step(request=Request.PAYLOAD_CHANGED)
    run.step(observation=Observation.AT_REST, cycles=CLEAR_CYCLES)
    run.step(observation=Observation.AT_REST, request=Request.ACKNOWLEDGE)
    assert run.step(observation=Observation.AT_REST, cycles=2) is SchemeState.ADAPT


UPRIGHT = replace(
    SETTINGS,
    arm=replace(SETTINGS.arm, cad_theta=()),
    estimator=replace(SETTINGS.estimator, gravity=True, P0=(*SETTINGS.estimator.P0, 50.0, 50.0)),
)


@pytest.mark.parametrize("observation", [CONTACT, COLLISION])
def test_the_weight_of_a_changed_payload_does_not_hold_an_upright_arm(observation):
    pulled = observation | Observation.AT_REST
    for settings, is_learnt in ((UPRIGHT, True), (SETTINGS, False)):
        run = Run(settings).to(SchemeState.PAYLOAD)
        run.step(observation=pulled, cycles=10)
        run.step(observation=pulled, request=Request.PAYLOAD_CHANGED)
        states = {run.step(observation=pulled) for _ in range(2 * REST_CYCLES)}
        assert (SchemeState.ADAPT in states) is is_learnt


def test_the_weight_of_a_payload_holds_an_upright_arm_until_somebody_says_that_it_was_changed():
    run = Run(UPRIGHT).to(SchemeState.PAYLOAD)
    run.step(observation=CONTACT | Observation.AT_REST, cycles=12_000)
    assert run.step(observation=CONTACT | Observation.AT_REST, request=Request.ACKNOWLEDGE) is SchemeState.STOPPED
    assert run.step(observation=CONTACT | Observation.AT_REST, request=Request.PAYLOAD_CHANGED) is SchemeState.ADAPT


@pytest.mark.parametrize("observation", [CONTACT, COLLISION])
def test_a_word_of_before_a_touch_does_not_let_an_upright_arm_go_on_beneath_it(observation):
    run = Run(UPRIGHT).to(SchemeState.PAYLOAD)
    run.step(request=Request.PAYLOAD_CHANGED)
    assert run.step(observation=observation) is SchemeState.REACT
    states = {run.step(observation=observation | Observation.AT_REST) for _ in range(2 * REST_CYCLES)}
    assert SchemeState.ADAPT not in states
    said = [run.step(observation=observation | Observation.AT_REST, request=Request.PAYLOAD_CHANGED)]
    said += [run.step(observation=observation | Observation.AT_REST) for _ in range(2 * REST_CYCLES)]
    assert SchemeState.ADAPT in said


def test_a_touch_outside_of_a_payload_change_still_wants_to_be_acknowledged_of_an_upright_arm():
    run = Run(UPRIGHT).to(SchemeState.MONITOR)
    run.step(observation=COLLISION | Observation.AT_REST, cycles=REST_CYCLES)
    run.step(observation=Observation.AT_REST, request=Request.PAYLOAD_CHANGED)
    assert run.step(observation=Observation.AT_REST, cycles=12_000) is SchemeState.STOPPED


def test_a_blow_may_throw_the_arm_faster_than_its_limit_for_a_moment():
    run = run_in(SchemeState.MONITOR)
    run.step(observation=COLLISION)
    assert run.step(observation=COLLISION | Observation.OVER_SPEED, cycles=100) is SchemeState.REACT
    assert run.step(observation=Observation.OVER_SPEED) is SchemeState.FAULT
    assert run.fault is FaultReason.LIMIT


def test_the_joints_of_an_observation_are_beyond_its_flags():
    assert max(Observation) < 1 << CONTACT_SHIFT


def test_a_collision_outranks_the_announcement_of_a_payload():
    run = run_in(SchemeState.MONITOR)
    assert run.step(request=Request.PAYLOAD, observation=COLLISION) is SchemeState.REACT


def test_the_arm_counts_as_stopped_after_fifty_milliseconds_at_rest():
    run = run_in(SchemeState.REACT)
    assert run.step(observation=Observation.AT_REST, cycles=49) is SchemeState.REACT
    assert run.step(observation=Observation.AT_REST) is SchemeState.STOPPED


def test_rest_counts_from_the_first_cycle_on():
    run = Run()
    run.step(DISABLED, observation=RESTING, cycles=21)
    run.step(observation=Observation.AT_REST)
    run.step(observation=Observation.AT_REST | Observation.ADAPTED)
    assert run.step(observation=Observation.AT_REST | COLLISION) is SchemeState.REACT
    assert run.step(observation=Observation.AT_REST, cycles=REST_CYCLES - 25) is SchemeState.REACT
    assert run.step(observation=Observation.AT_REST) is SchemeState.STOPPED


def test_a_twitch_begins_the_fifty_milliseconds_anew():
    run = run_in(SchemeState.REACT)
    run.step(observation=Observation.AT_REST, cycles=49)
    run.step()
    assert run.step(observation=Observation.AT_REST, cycles=49) is SchemeState.REACT


def test_skipped_periods_do_not_count_as_rest():
    run = run_in(SchemeState.REACT)
    assert run.step(GOOD._replace(periods=60), observation=Observation.AT_REST) is SchemeState.REACT


def test_the_arm_is_not_stopped_before_the_report_is_final():
    run = run_in(SchemeState.REACT)
    assert run.step(observation=Observation.AT_REST, is_reporting=True, cycles=500) is SchemeState.REACT
    assert run.step(observation=Observation.AT_REST) is SchemeState.STOPPED


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        (SchemeState.INIT, SchemeState.COMMISSION),
        (SchemeState.COMMISSION, SchemeState.COMMISSION),
        (SchemeState.ENABLE, SchemeState.FAULT),
        (SchemeState.ADAPT, SchemeState.FAULT),
        (SchemeState.CERTIFY, SchemeState.FAULT),
        (SchemeState.MONITOR, SchemeState.REACT),
        (SchemeState.REACT, SchemeState.REACT),
        (SchemeState.STOPPED, SchemeState.STOPPED),
        (SchemeState.PAYLOAD, SchemeState.FAULT),
    ],
)
def test_a_host_that_is_late_holds_the_arm_or_faults(state, expected):
    run = run_in(state)
    assert run.step(LATE) is expected
    assert (run.fault is FaultReason.DEADLINE) == (expected is SchemeState.FAULT)


def test_an_arm_that_is_held_rests_and_waits_for_an_acknowledgement():
    run = run_in(SchemeState.MONITOR)
    run.step(LATE)
    assert run.step(observation=Observation.AT_REST, cycles=REST_CYCLES) is SchemeState.STOPPED
    assert run.step(cycles=100) is SchemeState.STOPPED
    assert run.step(request=Request.ACKNOWLEDGE) is SchemeState.MONITOR


def test_an_acknowledgement_waits_until_the_host_is_on_time():
    run = run_in(SchemeState.STOPPED)
    assert run.step(LATE, request=Request.ACKNOWLEDGE) is SchemeState.STOPPED
    assert run.step(LATE, cycles=300) is SchemeState.STOPPED
    assert run.step() is SchemeState.MONITOR


def test_an_offset_that_has_left_its_anchor_stops_the_arm_for_the_user():
    run = run_in(SchemeState.MONITOR)
    assert run.step(observation=Observation.WITHHELD) is SchemeState.REACT
    assert run.supervisor.cause is SchemeEvent.CONTRADICTED
    assert run.step(observation=Observation.AT_REST, cycles=REST_CYCLES) is SchemeState.STOPPED


def test_a_late_host_that_was_to_change_the_payload_holds_the_arm_first():
    run = run_in(SchemeState.MONITOR)
    assert run.step(LATE, request=Request.PAYLOAD) is SchemeState.REACT


def test_an_acknowledged_stop_goes_on():
    assert run_in(SchemeState.STOPPED).step(request=Request.ACKNOWLEDGE) is SchemeState.MONITOR


def test_an_acknowledgement_waits_until_nothing_pushes():
    run = run_in(SchemeState.STOPPED)
    assert run.step(request=Request.ACKNOWLEDGE, observation=CONTACT) is SchemeState.STOPPED
    assert run.step(observation=CONTACT, cycles=300) is SchemeState.STOPPED
    assert run.step() is SchemeState.MONITOR


@pytest.mark.parametrize("state", [SchemeState.MONITOR, SchemeState.REACT])
def test_an_acknowledgement_before_the_stop_does_not_release_it(state):
    run = run_in(state)
    run.step(request=Request.ACKNOWLEDGE)
    run.to(SchemeState.STOPPED)
    assert run.step(cycles=100) is SchemeState.STOPPED


def test_what_is_known_of_a_stopped_arm_can_be_taken_back_even_while_something_seems_to_push():
    run = run_in(SchemeState.STOPPED)
    assert run.step(request=Request.RELEARN, observation=CONTACT) is SchemeState.STOPPED
    assert run.step(observation=CONTACT | Observation.AT_REST, cycles=REST_CYCLES - 1) is SchemeState.STOPPED
    assert run.step(observation=CONTACT | Observation.AT_REST) is SchemeState.ADAPT
    assert run.supervisor.cause is SchemeEvent.REVOKED


@pytest.mark.parametrize("state", [state for state in SchemeState if state is not SchemeState.STOPPED])
def test_only_a_stopped_arm_is_learnt_anew(state):
    run, plain = run_in(state), run_in(state)
    resting = {"observation": Observation.AT_REST, "cycles": 2 * REST_CYCLES}
    run.step(request=Request.RELEARN)
    plain.step()
    assert run.step(**resting) is plain.step(**resting)
    assert run.supervisor.cause is not SchemeEvent.REVOKED


def doubted():
    run = run_in(SchemeState.MONITOR)
    assert run.supervisor.doubt() is SchemeState.STOPPED
    return run


def test_a_doubted_arm_holds_until_the_user_says_how_to_go_on():
    assert doubted().step(cycles=1000) is SchemeState.STOPPED
    run = doubted()
    assert run.step(request=Request.ACKNOWLEDGE) is SchemeState.ADAPT
    assert run.supervisor.cause is SchemeEvent.REVOKED


def test_a_payload_that_contacts_looked_like_needs_no_announcement():
    run = doubted()
    run.step(request=Request.PAYLOAD_CHANGED)
    assert run.step(observation=Observation.AT_REST, cycles=REST_CYCLES) is SchemeState.ADAPT
    assert run.supervisor.cause is SchemeEvent.PAYLOAD_CHANGED


def test_in_a_stop_that_nothing_doubts_a_changed_payload_means_nothing():
    run = run_in(SchemeState.STOPPED)
    run.step(request=Request.PAYLOAD_CHANGED)
    assert run.step(observation=Observation.AT_REST, cycles=2 * REST_CYCLES) is SchemeState.STOPPED


def test_the_doubt_ends_with_its_stop():
    run = doubted()
    run.step(request=Request.ACKNOWLEDGE)
    run.to(SchemeState.STOPPED)
    run.step(request=Request.PAYLOAD_CHANGED)
    assert run.step(observation=Observation.AT_REST, cycles=2 * REST_CYCLES) is SchemeState.STOPPED


def test_an_acknowledgement_is_good_for_one_stop():
    run = run_in(SchemeState.STOPPED)
    run.step(request=Request.ACKNOWLEDGE)
    run.to(SchemeState.STOPPED)
    assert run.step(cycles=100) is SchemeState.STOPPED


@pytest.mark.parametrize("state", [SchemeState.MONITOR, SchemeState.STOPPED])
def test_a_payload_is_announced_to_an_arm_that_monitors_or_is_stopped(state):
    assert run_in(state).step(request=Request.PAYLOAD) is SchemeState.PAYLOAD


def test_a_payload_announced_during_the_test_of_the_fit_waits_for_its_end():
    run = run_in(SchemeState.CERTIFY)
    run.step(request=Request.PAYLOAD)
    run.step(observation=Observation.REFUTED)
    run.step(observation=Observation.FITTED)
    assert run.step(observation=Observation.CERTIFIED) is SchemeState.MONITOR
    assert run.step() is SchemeState.PAYLOAD


def test_a_payload_announced_during_adaptation_waits_for_its_end():
    run = run_in(SchemeState.ADAPT)
    assert run.step(request=Request.PAYLOAD) is SchemeState.ADAPT
    assert run.step(observation=Observation.ADAPTED) is SchemeState.MONITOR
    assert run.step() is SchemeState.PAYLOAD


def stopped_after_payload_in(state):
    run = run_in(state)
    run.step(request=Request.PAYLOAD, observation=COLLISION)
    assert run.step(observation=Observation.AT_REST, cycles=REST_CYCLES) is SchemeState.STOPPED
    return run


ANNOUNCED_IN = [SchemeState.ADAPT, SchemeState.CERTIFY, SchemeState.MONITOR, SchemeState.REACT]


@pytest.mark.parametrize("state", ANNOUNCED_IN)
def test_a_payload_announced_before_a_stop_does_not_release_it(state):
    assert stopped_after_payload_in(state).step(cycles=300) is SchemeState.STOPPED


@pytest.mark.parametrize("state", [SchemeState.MONITOR, SchemeState.REACT])
def test_a_payload_announced_before_a_stop_is_served_once_that_is_acknowledged(state):
    run = stopped_after_payload_in(state)
    assert run.step(request=Request.ACKNOWLEDGE) is SchemeState.MONITOR
    assert run.step() is SchemeState.PAYLOAD


@pytest.mark.parametrize("state", ANNOUNCED_IN)
def test_a_payload_announced_before_a_stop_is_served_once_it_is_announced_again(state):
    assert stopped_after_payload_in(state).step(request=Request.PAYLOAD) is SchemeState.PAYLOAD


def test_a_payload_announced_in_one_stop_does_not_release_another():
    run = run_in(SchemeState.STOPPED)
    run.step(request=Request.PAYLOAD)
    run.step(observation=COLLISION)
    assert run.step(observation=Observation.AT_REST, cycles=REST_CYCLES) is SchemeState.STOPPED
    assert run.step(cycles=300) is SchemeState.STOPPED


def test_a_changed_payload_waits_until_the_arm_rests():
    run = run_in(SchemeState.PAYLOAD)
    run.step(cycles=10)
    assert run.step(request=Request.PAYLOAD_CHANGED) is SchemeState.PAYLOAD
    assert run.step(observation=Observation.AT_REST, cycles=49) is SchemeState.PAYLOAD
    assert run.step(observation=Observation.AT_REST) is SchemeState.ADAPT


@pytest.mark.parametrize("state", [SchemeState.MONITOR, SchemeState.STOPPED])
def test_a_changed_payload_that_was_not_announced_is_ignored(state):
    assert run_in(state).step(request=Request.PAYLOAD_CHANGED, observation=Observation.AT_REST, cycles=200) is state


@pytest.mark.parametrize("state", [SchemeState.ADAPT, SchemeState.MONITOR, SchemeState.STOPPED, SchemeState.PAYLOAD])
def test_the_end_of_the_run_is_left_to_the_control_layer(state):
    assert run_in(state).step(request=Request.FINISH, cycles=10) is state
