"""Recorded cycles through a pipeline, many at once, with the bits that `step` gives.

The supervisor changes its state rarely, and its numbers don't depend on it in between. So the compiled loop runs until
something could happen (`calm`), and the cycle at which it stops is concluded as `step` concludes it: by the same code.
"""

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.records import (
    ArmBatch,
    ArmState,
    ContactReport,
    FaultReason,
    Reaction,
    Request,
    SchemeOutput,
    Vector,
)
from adacd_hil.scheme.kernel.loop import Recorded, Samples, samples_of
from adacd_hil.scheme.pipeline.intervals import Intervals
from adacd_hil.scheme.supervisor.supervisor import Supervisor
from adacd_hil.scheme.supervisor.transitions import CONTACT_SHIFT, Calm


class SchemeBatch(NamedTuple):
    """SchemeOutputs of n cycles, as columns.

    cycle (n,) int64; state, previous_state, fault, reaction (n,) uint8; contact_joints (n,) int64; is_model_valid (n,)
    bool; block (n, size). contacts: k reports, contact_places (k,) int64 the rows of their cycles.
    """

    cycle: NDArray[np.int64]
    state: NDArray[np.uint8]
    previous_state: NDArray[np.uint8]
    fault: NDArray[np.uint8]
    reaction: NDArray[np.uint8]
    contact_joints: NDArray[np.int64]
    is_model_valid: NDArray[np.bool_]
    block: Vector
    contacts: list[ContactReport]
    contact_places: NDArray[np.int64]


def arm_at(arms: ArmBatch, row: int) -> ArmState:
    """Return one row as an ArmState; its vectors are views."""
    age_q, age_tau_J = arms.age_q[row].tolist(), arms.age_tau_J[row].tolist()
    return ArmState(
        cycle=int(arms.cycle[row]),
        t_ns=int(arms.t_ns[row]),
        periods=int(arms.periods[row]),
        q=arms.q[row],
        dq=arms.dq[row],
        tau_J=arms.tau_J[row],
        age_q=(age_q[0], age_q[1]),
        age_tau_J=(age_tau_J[0], age_tau_J[1]),
        is_enabled=bool(arms.is_enabled[row]),
        is_complete=bool(arms.is_complete[row]),
        fault=FaultReason(arms.fault[row]),
        is_late=bool(arms.is_late[row]),
        steps=int(arms.steps[row]),
        sampled_ns=int(arms.sampled_ns[row]),
    )


class RunsBatches(ABC):
    """A pipeline whose `step` begins with compiled numbers and ends with what Python concludes of them."""

    _supervisor: Supervisor
    _intervals: Intervals
    _values: Vector

    @abstractmethod
    def _calm(self, cycle: int) -> Calm:
        """Return bounds within which the next cycles, from this one on, need not be concluded."""

    @abstractmethod
    def _advance(self, samples: Samples, recorded: Recorded, first: int, last: int, calm: Calm) -> int:
        """Run the numbers to the first cycle that isn't calm, at most to `last`; return its row."""

    @abstractmethod
    def _pass_by(self, cycles: int) -> None:
        """Count calm cycles; the supervisor has done so."""

    @abstractmethod
    def _conclude(self, arm: ArmState, request: Request, observation: int) -> SchemeOutput:
        """Do what comes after the numbers in each cycle."""

    @abstractmethod
    def _standing(self) -> tuple[Reaction, bool]:
        """Return the reaction in force, and whether theta_ff may be fed forward."""

    def run(self, arms: ArmBatch, requests: NDArray[np.uint8]) -> SchemeBatch:
        """Take in n cycles, as `step` does one by one. requests (n,): of `Request`."""
        count = arms.cycle.size
        supervisor = self._supervisor
        samples = samples_of(arms, self._intervals.between(arms), supervisor.findings(arms))
        recorded = Recorded(np.zeros(count, dtype=np.int64), np.empty((count, self._values.size)))
        state, previous_state, fault, reaction = (np.zeros(count, dtype=np.uint8) for _ in range(4))
        is_model_valid = np.zeros(count, dtype=np.bool_)
        contacts: dict[int, ContactReport] = {}
        looks = [*np.flatnonzero(requests).tolist(), count - 1]
        first = 0
        while first < count:
            while looks[0] < first:
                del looks[0]
            calm = self._calm(int(samples.cycle[first]))
            last = max(min(looks[0], first + calm.cycles), first)
            row = self._advance(samples, recorded, first, last, calm)
            if row > first:
                past = slice(first, row)
                supervisor.pass_by(recorded.observations[past], samples.periods[past])
                self._pass_by(row - first)
                state[past] = previous_state[past] = supervisor.state
                fault[past] = supervisor.fault
                reaction[past], is_model_valid[past] = self._standing()
            output = self._conclude(arm_at(arms, row), Request(requests[row]), int(recorded.observations[row]))
            state[row], previous_state[row], fault[row] = output.state, output.previous_state, output.fault
            reaction[row], is_model_valid[row] = output.reaction, output.is_model_valid
            if output.contact is not None:
                contacts[row] = output.contact
            first = row + 1
        return SchemeBatch(
            cycle=samples.cycle,
            state=state,
            previous_state=previous_state,
            fault=fault,
            reaction=reaction,
            contact_joints=recorded.observations >> CONTACT_SHIFT,
            is_model_valid=is_model_valid,
            block=recorded.blocks,
            contacts=list(contacts.values()),
            contact_places=np.array(list(contacts), dtype=np.int64),
        )
