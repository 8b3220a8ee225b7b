"""Timeline and contact cards: what is marked, where it stands, and how the arm is drawn."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hand_made_run import A, evaluated, make_run, react, touch, touched_run

from adacd_hil.lab.report.page import render
from adacd_hil.lab.report.run_page import CARDS, Push, contact_cards, draw_arm
from adacd_hil.lab.report.timeline import notices_of, state_key, timeline_of
from adacd_hil.log.reader import LoggedEvent
from adacd_hil.records import Event, Location, SchemeState


def drawn(run):
    return render("timeline.html.j2", timeline=timeline_of(run, evaluated(run)), state_key=state_key(run), notices=())


def test_the_timeline_names_states_contacts_and_false_alarms_and_a_mark_stands_for_the_stretch_around_it():
    html = drawn(touched_run())
    titles = re.findall(r"<title>(.*?)</title>", html)
    assert titles[0] == "enabling, −0.05 to 0.00 s"
    assert "contact 1 at 1.95 s, on link 1, found on link 1, after 5 ms" in titles
    assert "contact 3 at 6.95 s, on link 1, missed" in titles
    assert titles[-1] == "false alarm, at 8.95 s"
    stretch = re.search(r'data-from="([^"]*)" data-to="([^"]*)"><title>contact 1', html)
    assert [float(text) for text in stretch.groups()] == pytest.approx([1.80, 2.55])


def test_marks_lie_where_their_time_is():
    run = make_run((SchemeState.ENABLE, 1000), (A, 1001))
    boxes = re.findall(r'<rect x="([^"]*)" y="8.0" width="([^"]*)" height="24.0" fill', drawn(run))
    assert [tuple(map(float, box)) for box in boxes] == [(78.0, 459.0), (537.0, 459.0)]


def test_a_fault_and_a_warning_are_notices_in_the_order_of_time():
    run = make_run((A, 100), (SchemeState.FAULT, 50))
    told = ((50, "info", "fine"), (110, "error", "off"), (120, "warning", "slow"))
    events = tuple(LoggedEvent(int(run.t_ns[row]), Event(level, "bus", what)) for row, level, what in told)
    run = replace(run, events=events)
    notices = notices_of(run, evaluated(run))
    assert [(notice.at_s, notice.is_bad, notice.text) for notice in notices] == [
        (0.1, True, "fault"),
        (pytest.approx(0.11), True, "bus: off"),
        (pytest.approx(0.12), False, "bus: slow"),
    ]


def test_many_warnings_do_not_crowd_out_a_fault():
    run = make_run((A, 500), (SchemeState.FAULT, 1))
    run = replace(run, events=tuple(LoggedEvent(int(t), Event("warning", "bus", "slow")) for t in run.t_ns[:400]))
    notices = notices_of(run, evaluated(run))
    assert (len(notices), notices[-1].text) == (300, "fault")


LENGTHS = (0.4, 0.3)


def arm_at(q, push):
    return render("arm.html.j2", arm=draw_arm(np.array(q), LENGTHS, push, "arm"))


def points_of(svg, kind):
    """Give the ends of the line of a kind, mm, y up."""
    found = re.search(rf'<path d="M(\S+) (\S+)L(\S+) (\S+)" class="{kind}"', svg)
    x1, y1, x2, y2 = (float(text) for text in found.groups())
    return (x1, -y1), (x2, -y2)


def test_the_arm_is_drawn_at_its_joint_angles():
    svg = arm_at((0.5 * np.pi, 0.5 * np.pi), Push(1, 0, 0.0, None, None))
    assert (points_of(svg, "link touched"), points_of(svg, "link")) == (((0, 0), (0, 400)), ((0, 400), (-300, 400)))


@pytest.mark.parametrize("side", [1, -1])
def test_the_force_pushes_toward_its_side_at_its_lever_arm_whose_spread_is_a_bar(side):
    svg = arm_at((0.0, 0.0), Push(2, side, 1.0, 0.2, 0.01))
    head = re.search(r'<polygon points="([^,]*),([^ ]*)', svg)
    (_, tail_y), (_, neck_y) = points_of(svg, "force")
    assert (float(head[1]), float(head[2])) == (600.0, 0.0)
    assert side * (neck_y - tail_y) > 100.0
    assert points_of(svg, "spread") == ((590, 0), (610, 0))


def carded(run):
    metrics = evaluated(run)
    return render("contact_cards.html.j2", cards=contact_cards(metrics, run), metrics=metrics)


def test_each_contact_has_a_card_with_the_arm_at_its_moment():
    run = touched_run()
    run.motion.q[2005] = (1.0, -1.5)
    html = carded(run)
    assert "Arm at contact 1, joints at 1.00 and -1.50 rad, link 1 touched" in html
    assert (html.count("<h3>"), html.count("<svg")) == (3, 3)
    assert (html.count('class="wrong"'), html.count("<dd>missed</dd>")) == (1, 1)


def test_a_card_marks_the_wrong_link_but_not_a_contact_that_detection_was_off_for():
    run = make_run()
    touch(run, 2000, 250, (5.0, 1.0), link=2)
    assert 'class="wrong"' in carded(react(run, 2005, link=1))
    run = make_run()
    touch(run, 400, 100, (5.0, 0.0))
    html = carded(run)
    assert ("detection was off: learning" in html, 'class="wrong"' in html) == (True, False)


def test_a_known_force_is_drawn_where_the_report_has_it():
    run = make_run()
    touch(run, 2000, 250, (5.0, 1.0), link=2)
    told = {"location": Location.KNOWN, "force_N": -9.0, "force_sigma": 0.5, "lever_m": 0.2, "lever_sigma": 0.01}
    html = carded(react(run, 2005, link=2, **told))
    (tail_x, tail_y), (neck_x, neck_y) = points_of(html, "force")
    along = (np.cos(0.5), np.sin(0.5))  # link 2
    assert along[0] * (neck_y - tail_y) - along[1] * (neck_x - tail_x) < -50.0
    assert "<dd>−9.0 ± 0.5 N</dd>" in html
    assert 'class="spread"' in html


def test_cards_stop_where_the_table_goes_on():
    run = make_run()
    for index in range(CARDS + 2):
        touch(run, 1100 + 20 * index, 10, (5.0, 0.0), index=index)
    html = carded(run)
    assert (html.count("<h3>"), f"The first {CARDS} of {CARDS + 2}." in html) == (CARDS, True)
