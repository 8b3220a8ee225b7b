"""The layout that Foxglove and Lichtblick load: what one wants to see of a run at once."""

import json
from typing import Any

LAYOUT_NAME = "viewer-layout.json"


def _plot(title: str, *paths: str) -> dict[str, Any]:
    return {
        "title": title,
        "paths": [{"value": path, "enabled": True, "timestampMethod": "receiveTime"} for path in paths],
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "isSynced": True,
        "xAxisVal": "timestamp",
    }


def _both_joints(field: str) -> tuple[str, str]:
    return f"{field}[0]", f"{field}[1]"


def viewer_layout() -> bytes:
    """Write the layout: torques against thresholds, motion, states, parameters, timing, queues, events."""
    panels = {
        "Plot!contact": _plot(
            "External torque, Nm", *_both_joints("/scheme.tau_ext_hat"), *_both_joints("/scheme.threshold")
        ),
        "Plot!torque": _plot("Joint torque, Nm", *_both_joints("/scheme.tau_j"), *_both_joints("/control.tau_c")),
        "Plot!motion": _plot("Position, rad", *_both_joints("/scheme.q"), *_both_joints("/control.q_d")),
        "Plot!theta": _plot("Parameters", "/scheme.theta_hat[:]"),
        "Plot!cycle": _plot(
            "Cycle, ns", *(f"/cycle.{name}_ns" for name in ("lateness", "feedback", "command", "slack"))
        ),
        "Plot!queues": _plot(
            "Queues, bytes", *(f"/cycle.{name}_queue_bytes" for name in ("receive", "transmit", "log"))
        ),
        "StateTransitions!state": {
            "paths": [{"value": f"/scheme.{field}", "timestampMethod": "receiveTime"} for field in ("state", "fault")],
            "isSynced": True,
        },
        "RosOut!events": {"searchTerms": [], "minLogLevel": 1, "topicToRender": "/events"},
    }
    left = _stack("Plot!contact", _stack("Plot!torque", "Plot!motion"))
    right = _stack(
        "StateTransitions!state", _stack("Plot!theta", _stack("Plot!cycle", _stack("Plot!queues", "RosOut!events")))
    )
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "row", "first": left, "second": right, "splitPercentage": 60},
    }
    return json.dumps(layout, indent=1).encode()


def _stack(first: Any, second: Any) -> dict[str, Any]:
    return {"direction": "column", "first": first, "second": second}
