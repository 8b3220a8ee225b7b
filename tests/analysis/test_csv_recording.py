"""CSV files as loggers write them: what is read, what is left out and counted, and which key a refusal names."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from foreign_arms import urdf_text

from adacd_hil.lab.offline.recording_import import ForeignRecording, derive, read_recording
from adacd_hil.lab.offline.recording_map import read_map
from adacd_hil.log.log_files import LogError
from adacd_hil.settings.schema import ConfigError

ARM = urdf_text(1, ("0 0 1",), has_masses=False)
MAP = """[arm]
urdf = "arm.urdf"
[columns]
time = "t"
q = ["angle"]
tau_J = ["torque"]
"""
COUNT = 200


def wave(k: int) -> tuple[float, float]:
    return round(np.sin(0.05 * k), 4), round(2.0 * np.cos(0.05 * k), 4)


def table(row: Callable[[int, float, float], str], head: str = "t,angle,torque\n") -> str:
    return head + "".join(row(k, *wave(k)) + "\n" for k in range(COUNT))


def plain(k: int, angle: float, torque: float) -> str:
    return f"{0.005 * k:.3f},{angle},{torque}"


def with_commas(*row) -> str:
    return plain(*row).replace(",", ";").replace(".", ",")


def dated(k: int, angle: float, torque: float) -> str:
    return f"2024-05-01T10:00:{0.005 * k:09.6f}Z,{angle},{torque}"


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., ForeignRecording]:
    (tmp_path / "arm.urdf").write_text(ARM)

    def read_text(text: str | bytes, *more: str) -> ForeignRecording:
        """Read a CSV file with the map, each of `more` (old, new) replaced in it, or added to it."""
        described = MAP
        for change in more:
            old, _, new = change.partition(" -> ")
            described = described.replace(old, new) if new or change.endswith(" -> ") else described + change + "\n"
        (tmp_path / "map.toml").write_text(described)
        (tmp_path / "r.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_recording(tmp_path / "r.csv", read_map(tmp_path / "map.toml"))

    return read_text


def check(recording: ForeignRecording, tolerance: float = 1e-9) -> None:
    """Compare with what was written: a sample every 5 ms."""
    (stretch,) = recording.stretches
    expected = np.array([wave(k) for k in range(len(stretch.record.q))])
    assert recording.period_s == pytest.approx(0.005)
    np.testing.assert_allclose(stretch.record.q[:, 0], expected[:, 0], atol=tolerance)
    np.testing.assert_allclose(stretch.record.tau_J[:, 0], expected[:, 1], atol=tolerance)
    assert len(stretch.record.q) >= COUNT - 2


FORMS = {
    "semicolons and decimal commas": (
        table(with_commas, "t;angle;torque\n"),
        ['[csv]\ndelimiter = ";"\ndecimal = ","'],
    ),
    "milliseconds": (table(lambda k, q, tau: f"{5 * k},{q},{tau}"), ['[units]\ntime = "ms"']),
    "dates": (table(dated), ['[units]\ntime = "iso"']),
    "dates with a blank, and no zone": (
        table(lambda k, q, tau: f"2024-05-01 10:00:{0.005 * k:06.3f},{q},{tau}"),
        ['[units]\ntime = "iso"'],
    ),
    "ns since 1970": (
        table(lambda k, q, tau: f"{1_712_000_000_123_456_789 + 5_000_000 * k},{q},{tau}"),
        ['[units]\ntime = "ns"'],
    ),
    "blanks": (
        table(lambda k, q, tau: f"  {0.005 * k:.3f}   {q} {tau}", "t angle torque\n"),
        ['[csv]\ndelimiter = " "'],
    ),
    "a comment before the heads": (table(plain, "# t,angle,torque\n"), []),
    "the same as numpy.savetxt writes it": (
        table(lambda k, q, tau: f"{0.005 * k:.18e} {q:.18e} {tau:.18e}", "# t angle torque\n"),
        ['[csv]\ndelimiter = " "'],
    ),
    "a delimiter at the end of each row": (table(lambda *row: plain(*row) + ",", "t,angle,torque,\n"), []),
    "a numbered time, beside a period": (table(plain), ['time = "t" -> time = "1"', "[sampling]\nperiod_s = 0.005"]),
    "empty lines": (table(plain, "t,angle,torque\n\n") + "\n\n", []),
    "a mark of the byte order, and of another system's line ends": (
        "\ufeff" + table(plain).replace("\n", "\r\n"),
        [],
    ),
    "quotes": (table(lambda k, q, tau: f'"{0.005 * k:.3f}","{q}","{tau}"', '"t","angle","torque"\n'), []),
}


@pytest.mark.parametrize("form", FORMS)
def test_forms_of_a_table_are_read(read, form):
    text, keys = FORMS[form]
    recording = read(text, *keys)
    check(recording)
    assert recording.notes == ()


def test_a_period_stands_for_the_times(read):
    text = table(lambda _, q, tau: f"{q},{tau}", "angle,torque\n")
    period = "[sampling]\nperiod_s = 0.005"
    for keys in ((period, 'time = "t"\n -> '), (period,), (period, '[units]\ntime = "ms"')):
        recording = read(text, *keys)
        check(recording)
        assert recording.notes == ("no column of times: a row every 0.005 s (sampling.period_s)",)
    cut = read(text.replace(f"{wave(100)[0]},{wave(100)[1]}\n", f"{wave(100)[0]}\n"), period)
    check(cut, tolerance=2e-3)  # the row that is left out leaves its time


def test_times_that_are_missing_without_a_period_name_the_key(read):
    text = table(lambda _, q, tau: f"{q},{tau}", "angle,torque\n")
    with pytest.raises(ConfigError, match=r"no column 't'.*`sampling\.period_s`"):
        read(text)
    with pytest.raises(ConfigError, match=r"`columns\.time`.*`sampling\.period_s`"):
        read(text, 'time = "t"\n -> ')
    with pytest.raises(ConfigError, match="did you mean 'times'"):
        read(text.replace("angle", "times"), "[sampling]\nperiod_s = 0.005", 'time = "t" -> time = "tmes"')


def test_a_row_of_units_is_compared_with_the_map(read):
    known = {"[s],(rad),N m": "[s], (rad), N m", "s,nan,Nm": "s, Nm", ",rad,": "rad", "# s,rad,Nm": "s, rad, Nm"}
    for units, seen in known.items():
        recording = read(table(plain, f"t,angle,torque\n{units}\n"))
        check(recording)
        assert recording.notes == (f"row 2 names units ({seen})",)
    assert read(table(plain, "t,angle,torque\n# A\n# by hand, deg\n")).notes == ()
    for units in ("s,deg,Nm", "s,deg,", "0,deg,Nm", "s,deg", "#s,deg,Nm", "s,rad,Nm\ns,deg,Nm", "s,mdeg,Nm", "-,-,-"):
        with pytest.raises(ConfigError, match=r"row \d: '(m?deg' in column 'angle|-' in column 't)'"):
            read(table(plain, f"t,angle,torque\n{units}\n"))


SPOILT = {
    "doubled": (lambda rows: rows[:101] + rows[100:], "1 row with the time of the row before", "row 102: 0.495 s"),
    "cut": (lambda rows: [*rows[:-1], rows[-1][:9]], "1 row cut short", "row 201: it has 2 cells of 3"),
    "a word": (lambda rows: [*rows[:50], "0.245,ERR,1\n", *rows[51:]], "1 row that can't be read", "'angle' is 'ERR'"),
    "out of order": (lambda rows: [*rows[:50], "0.1,0,0\n", *rows[50:]], "1 row out of order", "goes back to 0.1 s"),
    "without a time": (lambda rows: [*rows[:50], ",0,0\n", *rows[50:]], "1 row without a time", "row 51"),
    "a time without end": (lambda rows: [*rows[:50], "inf,0,0\n", *rows[50:]], "1 row without a time", "row 51"),
    "no time at all": (lambda rows: [*rows[:50], "snan,0,0\n", *rows[50:]], "1 row that can't be read", "row 51"),
    "too long": (lambda rows: [*rows[:50], "0.245,0,0,9\n", *rows[51:]], "1 row that can't be read", "4 cells"),
    "without a value": (lambda rows: [*rows[:50], "0.2449,,1\n", *rows[50:]], "1 row without all values", ""),
}


@pytest.mark.parametrize("kind", SPOILT)
def test_a_spoilt_row_is_left_out_and_counted(read, kind):
    spoil, count, first = SPOILT[kind]
    recording = read("".join(spoil(table(plain).splitlines(keepends=True))))
    check(recording, tolerance=2e-3)
    (note,) = recording.notes
    assert note.startswith(count)
    assert first in note


def test_many_doubled_rows_are_no_harm_and_many_spoilt_ones_end_it(read):
    rows = table(plain).splitlines(keepends=True)
    doubled = read("".join([rows[0], *(row for row in rows[1:] for _ in range(2))]))
    check(doubled)
    assert doubled.notes[0].startswith("200 rows with the time of the row before")
    for spoilt, said in (
        ([row.replace(",0", ",x") for row in rows], "no number; .* are too many"),
        (rows + rows[1:], "row 202: time goes back to 0 s; 199 rows out of order are too many"),
    ):
        with pytest.raises(LogError, match=said):
            read("".join(spoilt))


REFUSED = {
    "decimal commas": (
        table(with_commas, "t;angle;torque\n"),
        ['[csv]\ndelimiter = ";"'],
        "row 2: column 't' is '0,000', no number: `csv.decimal` = \",\" reads it",
    ),
    "dates": (table(dated), [], '`units.time` = "iso" reads it'),
    "milliseconds": (
        table(lambda k, q, tau: f"{5 * k},{q},{tau}"),
        [],
        'rows are 5 s apart, 1e-05 to 0.05 s are expected; with `units.time` = "ms" they are 5 ms',
    ),
    "microseconds taken for milliseconds": (
        table(lambda k, q, tau: f"{5000 * k},{q},{tau}"),
        ['[units]\ntime = "ms"'],
        '`units.time` = "us" they are 5000 us',
    ),
    "another delimiter": (
        table(plain).replace(",", "\t"),
        [],
        "has one column; with `csv.delimiter` = '\\t' it has more",
    ),
    "no positions in the map": (table(plain), ['q = ["angle"]\n -> '], "missing key `columns.q`"),
    "a spreadsheet": (b"PK\x03\x04" + bytes(100), [], "is a spreadsheet or an archive: save it as CSV"),
    "the URDF": (f"{ARM}\n", [], "is a URDF: the map names it, `arm.urdf`"),
    "frames": (b"LOGG" + bytes(100), [], "log export --format csv --dbc"),
    "compressed": (b"\x1f\x8b\x08\x00" + bytes(100), [], "is compressed: gunzip it"),
    "no text": (b"t,angle,torque\n" + b"\xb0\xff\n" * 60, [], "is no text in UTF-8"),
    "UTF-16": (table(plain).encode("utf-16"), [], "is UTF-16: save it as UTF-8"),
    "nothing": ("", [], "is empty"),
    "a head twice": (table(plain, "t,angle,angle\n"), [], "has 2 columns 'angle'"),
    "16 rows a second": (table(lambda k, q, tau: f"{0.06 * k},{q},{tau}"), [], "rows are 0.06 s apart"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_file_that_can_not_be_read_names_the_key_or_the_remedy(read, kind):
    text, keys, said = REFUSED[kind]
    with pytest.raises((LogError, ConfigError)) as refusal:
        read(text, *keys)
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_velocities_that_nobody_filled_in_are_derived(read):
    head, keys = "t,angle,torque,speed\n", ('time = "t" -> time = "t"\ndq = ["speed"]',)
    idle = read(table(lambda *row: plain(*row) + ",0.0", head), *keys)
    assert idle.notes == ("the velocity of joint1 is always 0 rad/s: velocities are derived from the positions",)
    assert np.abs(idle.stretches[0].record.dq).max() == pytest.approx(10.0, rel=0.02)
    filled = read(table(lambda k, q, tau: f"{plain(k, q, tau)},{10.0 * np.cos(0.05 * k)}", head), *keys)
    assert filled.notes == ()
    assert filled.has_velocities
    assert not idle.has_velocities


def test_a_joint_at_rest_has_no_derived_velocity(read):
    resting = read(table(lambda k, q, tau: f"{0.005 * k:.3f},0.7,{tau}"))
    assert not resting.stretches[0].record.dq.any()


@pytest.mark.parametrize(("unit", "turn"), [("rad", 2.0 * np.pi), ("deg", 360.0)])
def test_a_position_that_jumps_by_a_turn_goes_on(read, unit, turn):
    def angle(k: int) -> float:
        return (0.6 + 0.04 * wave(k)[0]) * turn

    def wrapped(k: int, _: float, torque: float) -> str:
        return f"{0.005 * k:.3f},{(angle(k) + turn / 2.4) % turn - turn / 2.4:.9f},{torque}"

    recording = read(table(wrapped), f'[units]\nq = "{unit}"')
    expected = np.array([angle(k) for k in range(COUNT)]) * 2.0 * np.pi / turn
    q = recording.stretches[0].record.q[:, 0]
    np.testing.assert_allclose(q - q[0], expected[: len(q)] - expected[0], atol=1e-6)
    assert recording.notes == ("the position of joint1 jumps by a turn 3 times: it goes on instead",)


def test_positions_that_jump_otherwise_stay_as_they_are(read):
    jumping = read(table(lambda k, q, tau: f"{0.005 * k:.3f},{4.0 * (k % 20 == 0)},{tau}"))
    assert jumping.stretches[0].record.q.max() == pytest.approx(4.0)
    assert jumping.notes == ()


def test_times_that_jitter_are_a_note_with_the_period_that_replaces_them(read):
    (note,) = read(table(lambda k, q, tau: f"{0.005 * k + 0.002 * (k % 2):.3f},{q},{tau}")).notes
    assert note.startswith("rows are 3 to 7 ms apart")
    assert "`sampling.period_s` = 0.005" in note
    assert read(table(plain)).notes == ()


def test_noise_is_at_least_that_of_rounding(read):
    recording = read(table(lambda k, q, tau: f"{0.005 * k:.3f},{q},{round(tau / 0.5) * 0.5}"))
    assert recording.noise_Nm[0] == pytest.approx(0.5 / np.sqrt(12.0))


def test_a_joint_that_comes_to_rest_has_no_velocity_there():
    """Not even the rounding's, whose sign would be friction's."""
    q = np.outer(np.minimum(np.arange(60) / 200.0, 0.1), [1.0, -1e-3])
    dq = derive(q, 0.001, 11)
    assert np.all(dq[:15] != 0.0)
    assert np.all(dq[26:] == 0.0)
