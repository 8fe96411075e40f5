"""The error of a policy's hands: figures of made-up hands, and of real ones."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from reached import collect_reach

from benchmarks.policy_error import (
    Hands,
    Setting,
    compute_best_blind_error,
    compute_margin,
    make_episode_seed,
    read_hands,
    stand_still,
)
from xop_lerobot.core.errors import BadDataset, BadValue
from xop_lerobot.recording.facts import read_facts

SETTING = Setting("rby1", "dual_point_reach", "empty", "mild", "diff_drive", fps=25, seed=0)


def make_hands(palms: np.ndarray, points: np.ndarray) -> Hands:
    n = len(points)
    return Hands(SETTING, np.arange(n), palms, points, np.zeros(n, bool), np.zeros(n, bool))


def draw_points(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 2, 3))


def test_the_error_is_of_the_last_frames_of_both_hands():
    points = draw_points(3)
    palms = np.repeat(points[:, None], 40, axis=1)
    palms[:, :-10] += 5.0  # what was before does not count
    palms[:, -10:, 0] += [0.03, 0.04, 0.0]
    hands = make_hands(palms, points)
    assert hands.compute_errors(window_s=0.4) == pytest.approx(0.025)
    assert hands.compute_errors(window_s=0.8).min() > 1


def test_who_looks_is_nearer_to_its_own_points_than_to_others():
    points = draw_points(12)
    seeing = make_hands(np.repeat(points[:, None], 5, axis=1) + 0.01, points)
    assert seeing.compute_errors().mean() < 0.02
    assert seeing.compute_errors_elsewhere().mean() > 0.5


def test_who_does_not_look_is_as_near_to_others_points():
    points = draw_points(12)
    blind = make_hands(np.zeros((12, 5, 2, 3)), points)
    own, others = blind.compute_errors(), blind.compute_errors_elsewhere()
    assert own.mean() == pytest.approx(others.mean())


def test_nothing_that_goes_to_one_place_beats_the_best_blind_one():
    points = draw_points(30, seed=3)
    best = compute_best_blind_error(points)
    rng = np.random.default_rng(0)
    for spread in (0.0, 0.01, 0.1, 1.0):
        for start in (points.mean(axis=0), np.median(points, axis=0)):
            place = start + spread * rng.normal(size=(2, 3))
            assert np.linalg.norm(points - place, axis=-1).mean() >= best - 1e-9


def test_the_best_blind_one_is_exact_where_the_answer_is_known():
    """Three of five points are one: the geometric median is there."""
    points = np.zeros((5, 2, 3))
    points[3, :, 0], points[4, :, 1] = 1.0, -2.0
    assert compute_best_blind_error(points) == pytest.approx(3 / 5, abs=1e-6)


def test_margins_compare_episode_by_episode():
    mine, its = np.array([0.1, 0.2, 0.3]), np.array([0.2, 0.25, 0.2])
    margin = compute_margin(mine, its)
    assert margin.mean == pytest.approx(0.05 / 3)
    assert (margin.nearer, margin.episodes) == (2, 3)
    assert margin.interval[0] <= margin.mean <= margin.interval[1]
    with pytest.raises(BadValue, match="^errors of 3 and of 2 episodes cannot be compared$"):
        compute_margin(mine, its[:2])


def test_a_robot_that_stands_still_stays_away():
    hands = stand_still(SETTING, [0, 3], at=0.4)
    assert hands.palms.shape == (2, 10, 2, 3)
    assert np.ptp(hands.palms, axis=1).max() < 0.01
    assert (hands.compute_errors(0.1) > 0.08).all()
    assert not hands.success.any()
    assert not hands.fallen.any()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """An episode of a person who reaches the points."""
    return collect_reach(tmp_path_factory.mktemp("reached"), seed=4, width=32, height=24)


@pytest.mark.slow
def test_the_points_are_where_they_were_when_it_was_recorded(recorded):
    """The task said that the palms were at their points; so they are here."""
    (facts,) = read_facts(recorded)
    assert facts["success"]
    hands = read_hands(recorded, at=facts["length"] / 25)
    assert hands.setting == dataclasses.replace(SETTING, seed=4)
    assert (hands.compute_errors(window_s=0.04) < 0.05).all()
    assert hands.success.all()
    assert not read_hands(recorded, at=1.0).success.any()
    # Standing still begins where the recorded one did.
    still = stand_still(hands.setting, [0], at=0.04)
    assert still.palms[:, 0] == pytest.approx(hands.palms[:, 0], abs=1e-4)
    assert still.points == pytest.approx(hands.points)


@pytest.mark.slow
def test_what_is_too_short_is_refused(recorded):
    with pytest.raises(BadDataset, match=r"episode 0 ends after .* to be judged at 60\.00 s$"):
        read_hands(recorded, at=60)


def test_seeds_of_episodes_differ():
    seeds = {make_episode_seed(seed, episode) for seed in range(5) for episode in range(20)}
    assert len(seeds) == 100
