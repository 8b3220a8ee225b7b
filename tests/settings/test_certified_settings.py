"""What the certified scheme's settings refuse, what follows from them, and the block that carries its numbers."""

import pytest

from adacd_hil.records import PARAMETER_NAMES, PARAMETER_UNITS, SchemeState, certified_layout, scheme_layout
from adacd_hil.scheme.kernel import certified_memory
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings, merge, with_todays_keys
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.scheme_settings import FRICTION_TERMS
from adacd_hil.settings.toml_files import parse_toml
from adacd_hil.settings.toml_text import to_toml

SEVEN = [0.1] * 7
AT_REST = {"period_s": 2.0, "cosine": [[0.1], [0.2]], "sine": [[0.0], [0.0]]}


def certified(**sections):
    base = {"scheme": "certified", "estimator": {"P0": [1.0] * 7}}
    return parse(Settings, merge(base, sections))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"cutoffs_rad_s": [10.0]}, r"`certified.cutoffs_rad_s` has 1 values, at least 2 expected"),
        ({"cutoffs_rad_s": [50.0, 10.0]}, r"`certified.cutoffs_rad_s` = \(50.0, 10.0\) must go from slow to fast"),
        ({"cutoffs_rad_s": [10.0, 10.0]}, r"`certified.cutoffs_rad_s` = \(10.0, 10.0\) must go from slow to fast"),
        ({"cutoffs_rad_s": [0.5, 10.0]}, r"`certified.cutoffs_rad_s\[0\]` = 0.5 rad/s is below 1 rad/s"),
        ({"prior_std": SEVEN[:6]}, "`certified.prior_std` has 6 values, 7 expected: inertia kg m²"),
        ({"enough_std": [*SEVEN, 0.1]}, "`certified.enough_std` has 8 values, 7 expected"),
        ({"drift_std": [-1.0, *SEVEN[1:]]}, r"`certified.drift_std\[0\]` = -1.0 is below 0"),
        ({"model_error": [2.0, *SEVEN[1:]]}, r"`certified.model_error\[0\]` = 2.0 is above 1"),
        ({"friction_terms": ["stribek"]}, r"friction_terms\[0\]` = 'stribek' .*did you mean 'stribeck'"),
        ({"friction_terms": ["load", "load"]}, r"friction_terms` = \('load', 'load'\) has a term twice"),
        ({"hold_back_s": -0.01}, "`certified.hold_back_s` = -0.01 s is below 0 s"),
        ({"cutoff_rad_s": [10.0]}, "did you mean `certified.cutoffs_rad_s`"),
        ({"sine": [[0.0], [0.002]], "cosine": [[0.0], [0.0]]}, "excitation of joint 2 does not begin at rest"),
        (AT_REST, "excitation of joint 1 does not begin at rest: .*of n² cosine_n = 0.1, each within 0.001"),
        ({"cosine": [[], [0.0]]}, r"`excitation.cosine` has \[0, 1\] values by joint, `excitation.sine` \[0, 0\]"),
        ({"cosine": [[0.4, -0.1], []], "sine": [[0.0, 0.0], []]}, r"`excitation.cosine` has \[2, 0\] .*sine` \[2, 0\]"),
        ({"period_s": -1.0}, "`excitation.period_s` = -1.0 s is below 0 s"),
    ],
)
def test_settings_that_the_scheme_cannot_work_with_are_refused(values, message):
    section = "excitation" if "excitation" in message else "certified"
    with pytest.raises(ConfigError, match=message):
        certified(**{section: values})


def test_an_excitation_whose_harmonics_cancel_at_the_start_is_taken():
    harmonics = {"cosine": [[0.4, -0.1], [0.0, 0.0]], "sine": [[0.2, -0.1], [0.2, -0.1]]}
    assert certified(excitation=harmonics).excitation.cosine[0] == (0.4, -0.1)


