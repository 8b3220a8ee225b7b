"""The topic of the emulator's own log, and the quantities in it: what the emulator knows and the host must not use."""

from adacd_hil.log.types.topics import CYCLE_NUMBER, EVENTS, ChannelId, LogChannel, OwnTopic
from adacd_hil.records import JOINTS, PARAMETER_NAMES, Field, Layout

TRUTH_LAYOUT = Layout(
    (
        Field("q", JOINTS, "rad", "true joint position"),
        Field("dq", JOINTS, "rad/s", "true joint velocity"),
        Field("tau_J", JOINTS, "Nm", "true joint torque"),
        Field("tau_ext", JOINTS, "Nm", "true external torque"),
        Field("tau_friction", JOINTS, "Nm", "true friction torque, positive along +dq"),
        Field("contact_force", 1, "N", "size of the contact force"),
        Field("contact_link", 1, "", "link that is touched, 0 for none"),
        Field("contact_index", 1, "", "index of the scenario's contact in force, -1 for none"),
        Field("payload", 1, "kg", "payload at the tip"),
        Field("theta", len(PARAMETER_NAMES), "see PARAMETER_UNITS", "true parameters, payload included"),
        Field("q_m", JOINTS, "rad", "true motor position behind the gear; q where the joint is stiff"),
        Field("tau_m", JOINTS, "Nm", "true motor torque behind the gear; tau_J where the joint is stiff"),
        Field("tau_gravity", JOINTS, "Nm", "true gravity torque, positive where it must be held along +q"),
        Field("joint_temperature", JOINTS, "°C", "true temperature of the joint's lubricant"),
        Field("contact_power", 1, "W", "power that the arm gives to all that touches it"),
        Field("contact_energy", 1, "J", "its integral since the contact began; 0 without contact"),
        Field("faults", 1, "", "bit i: row i of the scenario's faults is active"),
    )
)
"""Quantities that the emulator knows and that the host must not use."""


TRUTH = OwnTopic(ChannelId.TRUTH, "/truth", "Truth", head=(CYCLE_NUMBER,), block=lambda *_: TRUTH_LAYOUT)


def truth_channels() -> tuple[LogChannel, ...]:
    """Return the topics of the emulator's own log as channels of a file."""
    return TRUTH.channel(), EVENTS.channel()
