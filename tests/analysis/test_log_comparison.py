"""Two logs beside each other: what differs is named with the first cycle, contacts are matched by time."""

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log.recorded_run import make_run, record
from mcap.reader import make_reader
from mcap.writer import Writer

from adacd_hil.lab.cli.compare_command import contact_in_words
from adacd_hil.lab.report.run_reading import read_run
from adacd_hil.lab.runs.log_comparison import MATCH_S, Contact, compare_logs, match_contacts
from adacd_hil.lab.thresholds.free_motion import schemes
from adacd_hil.log import logged_run
from adacd_hil.log.log_files import LogError
from adacd_hil.records import ContactReport
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.setting_keys import apply_settings
from adacd_hil.settings.toml_text import to_toml

SETTINGS = load_settings("paper")


def write(folder: Path, count: int = 40, change=None, settings=SETTINGS) -> Path:
    run = make_run(count)
    run.attachments["config.toml"] = to_toml(settings).encode()
    if change is not None:
        change(run)
    folder.mkdir()
    record(folder / "run.mcap", run)
    return folder / "run.mcap"


def contact(time_s: float, **changes: Any) -> Contact:
    return time_s, ContactReport(0, 1, (0, 0), (0.0, 0.0), (0.0, 0.0), True)._replace(**changes)


@pytest.mark.parametrize(
    ("part", "change", "line"),
    [
        ("output", {"state": 255}, "/scheme has state 255 in cycle 20, which this version does not know"),
        ("output", {"previous_state": 40}, "/scheme has previous_state 40 in cycle 20"),
        ("output", {"fault": 99}, "/scheme has fault 99 in cycle 20"),
        ("output", {"cycle": 19}, "/scheme: cycle 19 is not after the one before"),
        ("contact", {"level": 77}, r"/contact has a report .*: 77 is not a valid ContactLevel"),
    ],
)
def test_a_report_of_what_there_is_not_is_refused_in_one_line(tmp_path, part, change, line):
    def corrupt(run) -> None:
        cycle = run.cycles[20]  # one with a contact
        setattr(cycle, part, getattr(cycle, part)._replace(**change))

    path = write(tmp_path / "odd", change=corrupt)
    with pytest.raises(LogError, match=line):
        read_run(path, None)
    for read in (lambda: compare_logs(path, path).fields, lambda: not list(schemes(path, None))):
        with pytest.raises(LogError, match=line) if "cycle" in change else nullcontext():
            assert not read()


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A log, and one that is shorter, with other settings and some other values."""

    def change(run) -> None:
        for number in (7, 9, 12):
            run.cycles[number].output.block[1] += 0.25 * number  # q of joint 2
        run.cycles[5].output.block[4] = np.nan

    folder = tmp_path_factory.mktemp("compared")
    other = apply_settings(SETTINGS, {"filter.a_rad_s": "20"})
    return write(folder / "a"), write(folder / "b", 25, change, other)


def test_what_differs_is_named_with_its_first_cycle_and_by_how_much(paths):
    found = compare_logs(*paths)
    missing, q = found.fields
    assert (missing.field, missing.first_cycle, missing.cycles, missing.largest) == ("tau_J", 5, 1, np.inf)
    assert (q.field, q.first_cycle, q.cycles) == ("q", 7, 3)
    assert q.largest == pytest.approx(3.0)
    assert q.first_s == pytest.approx((7 - 3) * 1e-3)  # the first cycle in ADAPT is 3
    assert not found.is_same
    assert found.settings == {"filter.a_rad_s": ("10.0", "20.0")}
    assert (found.cycles, found.only) == (25, (15, 0))


def test_no_cycle_is_paired_with_one_of_another_period(tmp_path):
    slow = apply_settings(SETTINGS, {"bus.period_us": "2000"})
    found = compare_logs(write(tmp_path / "fast"), write(tmp_path / "slow", settings=slow))
    assert (found.cycles, found.only, found.fields) == (0, (40, 40), ())
    assert not found.is_same_where_whole
    assert "cycles of 1000 µs in 1, of 2000 µs in 2: none is paired with another" in found.notes


def test_a_contact_that_one_log_reports_otherwise_or_not_at_all_is_a_difference(tmp_path):
    def other_link(run) -> None:
        for cycle in run.cycles:
            cycle.contact = cycle.contact and cycle.contact._replace(link=3 - cycle.contact.link)

    def no_contact(run) -> None:
        for cycle in run.cycles:
            cycle.contact = None

    path = write(tmp_path / "own")
    for name, change in (("link", other_link), ("report", no_contact)):
        found = compare_logs(path, write(tmp_path / name, change=change))
        assert {field.field for field in found.fields} == {f"contact.{name}"}
        assert (found.only, found.is_same, found.is_same_where_whole) == ((0, 0), False, False)
    assert compare_logs(path, path).is_same
    assert not compare_logs(path, write(tmp_path / "short", 25)).fields


def test_contacts_are_matched_with_the_nearest_and_the_rest_stands_alone():
    first = [contact(1.0), contact(5.0), contact(9.0)]
    second = [contact(1.0 + 0.9 * MATCH_S), contact(1.1), contact(5.0 + 1.1 * MATCH_S)]
    assert match_contacts(first, second) == [
        (first[0], second[1]),
        (None, second[0]),
        (first[1], None),
        (None, second[2]),
        (first[2], None),
    ]


def test_a_lower_bound_reads_as_one_in_a_comparison():
    known, lower, later = (contact_in_words(contact(1.0, force_N=-14.7, location=place)) for place in (1, 2, 77))
    assert (known, lower) == ("1.000 s, link 1, -14.7 N", "1.000 s, link 1, ≥ 14.7 N")
    assert later == known  # a place that a later version may have
    assert contact_in_words(contact(1.0)) == "1.000 s, link 1"


def test_a_contact_has_one_counterpart_at_most():
    first, second = [contact(1.0), contact(1.25)], [contact(1.125)]
    assert match_contacts(first, second) == [(first[0], second[0]), (first[1], None)]
    assert match_contacts(second, first) == [(second[0], first[0]), (None, first[1])]


def test_a_long_comparison_says_how_far_it_is(paths, monkeypatch):
    lines: list[str] = []
    compare_logs(paths[0], paths[0], lines.append)
    assert lines == []
    monkeypatch.setattr(logged_run, "PROGRESS_CYCLES", 10)
    found = compare_logs(paths[0], paths[0], lines.append)
    assert lines == [f"{found.cycles} cycles compared"]


def test_a_field_of_contacts_that_an_earlier_version_did_not_write_is_no_difference(tmp_path):
    path, older = write(tmp_path / "own"), tmp_path / "older.mcap"
    with path.open("rb") as source, older.open("wb") as target:
        reader, writer = make_reader(source), Writer(target)
        writer.start(reader.get_header().profile)
        places: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            text, cut = schema.data, 0
            if channel.topic == "/contact":
                text, cut = text[: text.rindex(b"float64 blind_rad")], 8
            if channel.id not in places:
                number = writer.register_schema(schema.name, schema.encoding, text)
                places[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            data = message.data[: len(message.data) - cut]
            writer.add_message(places[channel.id], message.log_time, data, message.publish_time)
        for item in reader.iter_attachments():
            writer.add_attachment(item.create_time, item.log_time, item.name, item.media_type, item.data)
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        writer.finish()
    found = compare_logs(path, older)
    assert found.is_same
    assert ["blind_rad" in note for note in found.notes] == [True]
