"""The files for viewers of a log, Foxglove and Lichtblick: the arm, and the layout of the panels."""

import base64
import json
from typing import Any

from adacd_hil.log.log_files import LAYOUT_NAME, ROBOT_NAME
from adacd_hil.log.robot_description import WORLD, robot_description
from adacd_hil.log.types.topics import CONTACT, CONTROL, CYCLE, EVENTS, JOINT_STATES, SCHEME, OwnTopic
from adacd_hil.settings.configuration import Settings

SCENE_TOPIC = "/scene"
"""Topic of the 3-D arm, which only the live view has."""


def _titled(title: str, panel: dict[str, Any]) -> dict[str, Any]:
    """Return a panel with its title under the key of each of the two viewers."""
    return {"lichtblickPanelTitle": title, "foxglovePanelTitle": title, **panel}


def _plot(title: str, *paths: str) -> dict[str, Any]:
    panel = {
        "paths": [{"value": path, "enabled": True, "timestampMethod": "receiveTime"} for path in paths],
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "sidebarDimension": 240,
        "isSynced": True,
        "xAxisVal": "timestamp",
    }
    return _titled(title, panel)


def _both_joints(topic: OwnTopic, field: str) -> tuple[str, str]:
    return f"{topic.name}.{field}[0]", f"{topic.name}.{field}[1]"


def _scene(robot: bytes) -> dict[str, Any]:
    """Return the 3-D panel with the arm and a grid. robot: the arm's URDF.

    The URDF is part of the layout: a log can't serve files, and a server isn't needed.
    """
    arm = {
        "instanceId": "arm",
        "layerId": "foxglove.Urdf",
        "label": "Arm",
        "visible": True,
        "sourceType": "url",
        "url": "data:text/xml;base64," + base64.b64encode(robot).decode(),
        "controlMode": "jointStates",
        "jointStatesTopic": JOINT_STATES.name,
        "displayMode": "visual",
        "framePrefix": "",
    }
    grid = {"instanceId": "grid", "layerId": "foxglove.Grid", "label": "Grid", "visible": True, "size": 2}
    panel = {
        "cameraState": {"distance": 1.8, "phi": 25, "thetaOffset": 0, "targetOffset": [0.3, 0, 0], "perspective": True},
        "followTf": WORLD,
        "layers": {"arm": arm, "grid": {**grid, "divisions": 20}},
        "topics": {SCENE_TOPIC: {"visible": True}, JOINT_STATES.name: {"visible": True}},
    }
    return _titled("Arm", panel)


def viewer_files(settings: Settings) -> dict[str, bytes]:
    """Return the files of a run's arm by name: its URDF, and a layout with the arm in it."""
    robot = robot_description(settings).encode()
    return {ROBOT_NAME: robot, LAYOUT_NAME: viewer_layout(robot)}


def viewer_layout(robot: bytes = b"") -> bytes:
    """Return the viewers' layout as JSON: plots of torques, motion, parameters, timing, queues; state, contact, events.

    robot: the arm's URDF; if empty, there is no 3-D panel.
    """
    panels = {
        "Plot!contact": _plot(
            "External torque, Nm", *_both_joints(SCHEME, "tau_ext_hat"), *_both_joints(SCHEME, "threshold")
        ),
        "Plot!torque": _plot("Joint torque, Nm", *_both_joints(SCHEME, "tau_j"), *_both_joints(CONTROL, "tau_c")),
        "Plot!motion": _plot("Position, rad", *_both_joints(SCHEME, "q"), *_both_joints(CONTROL, "q_d")),
        "Plot!theta": _plot("Parameters", f"{SCHEME.name}.theta_hat[:]"),
        "Plot!cycle": _plot(
            "Cycle, ns", *(f"{CYCLE.name}.{name}_ns" for name in ("lateness", "feedback", "command", "slack"))
        ),
        "Plot!queues": _plot(
            "Queues, bytes", *(f"{CYCLE.name}.{name}_queue_bytes" for name in ("receive", "transmit", "log"))
        ),
        "StateTransitions!state": _titled(
            "State and fault",
            {
                "paths": [
                    {"value": f"{SCHEME.name}.{name}", "label": name, "enabled": True, "timestampMethod": "receiveTime"}
                    for name in ("state", "fault")
                ],
                "isSynced": True,
            },
        ),
        "RawMessages!contact": _titled("Last contact", {"topicPath": CONTACT.name, "diffEnabled": False}),
        "RosOut!events": _titled("Events", {"searchTerms": [], "minLogLevel": 1, "topicToRender": EVENTS.name}),
    }
    left: list[str] = ["Plot!contact", "Plot!torque", "Plot!motion", "Plot!theta"]
    right = ["StateTransitions!state", "RosOut!events", "RawMessages!contact", "Plot!cycle", "Plot!queues"]
    if robot:
        panels["3D!arm"] = _scene(robot)
        left.insert(0, "3D!arm")
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "row", "first": _stack(*left), "second": _stack(*right), "splitPercentage": 60},
    }
    return json.dumps(layout, indent=1).encode()


def _stack(first: str, *others: str) -> Any:
    """Return the layout of panels, by their names, one below the other with equal heights; of one panel its name."""
    if not others:
        return first
    share = 100.0 / (1 + len(others))
    return {"direction": "column", "first": first, "second": _stack(*others), "splitPercentage": share}
