"""The sweep of a person's motions: what people can do, and what is a fault of the robot."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.motions import EYE_HEIGHT, MOTIONS, START_S
from benchmarks.run_motions import compute_tilts, find_faults, measure, run_motion
from xop_lerobot.morphology.morphology import make_morphology

GOOD = {
    "fallen": False, "gap_rad": 0.05, "tilt_deg": 3.0, "contortion_deg": 2.0, "head_end_cm": 0.5,
    "hand_end_cm": 1.0, "foot_cm": 0.3, "contacts": [], "trouble": "",
}  # fmt: skip


def test_at_least_forty_motions():
    assert len(MOTIONS) >= 40


@pytest.mark.parametrize("name", list(MOTIONS))
def test_a_person_moves_so(name):
    """From rest, without a jump, and no faster than people are."""
    motion, dt = MOTIONS[name], 0.01
    times = np.arange(0, motion.end + 1, dt)
    frames = [motion.frame_at(float(time)) for time in times]
    poses = {
        part: np.array([frame.pose(part) for frame in frames])
        for part in ("head", "left_wrist", "right_wrist")
    }
    assert all(np.isfinite(track).all() for track in poses.values())
    first = round(START_S / dt)
    for track in poses.values():
        np.testing.assert_allclose(track[:first], np.tile(track[0], (first, 1)), atol=1e-9)
    np.testing.assert_allclose(poses["head"][0], [0, 0, EYE_HEIGHT, 1, 0, 0, 0], atol=1e-9)
    speeds = {
        part: np.linalg.norm(np.diff(track[:, :3], axis=0), axis=1).max() / dt
        for part, track in poses.items()
    }
    assert speeds["head"] < 1.6
    assert max(speeds["left_wrist"], speeds["right_wrist"]) < 4.0
    assert frames[0].mode is motion.mode


def test_tilts_that_nobody_asked_for():
    """A robot that bows less than its operator has an error, but is not contorted."""

    def lean(angle: float, aside: float = 0.0) -> np.ndarray:
        along, across = np.cos(aside), np.sin(aside)
        return np.array([[np.sin(angle) * along, np.sin(angle) * across, np.cos(angle)]])

    error, contortion = compute_tilts(lean(0.3), lean(1.0))
    assert error[0] == pytest.approx(np.degrees(0.7))
    assert contortion[0] == pytest.approx(0.0, abs=0.1)
    error, contortion = compute_tilts(lean(0.5), lean(0.0))
    assert error[0] == pytest.approx(contortion[0]) == pytest.approx(np.degrees(0.5))
    error, contortion = compute_tilts(lean(-0.4), lean(1.0))
    assert contortion[0] == pytest.approx(np.degrees(0.4))
    assert np.isnan(compute_tilts(lean(0.1), np.full((1, 3), np.nan))[1][0])


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"fallen": True}, "fell"),
        ({"gap_rad": 0.31}, "servo 0.31 rad behind"),
        ({"tilt_deg": 16.0}, "tilt 16°"),
        ({"head_end_cm": 5.2}, "head 5.2 cm at the end"),
        ({"hand_end_cm": 2.3}, "hand 2.3 cm at the end"),
        ({"foot_cm": 2.1}, "feet 2.1 cm"),
        ({"contacts": ["elbow - belly"]}, "touches: elbow - belly"),
        ({"trouble": "the robot moves though it is told to stand"},
         "the robot moves though it is told to stand"),
    ],
)  # fmt: skip
def test_faults_are_named(changes, fault):
    squat = MOTIONS["squat"]
    assert find_faults("rby1", squat, GOOD) == []
    assert find_faults("rby1", squat, {**GOOD, **changes}) == [fault]


def test_what_cannot_be_reached_is_judged_by_its_contortion():
    walk_off = MOTIONS["walk_off_in_stationary"]
    beyond = {**GOOD, "tilt_deg": 40.0, "head_end_cm": 90.0, "hand_end_cm": 90.0}
    assert find_faults("g1", walk_off, beyond) == []
    assert find_faults("g1", walk_off, {**beyond, "contortion_deg": 21.0}) == ["tilt 21°"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["look_up", "nod", "bow_45"])
def test_a_nod_takes_the_head_nowhere_else(name):
    """With each joint of its torso at its own rate RB-Y1's head went 0.2 to 0.4 m off."""
    course = run_motion("rby1", name, "off", 0)
    figures = measure(make_morphology("rby1"), MOTIONS[name], course)
    assert figures["head_max_cm"] < 12
    assert figures["head_end_cm"] < 2
    assert not figures["fallen"]
