"""The figures: what they show, and fragments that a strict page can take in."""

import re
from html.parser import HTMLParser
from importlib import resources

import matplotlib as mpl
import numpy as np
import pytest
from hand_made_run import make_certified_run, make_run, react, touch, touched_run

from adacd_hil.lab.drawing import COLOURS
from adacd_hil.lab.report.run_figures import CLOSE_UPS, draw, parameter_label, residuals
from adacd_hil.lab.report.timing_figures import draw_timing
from adacd_hil.lab.score.evaluation import evaluate
from adacd_hil.records import SchemeState

pytestmark = pytest.mark.slow

NAMES = ["fig5", "fig6", "fig7", "contacts", "timing-distributions", "timing-line"]


def draw_touched_run():
    run = touched_run()
    metrics = evaluate(run)
    drawings = [*draw(run, metrics), *draw_timing(run.timing, metrics.timing, run.zero_ns, "motion start")]
    return {drawing.name: drawing for drawing in drawings}


@pytest.fixture(scope="module")
def drawings():
    return draw_touched_run()


def test_a_run_has_the_papers_figures_the_contacts_and_the_times(drawings):
    assert list(drawings) == NAMES


def names_of(run):
    return [drawing.name for drawing in draw(run, evaluate(run))]


def test_a_run_without_contacts_has_no_close_ups():
    assert "contacts" not in names_of(make_run())


def test_a_real_arm_has_figures_without_truth():
    assert names_of(react(make_run(has_truth=False), 3000)) == ["fig5", "fig6", "fig7", "contacts"]


def test_a_run_that_never_moved_has_figure_5_only():
    assert names_of(make_run((SchemeState.COMMISSION, 20))) == ["fig5"]


def texts(drawing):
    return [text.get_text() for axes in drawing.figure.axes for text in axes.texts]


def test_figure_5_letters_the_sections(drawings):
    letters = [text.split()[0] for text in texts(drawings["fig5"]) if text[0].isalpha()]
    assert letters == ["A", "B", "C", "D", "E"]


def test_figure_5_numbers_the_contacts_on_both_joints(drawings):
    numbers = [text for text in texts(drawings["fig5"]) if text.isdigit()]
    assert numbers == ["1", "2", "3"] * 2


def test_figure_5_draws_the_thresholds(drawings):
    axes = drawings["fig5"].figure.axes[0]
    levels = {line.get_ydata()[0] for line in axes.lines if line.get_label() == "threshold"}
    assert levels == {-0.15, 0.15}


def test_figure_5_has_a_lane_with_its_thresholds_for_each_scheme_on_the_stream():
    run = make_certified_run()
    axes = residuals(run, evaluate(run)).figure.axes
    levels = [
        [float(np.nanmax(line.get_ydata())) for line in lane.lines if line.get_linewidth() == 0.7] for lane in axes
    ]
    lanes = [[level for level in of_lane if 0.0 < level < 1.0] for of_lane in levels]
    assert sorted(level for of_lane in lanes for level in of_lane if of_lane) == [0.1, 0.1, 0.15, 0.15]
    assert len(axes) == 6


def test_figure_5_keeps_the_largest_residual():
    run = touched_run()
    run.tau_ext_hat[3333, 0] = 7.5
    axes = draw(run, evaluate(run))[0].figure.axes[0]
    line = next(line for line in axes.lines if line.get_label() == "with the identified parameters")
    assert line.get_ydata().max() == 7.5


def test_figure_6_draws_the_true_value_dashed(drawings):
    axes = drawings["fig6"].figure.axes[0]
    dashed = [line.get_ydata()[0] for line in axes.lines if line.is_dashed()]
    assert dashed == [0.2]


def test_a_real_arm_has_no_true_value_in_figure_6():
    run = make_run(has_truth=False)
    axes = draw(run, evaluate(run))[1].figure.axes[0]
    assert [line for line in axes.lines if line.is_dashed()] == []


def test_figure_6_has_a_panel_for_each_parameter_and_one_for_the_residual(drawings):
    assert sum(axes.axison for axes in drawings["fig6"].figure.axes) == 8