def test_the_scheme_estimates_offsets_lags_and_the_chosen_friction_terms():
    settings = certified(certified={"friction_terms": ["load", "width"]})
    kinds = ("offset1", "offset2", "lag1", "lag2", "load1", "load2", "width1", "width2", "cross_talk1", "cross_talk2")
    assert settings.further_names == kinds
    assert settings.further_count == 10
    assert certified_memory.parameter_names(settings) == PARAMETER_NAMES + kinds


def test_the_paper_s_scheme_has_no_bank_and_nothing_further():
    paper = load_settings("paper", "P")
    assert (paper.scheme, paper.further_count, paper.filter_count, paper.channel_count) == ("paper", 0, 0, 0)


@pytest.mark.parametrize(
    ("cutoffs", "channels"), [([10.0, 50.0], 3), ([10.0, 50.0, 200.0], 5), ([5.0, 9.0, 50.0, 99.0], 7)]
)
def test_each_filter_is_a_channel_and_all_but_the_slowest_are_two(cutoffs, channels):
    settings = certified(certified={"cutoffs_rad_s": cutoffs})
    assert (settings.filter_count, settings.channel_count) == (len(cutoffs), channels)


@pytest.mark.parametrize("profile", ["P", "S", "M"])
def test_the_certified_configuration_differs_from_the_paper_s_in_scheme_excitation_and_rebound_only(profile):
    ours, paper = load_settings("certified", profile), load_settings("paper", profile)
    changed = [name for name in ours.__dataclass_fields__ if getattr(ours, name) != getattr(paper, name)]
    assert changed == ["name", "scheme", "reaction", "excitation"]
    assert ours.scheme == "certified"


def test_a_log_from_before_cross_talk_was_identified_has_none_in_its_model():
    table = parse_toml(to_toml(load_settings("certified", "P")))
    assert parse(Settings, with_todays_keys(table)) == load_settings("certified", "P")
    del table["certified"]["cross_talk_std"]
    old = parse(Settings, with_todays_keys(table))
    assert old.certified.cross_talk_std == 0.0
    assert old.further_names[-1] == "dahl_long2"


def test_every_parameter_of_the_scheme_has_a_unit():
    given = {"certified": {"friction_terms": list(FRICTION_TERMS)}, "arm": {"position_torque_Nm": 0.1}}
    names = certified_memory.parameter_names(certified(**given))
    assert {name: PARAMETER_UNITS[name] for name in names if name in PARAMETER_UNITS}.keys() == set(names)


def test_the_certified_block_begins_as_the_paper_s():
    """So whoever reads the paper's fields reads them from either."""
    paper, certified_one = scheme_layout(7), certified_layout(7, 6, 5)
    assert certified_one.fields[: len(paper.fields)] == paper.fields


def test_the_number_of_the_certifying_state_is_appended():
    """Older logs keep their meaning."""
    assert SchemeState.CERTIFY == max(SchemeState) == 9


def test_gravity_brings_gains_of_its_own():
    estimator = parse(Settings, {"estimator": {"gravity": True}}).estimator
    assert estimator.P0 == (8.0, 4.0, 4.0, 0.5, 0.5, 0.5, 0.5, 50.0, 50.0)
    assert len(estimator.P0) == len(estimator.parameter_names)
    given = (1.0,) * 9
    assert given == parse(Settings, {"estimator": {"gravity": True, "P0": list(given)}}).estimator.P0


SEVEN_NAMES = "a1, a2, a3, F_v1, F_v2, F_c1, F_c2"


@pytest.mark.parametrize(
    ("table", "line"),
    [
        ({"estimator": {"P0": [1.0] * 8}}, f"`estimator.P0` has 8 values, 7 expected: {SEVEN_NAMES}"),
        (
            {"estimator": {"gravity": True}, "arm": {"cad_theta": [0.1] * 7}},
            f"`arm.cad_theta` has 7 values, 9 expected: {SEVEN_NAMES}, a4, a5 (`estimator.gravity` adds a4 and a5, Nm)",
        ),
    ],
)
def test_a_list_of_parameters_of_another_length_is_told_their_names(table, line):
    with pytest.raises(ConfigError) as caught:
        parse(Settings, table)
    assert line in str(caught.value)
