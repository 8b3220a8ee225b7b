"""A contact's course by itself: the compiled step, with a state and findings written by hand."""

from adacd_hil.records import JOINTS, ContactLevel, Reaction, SchemeState
from adacd_hil.scheme.contact import course
from adacd_hil.scheme.supervisor import supervisor
from adacd_hil.scheme.supervisor.findings import ANY_CONTACT, CONTACT, CONTACT_SHIFT
from adacd_hil.structured import zeros_of


class Course:
    """The course of contacts under these settings."""

    def __init__(self, settings):
        sizes = {"n": JOINTS, "levels": len(ContactLevel)}
        self.k, self.memory = zeros_of(course.CourseConstants, sizes), zeros_of(course.CourseMemory, sizes)
        self.m, self.state = self.memory[0], zeros_of(supervisor.SupervisorMemory, {})
        course.begin(self.m)
        course.fill_constants(settings, self.k[0])
        self.cycle = 0

    def step(
        self, joints, tau, level=ContactLevel.COLLISION, state=SchemeState.REACT, is_latched=False, is_valid=True,
        tau_ext=None,
    ):  # fmt: skip
        """Take in a cycle; return whether a report is due. joints: bits of those over their threshold."""
        self.state["state"], self.state["is_latched"] = state, is_latched
        found = ANY_CONTACT if level is ContactLevel.COLLISION else CONTACT
        observation = joints << CONTACT_SHIFT | found if joints else 0
        wide = tau if tau_ext is None else tau_ext
        is_due = course.follow(self.k[0], self.m, self.state[0], self.cycle, observation, is_valid, tau, wide)
        self.cycle += 1
        return is_due

    @property
    def reaction(self):
        return Reaction(self.m.reaction)

    @property
    def goes_on(self):
        return course.goes_on(self.m)
