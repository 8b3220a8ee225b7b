"""Settings are changed by dotted keys and TOML values, and facts of the log are kept."""

from dataclasses import replace

import pytest

from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.setting_keys import (
    apply_settings,
    changed_keys,
    keep_log_settings,
    parse_changes,
    parse_variations,
    split_list,
    value_of,
)

PAPER = load_settings("paper")


def test_a_list_a_number_a_quoted_and_a_bare_word_are_taken():
    changed = apply_settings(
        PAPER,
        {
            "detector.threshold_Nm": "[0.1, 0.2]",
            "filter.a_rad_s": "50",
            "estimator.law": '"gradient"',
            "scheme": "certified",
            "certified.cutoffs_rad_s": "[5, 20, 80]",
            "operator.script": '[{at_s = 1.5, request = "finish"}]',
            "devices.quick_stop_option": "6",  # which was unset
        },
    )
    assert (changed.detector.threshold_Nm, changed.filter.a_rad_s) == ((0.1, 0.2), 50.0)
    assert (changed.estimator.law, changed.scheme) == ("gradient", "certified")
    assert changed.certified.cutoffs_rad_s == (5.0, 20.0, 80.0)
    assert [(entry.at_s, entry.request) for entry in changed.operator.script] == [(1.5, "finish")]
    assert changed.devices.quick_stop_option == 6
    assert changed.trajectory == PAPER.trajectory


@pytest.mark.parametrize(
    ("key", "value", "taken"),
    [
        ("detector.threshold_Nm", "0.3", (0.3, 0.3)),
        ("certified.prior_std", "0.3", (0.3,) * 7),
        ("certified.friction_terms", "stribeck", ("stribeck",)),
        ("safety.tolerated_emergencies", "0x8210", (0x8210,)),
        ("assumed", "arm.sign", ("arm.sign",)),
    ],
)
def test_a_single_value_fills_a_list_whose_length_is_fixed_and_is_any_other_list_alone(key, value, taken):
    assert value_of(apply_settings(PAPER, {key: value}), key) == taken


def test_a_single_number_is_not_lost_in_an_empty_list():
    with pytest.raises(ConfigError, match=r"`arm\.cad_theta` has 1 values, 7 expected"):
        apply_settings(apply_settings(PAPER, {"arm.cad_theta": "[]"}), {"arm.cad_theta": "0.1"})


@pytest.mark.parametrize(
    ("key", "value", "line"),
    [
        ("detector.treshold_Nm", "0.1", "unknown key `detector.treshold_Nm`; did you mean `detector.threshold_Nm`?"),
        ("threshold_Nm", "0.1", "did you mean `detector.threshold_Nm`?"),
        ("filter.a_rad_s", "-1", "`filter.a_rad_s` = -1.0 rad/s is below 0.1 rad/s"),
        ("filter.a_rad_s", "fast", "`filter.a_rad_s` = 'fast' must be of type float"),
        ("filter.a_rad_s", "[1", "`filter.a_rad_s` = [1 is not a TOML value"),
        ("arm.sign", "5000000000000000000000", "`arm.sign` is an integer of more than 64 bits"),
        ("detector.threshold_Nm", "[0.1]", "`detector.threshold_Nm` has 1 values, 2 expected"),
    ],
)
def test_a_change_that_cant_be_made_is_named(key, value, line):
    with pytest.raises(ConfigError) as error:
        apply_settings(PAPER, {key: value})
    assert line in str(error.value)


def test_several_lists_of_values_give_every_combination():
    given = ["filter.a_rad_s=10,20", "detector.threshold_Nm=[0.1, 0.2],0.3"]
    assert parse_variations(given) == [
        {"filter.a_rad_s": a, "detector.threshold_Nm": h} for a in ("10", "20") for h in ("[0.1, 0.2]", "0.3")
    ]


def test_a_key_that_is_varied_twice_drops_no_value():
    with pytest.raises(ConfigError, match="10,20 and 30"):
        parse_variations(["filter.a_rad_s=10,20", "filter.a_rad_s=30"])
    with pytest.raises(ConfigError, match="8 and 9"):
        parse_changes(["filter.a_rad_s=8", " filter.a_rad_s = 9"])


def test_commas_in_brackets_and_quotes_part_nothing():
    assert split_list("""[1, 2], {a = 1, b = 2}, "x, y", 'z,', 5""") == [
        "[1, 2]", "{a = 1, b = 2}", '"x, y"', "'z,'", "5",
    ]  # fmt: skip


@pytest.mark.parametrize("given", ["filter.a_rad_s", "=5"])
def test_a_change_without_key_or_value_is_refused(given):
    with pytest.raises(ConfigError, match="must be key=value"):
        parse_changes([given])


def test_another_configuration_keeps_what_made_the_numbers_of_the_log():
    tared = replace(PAPER.arm, torque_offset_Nm=(0.3, -0.2), torque_offset_std_Nm=(0.01, 0.01), sign=(-1, 1))
    own = apply_settings(replace(PAPER, arm=tared), {"bus.heartbeat_ms": "200", "realtime.sample_period": "nominal"})
    kept = keep_log_settings(own, load_settings("certified"))
    assert (kept.scheme, kept.bus, kept.realtime.sample_period) == ("certified", own.bus, "nominal")
    for name in ("torque_offset_Nm", "torque_offset_std_Nm", "sign"):
        assert getattr(kept.arm, name) == getattr(tared, name)


@pytest.mark.parametrize(
    ("key", "own", "other"),
    [("holding_torque_Nm", (0.0, 0.0), (8.0, 4.0)), ("position_torque_Nm", 0.1, 0.2)],
)
def test_what_is_known_of_an_arm_is_another_configurations_to_say_only_where_the_log_does_not(key, own, other):
    def saying(settings: Settings, value: object) -> Settings:
        return replace(settings, arm=replace(settings.arm, **{key: value}))

    theirs = saying(load_settings("certified"), other)
    assert getattr(keep_log_settings(saying(PAPER, own), theirs).arm, key) == own
    assert getattr(keep_log_settings(PAPER, theirs).arm, key) == other


def test_changed_settings_are_listed_by_key_with_both_values():
    other = apply_settings(PAPER, {"filter.a_rad_s": "50", "devices.quick_stop_option": "6"})
    assert changed_keys(PAPER, other) == {
        "filter.a_rad_s": ("10.0", "50.0"),
        "devices.quick_stop_option": ("unset", "6"),
    }
