"""Tables laid out to the width of a terminal."""

from hypothesis import given
from hypothesis import strategies as some

from adacd_hil.table_layout import fit_table
from adacd_hil.terminal import fold

WIDE = [("name", "count", "words", "more"), ("first", "1", "one two three four", "x" * 20), ("2nd", "22", "", "y")]


def test_a_table_that_fits_is_one() -> None:
    assert fit_table(WIDE, (1,), 80) == fit_table(WIDE, (1,))
    assert fit_table(WIDE, (1,), 80) == [
        "name   count  words               more",
        "first      1  one two three four  xxxxxxxxxxxxxxxxxxxx",
        "2nd       22                      y",
    ]


def test_a_table_that_is_a_little_wider_gets_narrower_columns_of_words() -> None:
    assert fit_table(WIDE, (1,), 52) == [
        "name   count  words             more",
        "first      1  one two three     xxxxxxxxxxxxxxxxxxxx",
        "              four",
        "2nd       22                    y",
    ]


def test_a_much_wider_table_is_told_in_parts_that_begin_with_the_first_column() -> None:
    assert fit_table(WIDE, (1,), 40) == [
        "name   count  words",
        "first      1  one two three four",
        "2nd       22",
        "",
        "name   more",
        "first  xxxxxxxxxxxxxxxxxxxx",
        "2nd    y",
    ]


def test_each_part_begins_with_what_tells_rows_apart() -> None:
    lines = [("who", "what", "one", "two"), ("a", "x", "1" * 12, "2" * 12), ("a", "y", "3", "4")]
    assert fit_table(lines, (2, 3), 26, names=2) == [
        "who  what           one",
        "a    x     111111111111",
        "a    y                3",
        "",
        "who  what           two",
        "a    x     222222222222",
        "a    y                4",
    ]
    assert fit_table(lines, (2, 3), 23, names=2)[4] == "who  what           two"  # just enough
    assert fit_table(lines, (2, 3), 20, names=2)[0] == "who  what"  # no room for them beside the numbers


def test_where_the_first_column_goes_on_it_is_no_further_row() -> None:
    lines = [("what", "a", "b"), ("the first thing that is told", "1", "x y"), ("other", "2", "z")]
    assert fit_table(lines, width=26) == [
        "what                a  b",
        "the first thing     1  x y",
        "  that is told",
        "other               2  z",
    ]


def test_a_key_that_is_parted_has_no_space_in_it_and_a_number_is_not_parted() -> None:
    lines = [("key", "value"), ("arm.cad_theta", "[0.178607, 0.036855]")]
    assert fit_table(lines, width=20) == [
        "key        value",
        "arm.       [0.178607",
        "  cad_     ,",
        "  theta    0.036855]",
    ]


def test_a_number_has_its_unit_in_the_same_line_where_both_have_room() -> None:
    lines = [("run", "certificate"), ("a", "certified after 2.0 s"), ("b", "a threshold of 0.002 rad/s, 3 times")]
    assert fit_table(lines, width=23) == [
        "run  certificate",
        "a    certified after",
        "     2.0 s",
        "b    a threshold of",
        "     0.002 rad/s, 3",
        "     times",
    ]
    assert fold("certified after 2.0 s", 20) == "certified after\n  2.0 s"
    assert fold("certified after 2.0 sails", 20) == "certified after 2.0\n  sails"
    assert fold("0.0000000002 rad/s", 16) == "0.0000000002\n  rad/s"


def test_a_row_of_a_screen_is_one_line_and_says_where_it_is_cut() -> None:
    assert fit_table(WIDE, (1,), 40, is_cut=True) == [
        "name   count  words         more",
        "first      1  one two thr…  xxxxxxxxxxx…",
        "2nd       22                y",
    ]


CELLS = some.text(some.sampled_from("ab/._= \té\n\x1b"), max_size=60)


@given(
    some.integers(1, 6).flatmap(lambda n: some.lists(some.tuples(*[CELLS] * n), min_size=1, max_size=4)),
    some.integers(40, 100),
    some.sets(some.integers(0, 5)),
    some.booleans(),
    some.integers(1, 3),
)
def test_whatever_is_in_a_table_no_line_is_wider_and_no_letter_lost(lines, width, right, is_cut, names) -> None:
    told = fit_table(lines, right, width, is_cut, min(names, len(lines[0])))
    assert max(map(len, told)) <= width
    if not is_cut:
        shown = sorted("".join(told).replace(" ", ""))
        first = sorted("".join(fit_table([line[:1] for line in lines])).replace(" ", ""))
        rest = sorted("".join(fit_table([line[1:] for line in lines] if lines[0][1:] else [])).replace(" ", ""))
        missing = list(shown)
        for letter in (*first, *rest):
            missing.remove(letter)


def test_lines_are_folded_below_their_text() -> None:
    assert fold("     2.00 s  one two three four five six seven eight", 40).split("\n") == [
        "     2.00 s  one two three four five six",
        "             seven eight",
    ]
    assert fold("one two three four five six seven eight nine", 30) == "one two three four five six\n  seven eight nine"


def test_what_is_typed_stands_apart_from_a_question_that_is_folded() -> None:
    assert fold("Which of the many interfaces of this machine is it [none]: ", 40).endswith(
        "\n  machine is it [none]: "
    )


@given(some.text(some.sampled_from("ab/._ \té\n"), max_size=300), some.integers(20, 100))
def test_whatever_is_folded_no_line_is_wider_but_a_word_and_no_letter_is_lost(text, width) -> None:
    told = fold(text, width)
    assert told.split() == text.split()
    assert all(len(line) <= width or len(line.split()) == 1 for line in told.expandtabs().split("\n"))


def test_nothing_is_folded_where_there_is_no_width() -> None:
    assert fold("one two three " * 40, None) == "one two three " * 40
