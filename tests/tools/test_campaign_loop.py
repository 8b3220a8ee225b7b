"""campaign_loop.py: trials in order in any number of processes, and the table of figures."""

import os

import pytest
from campaign_loop import (
    Figure,
    exit_status,
    play_trials,
    print_figures,
)


def square(number):
    return number * number


def process_of(_):
    return os.getpid()


@pytest.mark.slow
def test_two_jobs_play_in_processes_of_their_own_and_give_the_results_in_order():
    assert list(play_trials(square, range(30), 2)) == [number * number for number in range(30)]
    assert os.getpid() not in set(play_trials(process_of, range(3), 2))


def test_a_figure_beyond_its_bound_is_named_in_the_table_and_is_the_exit_status(capsys):
    good, bad = Figure("certified", "3 of 3", "all", True), Figure("missed", "2 of 3", "0", False)
    print_figures([good, bad])
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if "not met" in line] == [line for line in lines if line.startswith("missed")]
    assert (exit_status([good]), exit_status([good, bad])) == (0, 1)
