"""The search for an excitation: what it makes of a motion, and what it finds."""

import dataclasses
import json

import numpy as np
import pytest
from called import called
from scipy.signal import lsim

from adacd_hil.control.motions import Excitation
from adacd_hil.lab.tune.excitation_search import TOLERANCE, NoExcitationError, Search
from adacd_hil.scheme.kernel.certified_memory import constants_of
from adacd_hil.scheme.model.regressor import regressor
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.run_settings import ExcitationSettings, TrajectorySettings
from adacd_hil.settings.schema import ConfigError

TWO = ((-0.04, 0.01), (-0.04, 0.01))
NO_SINE = ((0.0, 0.0), (0.0, 0.0))


def small_settings(**changes) -> Settings:
    """Give a search of four coefficients on coarse samples, which takes a part of a second."""
    settings = load_settings("certified")
    return dataclasses.replace(
        settings,
        certified=dataclasses.replace(settings.certified, learn_every=10),
        **({"excitation": ExcitationSettings(2.4, TWO, NO_SINE)} | changes),
    )


@pytest.fixture(scope="module")
def search() -> Search:
    return Search(small_settings())


@pytest.fixture(scope="module")
def found(search: Search) -> ExcitationSettings:
    return search.run(1, lambda _: False, iterations=20)


def test_the_motion_is_the_one_that_the_arm_makes():
    settings = load_settings("certified")
    search, played = Search(settings), Excitation(settings)
    motion = search.motion_of(np.array(settings.excitation.cosine), np.array(settings.excitation.sine))
    for n in (0, 1, 100, 599):
        q, dq, ddq = np.zeros((3, 2))
        played.evaluate(n * 0.004, q, dq, ddq)
        for ours, theirs in zip(motion, (q, dq, ddq), strict=True):
            np.testing.assert_allclose(ours[n], theirs, atol=1e-12)
    figures = search.figures(settings.excitation)
    peaks = figures.travel_deg, figures.velocity_deg_s, figures.acceleration_deg_s2
    np.testing.assert_allclose(peaks, np.degrees(np.abs(motion).max(axis=1)))


@pytest.mark.long
def test_what_a_motion_shows_is_what_the_scheme_counts():
    """Information from the equation of motion, filtered in continuous time, and the derivative by differences."""
    settings = load_settings("certified")
    search, played = Search(settings), Excitation(settings)
    scale = constants_of(settings)[0].scale
    elapsed_s = np.arange(1400) * 1e-3
    W = np.zeros((1400, 2, len(scale)))
    for n, at_s in enumerate(elapsed_s):
        q, dq, ddq = np.zeros((3, 2))
        played.evaluate(at_s, q, dq, ddq)
        W[n, :, :7] = regressor(q, dq, ddq, 7, 0.0)
    W[:, :, 7:9] = np.eye(2)
    W[:, :, 9:] = np.einsum("ni,ij->nij", np.gradient(W[:, :, :7] @ settings.cad_theta, 1e-3, axis=0), np.eye(2))
    rows = [lsim(([10.0], [1.0, 10.0]), column, elapsed_s)[1] for column in W.reshape(1400, -1).T]
    X = np.array(rows).reshape(2, len(scale), -1).transpose(1, 0, 2).reshape(len(scale), -1) * scale[:, None]
    eigenvalues = np.linalg.eigvalsh(1e-3 * X @ X.T)
    figures = search.figures(settings.excitation)
    assert figures.excitation_Nm2s == pytest.approx(eigenvalues[0], rel=0.1)
    assert figures.condition == pytest.approx(eigenvalues[-1] / eigenvalues[0], rel=0.1)


def test_what_is_found_begins_at_rest_in_the_corner(found):
    played = Excitation(small_settings(excitation=found))
    q, dq, ddq = np.zeros((3, 2))
    played.evaluate(0.0, q, dq, ddq)
    np.testing.assert_allclose(q, -np.radians([30.0, 60.0]))
    np.testing.assert_allclose(dq, 0.0, atol=1e-4)
    np.testing.assert_allclose(ddq, 0.0, atol=1e-3)


def test_what_is_found_shows_more_than_the_start_within_the_limits(search, found):
    before, after = search.figures(search.present), search.figures(found)
    assert after.excitation_Nm2s > 2.0 * before.excitation_Nm2s
    assert after.cost < before.cost
    for name, limits in search.limits().items():
        assert (np.array(getattr(after, name)) <= np.array(limits) * (1.0 + TOLERANCE)).all()


def test_a_better_motion_is_never_given_up(search, found):
    better = Search(small_settings(excitation=found))
    assert better.figures(better.run(2, lambda climbs: climbs < 2, iterations=6)).cost <= search.figures(found).cost


def test_without_a_model_of_the_arm_torque_has_no_limit_and_the_lag_no_column(search):
    settings = small_settings()
    blind = Search(dataclasses.replace(settings, arm=dataclasses.replace(settings.arm, cad_theta=())))
    figures = blind.figures(blind.present)
    assert (figures.torque_Nm, blind.limits()["torque_Nm"]) == (None, None)
    assert figures.excitation_Nm2s >= search.figures(search.present).excitation_Nm2s


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"trajectory": TrajectorySettings(amplitude_deg=(30.0, 0.0))}, r"\(30.0, 0.0\) leaves an excitation no room"),
        ({"excitation": ExcitationSettings(2.4, ((0.0,), (0.0,)), ((0.0,), (0.0,)))}, "has 1 harmonics"),
    ],
)
def test_what_leaves_nothing_to_search_is_said(changes, words):
    with pytest.raises(ConfigError, match=words):
        Search(small_settings(**changes))


def test_limits_that_no_motion_keeps_are_said_in_a_line():
    trajectory = TrajectorySettings(amplitude_deg=(1e-7, 1e-7))
    arm = dataclasses.replace(small_settings().arm, torque_limit_Nm=(0.0, 0.0))
    with pytest.raises(NoExcitationError, match="none of 1 motions keeps the limits"):
        Search(small_settings(trajectory=trajectory, arm=arm)).run(1, lambda _: False, iterations=1)


def test_the_command_writes_a_configuration_with_what_it_found(tmp_path):
    config, out = tmp_path / "small \U0001f9be.toml", tmp_path / "found" / "mine.toml"
    small = "period_s = 2.4\ncosine = [[-0.04, 0.01], [-0.04, 0.01]]\nsine = [[0.0, 0.0], [0.0, 0.0]]\n"
    config.write_text(f"extends = 'certified'\n[certified]\nlearn_every = 20\n[excitation]\n{small}")
    words = ["excitation", "--config", str(config), "--seconds", "0", "--out", str(out), "--json"]
    done = called(*words)
    assert done.exit_code == 0
    printed = json.loads(done.stdout)
    assert printed["found"]["excitation_Nm2s"] > printed["present"]["excitation_Nm2s"]
    written = load_settings(str(out))
    assert written.excitation == parse(ExcitationSettings, printed["excitation"])
    assert written.certified.learn_every == 20
    again = called("excitation", "--config", str(out), "--seconds", "0", "--out", str(out))
    assert again.exit_code == 2  # it would extend itself
