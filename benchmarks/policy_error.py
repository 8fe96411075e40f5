"""Distance of a policy's palms from their target points, from datasets of `lerobot-rollout`.

A dataset does not contain the points, as no policy may see them. They are placed again from the
episodes' seeds and compared with the true poses of the hands (`robot.*`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xop_lerobot.core.errors import BadDataset, BadValue
from xop_lerobot.core.transforms import pose_inverse, pose_multiply
from xop_lerobot.curate.source import EpisodeEntry, Source
from xop_lerobot.evaluation.summary import Interval, compute_mean_interval
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.recording.facts import read_facts
from xop_lerobot.tasks.layout import find_palms
from xop_lerobot.tasks.stage import Stage

if TYPE_CHECKING:
    from collections.abc import Sequence

SIDES = ("left", "right")
WINDOW_S = 0.5
"""Window before the evaluated time over which an error is averaged [s]."""


@dataclass(frozen=True)
class Setting:
    """Simulation settings of a session, which determine where the points are.

    Attributes:
        robot: Name of the morphology.
        task: Name of the task.
        scene: Name of the scene.
        noise: Preset of the sensor noise.
        low_level: Low-level policy.
        fps: Rate of the control loop [Hz].
        seed: Seed of the session.
        heights: Override of the task's heights, as in the robot's `task_heights`; empty for none.
    """

    robot: str
    task: str
    scene: str
    noise: str
    low_level: str
    fps: int
    seed: int
    heights: str = ""


@dataclass(frozen=True)
class Hands:
    """Palm positions over several episodes, and their target points, in the world frame.

    Attributes:
        setting: What was simulated.
        episodes: Indices of the episodes. Shape (n,).
        palms: Positions of the left and the right palm in each frame [m]. Shape (n, frames, 2, 3).
        points: Positions of their target points [m]. Shape (n, 2, 3).
        success: Whether the task was accomplished within these frames. Shape (n,).
        fallen: Whether the robot fell in the episode. Shape (n,).
    """

    setting: Setting
    episodes: np.ndarray
    palms: np.ndarray
    points: np.ndarray
    success: np.ndarray
    fallen: np.ndarray

    def compute_errors(self, window_s: float = WINDOW_S) -> np.ndarray:
        """Compute the palms' distances from their points, mean over both and the last `window_s`.

        Returns:
            Distance per episode [m]. Shape (n,).
        """
        return self._compute(self.points, window_s)

    def compute_errors_elsewhere(self, window_s: float = WINDOW_S) -> np.ndarray:
        """Compute the mean distance from the points of all *other* episodes.

        A policy that ignores its images comes as near to these as to its own.

        Returns:
            Distance per episode [m]. Shape (n,).
        """
        n = len(self.points)
        shifted = [self._compute(np.roll(self.points, k, axis=0), window_s) for k in range(1, n)]
        return np.mean(shifted, axis=0)

    def _compute(self, points: np.ndarray, window_s: float) -> np.ndarray:
        last = max(1, round(window_s * self.setting.fps))
        gaps = self.palms[:, -last:] - points[:, None]
        return np.linalg.norm(gaps, axis=-1).mean(axis=(1, 2))


def read_hands(root: Path, at: float) -> Hands:
    """Read the palms of a dataset, up to `at` [s] of each episode.

    Args:
        root: A dataset of a simulated robot of this project, with `robot.*` columns.
        at: Time after an episode's first frame at which it is evaluated [s].

    Raises:
        BadDataset: If the dataset has no such columns or no facts, or an episode is shorter.
        BadValue: If the task has no points.
    """
    with Source(root) as source:
        setting = _read_setting(source)
        facts = {row["episode_index"]: row for row in read_facts(root)}
        frames = max(1, round(at * setting.fps))
        columns = [f"robot.{side}_wrist" for side in SIDES]
        stage = _make_stage(setting)
        try:
            offsets = _find_offsets(stage)
            indices, palms, points, success, fallen = [], [], [], [], []
            for entry in source.episodes:
                _check_length(source, entry, frames)
                rows = source.read(entry, [*columns, "next.success"])
                wrists = [rows[column][:frames].astype(float) for column in columns]
                palms.append(
                    [
                        pose_multiply(poses, offset)[:, :3]
                        for poses, offset in zip(wrists, offsets, strict=True)
                    ]
                )
                stage.reset(make_episode_seed(setting.seed, entry.index))
                points.append(_get_points(stage))
                indices.append(entry.index)
                success.append(bool(rows["next.success"][:frames].any()))
                fallen.append(bool(facts.get(entry.index, {}).get("fallen", False)))
        finally:
            stage.close()
    return Hands(
        setting,
        np.array(indices),
        np.swapaxes(np.array(palms), 1, 2),
        np.array(points),
        np.array(success),
        np.array(fallen),
    )


def stand_still(setting: Setting, episodes: Sequence[int], at: float) -> Hands:
    """Simulate the same episodes with a robot that holds its start posture: the null policy.

    Args:
        setting: What is simulated.
        episodes: Indices of the episodes.
        at: Simulated time [s].
    """
    stage = _make_stage(setting)
    sites = find_palms(stage.morphology, stage.plant.model)
    loop = PolicyLoop(stage.morphology, stage.plant, make_policy(setting.low_level))
    frames = max(1, round(at * setting.fps))
    palms, points, success, fallen = [], [], [], []
    try:
        for index in episodes:
            seed = make_episode_seed(setting.seed, index)
            loop.reset(seed, start=stage.start)
            stage.reset(seed)
            points.append(_get_points(stage))
            path = []
            for _ in range(frames):
                place = [stage.plant.get_site_pose(sites[f"{side}_palm"])[:3] for side in SIDES]
                path.append(place)
                loop.execute(stage.start, 1 / setting.fps)
                stage.update()
            palms.append(path)
            success.append(stage.status.success)
            fallen.append(loop.state.fallen)
    finally:
        loop.close()
        stage.close()
    return Hands(
        setting,
        np.array(list(episodes)),
        np.array(palms),
        np.array(points),
        np.array(success),
        np.array(fallen),
    )


def compute_best_blind_error(points: np.ndarray) -> float:
    """Compute the least mean distance of hands that go to the same two places in each episode.

    The places are found in hindsight, as the points' geometric medians, by Weiszfeld's iteration.
    No policy that ignores its images can do better on these episodes.

    Args:
        points: Target points of the left and the right palm [m]. Shape (n, 2, 3).

    Returns:
        The distance, mean over both hands and all episodes [m].
    """
    place = points.mean(axis=0)
    for _ in range(200):
        weight = 1 / np.maximum(np.linalg.norm(points - place, axis=-1, keepdims=True), 1e-9)
        place = (weight * points).sum(axis=0) / weight.sum(axis=0)
    return float(np.linalg.norm(points - place, axis=-1).mean())


@dataclass(frozen=True)
class Margin:
    """Paired difference between the errors of two policies in the same episodes.

    Attributes:
        mean: Mean of the differences; positive if the first is nearer [m].
        interval: 95% bootstrap interval of the mean over episodes [m].
        nearer: Number of episodes in which the first is nearer.
        episodes: Number of episodes.
    """

    mean: float
    interval: Interval
    nearer: int
    episodes: int


def compute_margin(first: np.ndarray, second: np.ndarray) -> Margin:
    """Compare the errors of two policies, episode by episode.

    Args:
        first: Errors of the first [m]. Shape (n,).
        second: Errors of the second [m]. Shape (n,).

    Raises:
        BadValue: If the numbers of episodes differ.
    """
    if first.shape != second.shape:
        raise BadValue(f"errors of {first.size} and of {second.size} episodes cannot be compared")
    gained = second - first
    return Margin(
        float(gained.mean()),
        compute_mean_interval(gained.tolist()),
        int((gained > 0).sum()),
        len(gained),
    )


def make_episode_seed(seed: int, episode: int) -> int:
    """Derive an episode's seed from its session's, as the robot does."""
    return int(np.random.SeedSequence([seed, episode]).generate_state(1)[0])


def _read_setting(source: Source) -> Setting:
    source.check([*(f"robot.{side}_wrist" for side in SIDES), "next.success"])
    robot: dict[str, Any] = source.read_config().get("robot", {})
    facts = read_facts(source.root)
    if not facts or not robot.get("task"):
        raise BadDataset(source.root, "meta/xop does not name the simulated task")
    sensors = robot.get("sim", {})
    return Setting(
        robot=str(robot["type"]).removeprefix("xop_"),
        task=str(robot["task"]),
        scene=str(facts[0]["scene"]),
        noise=str(sensors.get("noise", "off")),
        low_level=str(facts[0]["low_level"]),
        fps=int(source.fps),
        seed=int(facts[0]["seed"]),
        heights=str(robot.get("task_heights", "")),
    )


def _check_length(source: Source, entry: EpisodeEntry, frames: int) -> None:
    if entry.length < frames:
        length = entry.length / source.fps
        raise BadDataset(
            source.root,
            f"episode {entry.index} ends after {length:.2f} s, but is to be judged at "
            f"{frames / source.fps:.2f} s",
        )


def _make_stage(setting: Setting) -> Stage:
    config = SimulationConfig(scene=setting.scene, noise=setting.noise)
    return Stage(make_morphology(setting.robot), setting.task, config, setting.heights)


def _find_offsets(stage: Stage) -> list[np.ndarray]:
    """Return the pose of each palm in its wrist's frame. Shapes (7,).

    Raises:
        BadValue: If a palm and its wrist are not on one rigid body.
    """
    model, frames = stage.plant.model, stage.morphology.frames
    palms = find_palms(stage.morphology, model)
    offsets = []
    for side in SIDES:
        wrist, palm = frames[f"{side}_wrist"], palms[f"{side}_palm"]
        if model.site(wrist).bodyid[0] != model.site(palm).bodyid[0]:
            raise BadValue(f"{palm} is not fixed to {wrist}, so its recorded pose is unknown")
        at_wrist, at_palm = (stage.plant.get_site_pose(site) for site in (wrist, palm))
        offsets.append(pose_multiply(pose_inverse(at_wrist), at_palm))
    return offsets


def _get_points(stage: Stage) -> np.ndarray:
    """Return the positions of the target points in the world [m]. Shape (2, 3).

    Raises:
        BadValue: If the task has none.
    """
    objects = stage.task.objects
    if not all(f"{side}_point" in objects for side in SIDES):
        raise BadValue(f"task '{stage.task.name}' has no target points for the palms")
    return np.array([objects[f"{side}_point"].pose[:3] for side in SIDES])
