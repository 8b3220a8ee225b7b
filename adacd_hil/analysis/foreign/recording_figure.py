"""The picture of a foreign recording: external torque of each joint against its threshold, and the contacts."""

import numpy as np
from matplotlib.figure import Figure

from adacd_hil.analysis.drawing import COLOURS, Drawing, note, plot, style
from adacd_hil.analysis.foreign.recording_identification import Identified, Watched


def draw_watched(identified: Identified, watched: Watched, name: str) -> Drawing:
    """Draw one recording, a panel per joint."""
    n = identified.model.joints
    with style():
        figure = Figure(figsize=(7.2, 0.9 + 1.3 * n), layout="constrained")
        panels = np.atleast_1d(figure.subplots(n, 1, sharex=True))
        for joint, axes in enumerate(panels):
            for stretch, tau_ext_hat, threshold in zip(
                watched.recording.stretches, watched.tau_ext_hat, watched.threshold, strict=True
            ):
                time_s = stretch.start_s + watched.recording.period_s * np.arange(len(tau_ext_hat), dtype=np.float64)
                plot(axes, time_s, tau_ext_hat[:, joint], color=COLOURS["joint1"], linewidth=0.8)
                for sign in (-1.0, 1.0):
                    plot(axes, time_s, sign * threshold[:, joint], color=COLOURS["muted"], linewidth=0.6)
                if stretch.is_touched is not None:
                    axes.fill_between(
                        time_s, 0.0, 1.0, where=stretch.is_touched, transform=axes.get_xaxis_transform(), alpha=0.15
                    )
            for contact in watched.contacts:
                axes.axvline(contact.start_s, color=COLOURS["joint2"], linewidth=0.6)
            axes.set_ylabel("Nm")
            note(axes, identified.joint_names[joint])
        panels[-1].set_xlabel("time, s")
    caption = (
        f"Estimated external torque between its thresholds; lines: {len(watched.contacts)} contacts found; "
        "shaded: touches, where they are known."
    )
    return Drawing(name, watched.recording.path.name, caption, figure)