def test_close_ups_say_what_became_of_each_contact(drawings):
    assert texts(drawings["contacts"]) == ["detected after 5 ms", "detected after 4 ms", "missed"]


def test_close_ups_stop_at_a_page():
    run = make_run()
    for index in range(CLOSE_UPS + 3):
        touch(run, 1100 + 20 * index, 10, (5.0, 0.0), index=index)
    drawing = next(drawing for drawing in draw(run, evaluate(run)) if drawing.name == "contacts")
    assert sum(axes.axison for axes in drawing.figure.axes) == CLOSE_UPS


@pytest.mark.parametrize(
    ("name", "label"),
    [("a1", "$a_{1}$"), ("F_v1", r"$F_{\mathrm{v}1}$"), ("F_c2", r"$F_{\mathrm{c}2}$")],
)
def test_parameters_are_written_as_mathematics(name, label, fragments):
    assert parameter_label(name) == label


each_fragment = pytest.mark.parametrize("name", NAMES)


@pytest.fixture(scope="module")
def fragments():
    return {name: drawing.svg().shapes for name, drawing in draw_touched_run().items()}


class Ids(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.ids = []
        self.references = set(re.findall(r'(?:url\(|href=")#([^)"]+)', text))
        self.tags = set()
        self.attributes = set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes.update(name for name, _ in attrs)
        self.ids += [value for name, value in attrs if name == "id"]


@each_fragment
def test_a_fragment_refers_to_nothing_outside(name, fragments):
    assert re.search(r"https?:|//|data:|@import", fragments[name]) is None


@each_fragment
def test_a_fragment_carries_no_style_and_no_script(name, fragments):
    assert Ids(fragments[name]).tags & {"style", "script", "metadata", "image", "foreignobject"} == set()


@each_fragment
def test_a_fragment_has_no_inline_style(name, fragments):
    assert "style" not in Ids(fragments[name]).attributes


@each_fragment
def test_a_fragments_ids_are_there_once(name, fragments):
    ids = Ids(fragments[name]).ids
    assert len(ids) == len(set(ids))


@each_fragment
def test_a_fragments_references_are_resolved_within_it(name, fragments):
    found = Ids(fragments[name])
    assert found.references == set(found.ids)


def test_no_two_fragments_share_an_id(fragments):
    ids = [key for text in fragments.values() for key in Ids(text).ids]
    assert len(ids) == len(set(ids))


@each_fragment
def test_a_fragments_colours_are_the_pages_own(name, fragments):
    assert re.findall(r"#[0-9a-fA-F]{6}\b", fragments[name]) == []


def test_every_colour_is_a_variable_of_the_page_in_light_and_dark():
    css = resources.files("adacd_hil.lab.report").joinpath("assets", "report.css").read_text(encoding="utf-8")
    counts = {name: len(re.findall(rf"--{name}:", css)) for name in (*COLOURS, "paper")}
    assert counts == dict.fromkeys((*COLOURS, "paper"), 2)


def test_the_page_is_as_light_as_the_printed_figures():
    css = resources.files("adacd_hil.lab.report").joinpath("assets", "report.css").read_text(encoding="utf-8")
    light = {name: re.search(rf"--{name}: (#[0-9a-f]+)", css)[1] for name in COLOURS}
    assert light == COLOURS


@pytest.mark.long
def test_the_same_run_gives_the_same_fragment(fragments):
    assert {name: drawing.svg().shapes for name, drawing in draw_touched_run().items()} == fragments


def test_the_same_run_gives_the_same_picture(drawings):
    assert drawings["fig6"].png() == draw_touched_run()["fig6"].png()


def test_a_picture_is_1500_dots_wide_even_after_a_fragment_was_made_of_it(drawings):
    drawing = drawings["fig6"]
    drawing.svg()
    assert int.from_bytes(drawing.png()[16:20], "big") == 1500


def test_the_users_own_plot_style_changes_nothing(fragments):
    with mpl.rc_context({"axes.facecolor": "#112233", "svg.fonttype": "path", "axes.grid": False}):
        assert draw_touched_run()["fig6"].svg().shapes == fragments["fig6"]
