"""How an arm is mounted, as its settings say it."""

import math
import re

import pytest

from adacd_hil.lab.commission.arm_draft import draw_arm
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError

WITH_GRAVITY = {"estimator": {"gravity": True}}


def test_an_arm_in_gravity_is_level_at_zero_unless_its_mounting_says_otherwise():
    assert parse(Settings, WITH_GRAVITY).mounting_deg == (90.0, -90.0)
    assert parse(Settings, WITH_GRAVITY).level_rad == 0.0
    assert parse(Settings, {}).mounting_deg == (0.0, 0.0)


def test_link_1_is_level_a_quarter_turn_beyond_where_it_hangs():
    assert parse(Settings, WITH_GRAVITY | {"arm": {"mounting_deg": [30.0, 10.0]}}).level_rad == math.radians(100.0)


@pytest.mark.parametrize(
    ("table", "line"),
    [
        ({"arm": {"mounting_deg": [90.0, 0.0]}}, "`arm.mounting_deg[0]` = 90 deg: gravity acts on the joints"),
        (WITH_GRAVITY | {"arm": {"mounting_deg": [0.0, 0.0]}}, "= 0 deg: gravity does not act"),
        (WITH_GRAVITY | {"arm": {"mounting_deg": [91.0, 0.0]}}, "= 91 deg must be within 0 to 90 deg"),
        ({"arm": {"mounting": [90.0, 0.0]}}, "did you mean `arm.mounting_deg`"),
    ],
)
def test_a_mounting_that_contradicts_itself_is_refused(table, line):
    with pytest.raises(ConfigError, match=re.escape(line)):
        parse(Settings, table)


def test_a_slight_tilt_may_be_left_out_of_the_model():
    assert parse(Settings, {"arm": {"mounting_deg": [1.0, 0.0]}}).level_rad == 0.0


@pytest.mark.parametrize(
    ("mounting_deg", "drawn"),
    [
        ((90.0, 0.0), "gravity →: the arm points down"),
        ((90.0, 180.0), "gravity ←: the arm points up"),
        ((90.0, -90.0), "gravity ↓: the arm is level and +q1 lifts it"),
        ((10.0, 90.0), "gravity ↑ (plane tilted by 10 deg): the arm is level and +q1 lowers it"),
        ((90.0, 30.0), "gravity ↗: link 1 hangs at q1 = 30 deg"),
        ((0.0, 0.0), "seen from above; gravity does not act"),
    ],
)
def test_an_arm_is_drawn_with_the_direction_of_gravity(mounting_deg, drawn):
    assert drawn in draw_arm(mounting_deg)
