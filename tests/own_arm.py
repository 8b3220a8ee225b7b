"""An arm of one's own for rehearsals: what its user tells `init`, and touches that fit it."""

from pathlib import Path


def describe_arm(folder: Path) -> list[str]:
    """Give the words after `init` that write the arm's file, `my-arm.toml` in `folder`."""
    values: dict[str, tuple[float, float]] = {
        "--length-m": (0.4, 0.25),
        "--mass-kg": (2, 1),
        "--rated-torque-nm": (20, 8),
        "--torque-limit-nm": (18, 7),
        "--position-limit-deg": (80, 110),
        "--velocity-limit-deg-s": (220, 280),
        "--drive-node": (11, 12),
        "--sensor-node": (21, 22),
    }
    words = [str(folder / "my-arm.toml"), "--no-bus", "--flat", "--yes"]
    for option, pair in values.items():
        words += [option, *map(str, pair)]
    return words


_ROW = "[[contacts]]\nat_s = {:.1f}\nlink = {}\npoint_m = {}\nangle_deg = {}\nforce_N = 20.0\nduration_s = 0.1\n"
_TOUCHES = ((1, 0.3, 90.0), (1, 0.3, -90.0), (2, 0.2, 90.0), (2, 0.2, -90.0)) * 2
EIGHT_TOUCHES = "lasts_s = 12.8\nstart_deg = [-30.0, -60.0]\n" + "".join(
    _ROW.format(2.4 + 1.3 * number, *touch) for number, touch in enumerate(_TOUCHES)
)
"""A scenario: once the model is certified, a touch every 1.3 s, each as short as a knock."""
