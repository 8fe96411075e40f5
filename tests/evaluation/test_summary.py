"""Figures and pictures of an episode, on synthetic columns and films."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from xop_lerobot.core.errors import BadShape, BadValue, UnknownName
from xop_lerobot.evaluation import film as films
from xop_lerobot.evaluation import summary
from xop_lerobot.evaluation.metrics import compute_falls, compute_pose_errors

FPS = 25
HEALTH_NAMES = ["plan_age", "solve_time"]
BODY: Any = SimpleNamespace(fall_height=0.4, fall_tilt=math.radians(60))


def make_columns(count: int = 100, engaged_from: int = 20) -> dict[str, np.ndarray]:
    """Make an episode whose head is 0.2 m behind its goal and 0.05 m at the end."""
    standing = np.tile([0.0, 0, 0.75, 1, 0, 0, 0], (count, 1))
    goal = standing.copy()
    goal[:, 0] = 0.2
    goal[-15:, 0] = 0.05
    engaged = np.arange(count) >= engaged_from
    goal[~engaged] = 0.0  # what is not known is 0, and must not count
    health = np.zeros((count, 2))
    health[:, 0] = 99.0
    health[engaged, 1] = np.linspace(0.010, 0.030, engaged.sum())
    return {
        "operator.engaged": engaged[:, None],
        "goal.head": goal,
        "robot.head": standing,
        "robot.base_pose": standing,
        summary.HEALTH: health,
    }


def compute(columns: dict[str, np.ndarray]) -> summary.EpisodeSummary:
    return summary.compute_episode_summary(columns, HEALTH_NAMES, FPS, "g1", BODY)


def test_figures_cover_the_engaged_time_alone() -> None:
    figures = compute(make_columns())
    assert (figures.frames, figures.duration_s, figures.engaged_s) == (100, 4.0, 3.2)
    assert figures.head_error_mean == pytest.approx((65 * 0.2 + 15 * 0.05) / 80)
    assert figures.head_error_end == pytest.approx(0.05)
    assert figures.falls == 0
    assert figures.plan_ms_median == pytest.approx(20.0)
    assert figures.plan_ms_p99 == pytest.approx(np.percentile(np.linspace(10, 30, 80), 99))


def test_error_counts_all_three_axes() -> None:
    pose = np.zeros((2, 7))
    goal = np.array([[1.0, 2, 2, 1, 0, 0, 0], [0, 0, -3, 0, 1, 0, 0]])
    np.testing.assert_allclose(compute_pose_errors(pose, goal)[0], [3, 3])


@pytest.mark.parametrize(("pose", "goal"), [((3, 7), (2, 7)), ((3, 3), (3, 3)), ((3, 7), (3, 6))])
def test_tracks_of_another_shape_are_refused(pose: tuple[int, int], goal: tuple[int, int]) -> None:
    with pytest.raises(BadShape, match=r"must have shape \(3, 7\), got"):
        compute_pose_errors(np.zeros(pose), np.zeros(goal))


def test_falls_count_going_down_not_lying() -> None:
    base = np.tile([0.0, 0, 0.75, 1, 0, 0, 0], (50, 1))
    assert compute_falls(base, 0.4, 1.0) == 0
    base[10:20, 2] = 0.2
    assert compute_falls(base, 0.4, 1.0) == 1
    base[30:, 3:] = [math.cos(0.6), math.sin(0.6), 0, 0]  # tilted by 1.2 rad
    assert compute_falls(base, 0.4, 1.0) == 2
    assert compute_falls(base, 0.4, 1.3) == 1
    base[:, 3:] = [math.cos(0.6), 0, 0, math.sin(0.6)]  # turned about the vertical is no tilt
    assert compute_falls(base[:10], 0.4, 1.0) == 0


def test_a_robot_that_lies_from_the_start_has_fallen() -> None:
    base = np.tile([0.0, 0, 0.1, 1, 0, 0, 0], (5, 1))
    assert compute_falls(base, 0.4, 1.0) == 1


def test_an_episode_without_engagement_is_an_error() -> None:
    columns = make_columns()
    columns["operator.engaged"][:] = False
    with pytest.raises(BadValue, match=r"g1: the operator never engaged in 4\.0 s"):
        compute(columns)


def test_a_missing_column_lists_what_there_is() -> None:
    columns = make_columns()
    del columns["goal.head"]
    with pytest.raises(UnknownName, match=r"unknown column 'goal.head'. Known: operator.engaged, "):
        compute(columns)
    with pytest.raises(UnknownName, match="unknown health figure 'solve_time'. Known: age"):
        summary.compute_episode_summary(make_columns(), ["age"], FPS, "g1", BODY)


def test_an_episode_that_never_planned_takes_no_time() -> None:
    columns = make_columns()
    columns[summary.HEALTH][:] = 0
    assert compute(columns).plan_ms_p99 == 0.0


def test_the_table_is_aligned_and_has_units() -> None:
    lines = summary.format_summaries([compute(make_columns())] * 2).splitlines()
    assert len(lines) == 4
    assert len({len(line) for line in lines}) == 1
    assert "duration [s]" in lines[0] and "plan p99 [ms]" in lines[0]
    assert lines[2].split() == ["g1", "100", "4.0", "3.2", "0.172", "0.050", "0", "20.0", "29.8"]


def make_film(count: int, colour: tuple[int, int, int], height: int = 48) -> np.ndarray:
    film = np.zeros((count, height, 64, 3), np.uint8)
    film[:] = colour
    film[:, :, :, 1] = np.linspace(0, 250, count).astype(np.uint8)[:, None, None]
    return film


def test_moments_run_from_the_first_to_the_last() -> None:
    assert films.choose_moments(100, 8).tolist() == [0, 14, 28, 42, 57, 71, 85, 99]
    assert films.choose_moments(3, 8).tolist() == [0, 1, 2]
    with pytest.raises(BadValue, match="no frame"):
        films.choose_moments(0)


def test_a_strip_shows_every_camera_at_every_moment(tmp_path: Path) -> None:
    cameras = {"head": make_film(50, (250, 0, 0)), "scene": make_film(50, (0, 0, 250))}
    path = tmp_path / "new" / "strip.png"
    picture = films.write_strip(path, cameras, FPS, number=4)
    row = 48 + films.LABEL_HEIGHT
    assert picture.shape == (2 * row + films.GAP, 4 * 64 + 3 * films.GAP, 3)
    np.testing.assert_array_equal(np.asarray(Image.open(path)), picture)
    for column, index in enumerate(films.choose_moments(50, 4)):
        x = column * (64 + films.GAP) + 5
        green = cameras["head"][index, 0, 0, 1]
        assert picture[row - 5, x].tolist() == [250, green, 0]
        assert picture[2 * row, x].tolist() == [0, green, 250]
    assert (picture[: films.LABEL_HEIGHT] < 128).any(), "no text over the first row"


def test_films_that_do_not_belong_together_are_refused() -> None:
    with pytest.raises(BadShape, match=r"camera 'scene' must have shape \(5, 'height'"):
        films.build_strip({"head": make_film(5, (0, 0, 0)), "scene": make_film(4, (0, 0, 0))}, FPS)
    with pytest.raises(BadValue, match="there is no camera to show"):
        films.build_strip({}, FPS)


def make_dataset(root: Path, lengths: list[int]) -> Any:
    """Make what `read_camera` and `read_columns` take of a dataset: one film, many episodes."""
    key = "observation.images.head"
    film = root / "film.mp4"
    films.write_video(film, make_film(sum(lengths), (0, 0, 0)), FPS)
    begins = np.cumsum([0, *lengths]) / FPS
    episodes = [
        {"length": length, f"videos/{key}/from_timestamp": begin}
        for length, begin in zip(lengths, begins, strict=False)
    ]
    meta = SimpleNamespace(
        video_keys=[key],
        fps=FPS,
        episodes=episodes,
        total_episodes=len(lengths),
        get_video_file_path=lambda episode, camera: Path("film.mp4"),
    )
    return SimpleNamespace(meta=meta, root=root)


def test_a_film_is_read_back_by_episode(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path, [10, 15])
    levels = make_film(25, (0, 0, 0))[:, 0, 0, 1].astype(int)
    for episode, expected in ((0, levels[:10]), (1, levels[10:])):
        frames = films.read_camera(dataset, "head", episode)
        assert frames.shape == (len(expected), 48, 64, 3) and frames.dtype == np.uint8
        assert np.abs(frames[:, 24, 32, 1].astype(int) - expected).max() < 12  # lossy colour
        assert (np.diff(frames[:, 24, 32, 1].astype(int)) > 0).all(), "frames out of order"


def test_an_unknown_camera_and_a_short_film_are_errors(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path, [10])
    with pytest.raises(UnknownName, match="unknown camera 'rear'. Known: head"):
        films.read_camera(dataset, "rear")
    dataset.meta.episodes[0]["length"] = 12
    with pytest.raises(BadValue, match="camera 'head' has 10 of the 12 frames"):
        films.read_camera(dataset, "head")


def test_an_odd_sized_film_is_written_whole(tmp_path: Path) -> None:
    cameras = {"head": make_film(30, (9, 0, 9), height=47), "scene": make_film(30, (0, 0, 0))}
    path = tmp_path / "film.mp4"
    assert films.write_video(path, films.build_film(cameras, FPS), FPS) == 30
    with av.open(str(path)) as film:
        stream = film.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.average_rate == FPS
        assert len(list(film.decode(video=0))) == 30
    gif = tmp_path / "film.gif"
    assert films.write_gif(gif, films.build_film(cameras, FPS), FPS, every=5) == 6
    with Image.open(gif) as moving:
        assert getattr(moving, "n_frames", 1) == 6
        assert moving.info["duration"] == 200
    with pytest.raises(BadValue, match="there is no frame to write"):
        films.write_video(tmp_path / "none.mp4", [], FPS)


def test_columns_of_a_real_dataset_are_read_by_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features = {
        "action": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
        "operator.engaged": {"dtype": "bool", "shape": (1,), "names": ["engaged"]},
        "goal.head": {"dtype": "float32", "shape": (7,), "names": list("abcdefg")},
    }
    written = LeRobotDataset.create(
        "local/x", FPS, features, root=tmp_path / "data", use_videos=False
    )
    for episode, length in enumerate((3, 5)):
        for index in range(length):
            written.add_frame(
                {
                    "action": np.zeros(2, np.float32),
                    "operator.engaged": np.array([index > 1]),
                    "goal.head": np.full(7, episode * 10 + index, np.float32),
                    "task": "x",
                }
            )
        written.save_episode()
    written.finalize()
    dataset = LeRobotDataset("local/x", root=tmp_path / "data")
    columns = summary.read_columns(dataset, 1)
    assert columns["goal.head"].shape == (5, 7)
    np.testing.assert_array_equal(columns["goal.head"][:, 0], [10, 11, 12, 13, 14])
    assert columns["operator.engaged"].reshape(-1).tolist() == [False, False, True, True, True]
    with pytest.raises(BadValue, match="episode 2 is not in .* which has 2 episodes"):
        summary.read_columns(dataset, 2)
