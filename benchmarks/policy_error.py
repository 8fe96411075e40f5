"""How near a policy's hands come to their points, from what `lerobot-rollout` recorded.

The points are not in a dataset, as no policy may see them. But an episode's seed decides where they
are, so they are placed once more, and compared with the true poses of the hands (`robot.*`).
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
"""An error is a mean over the last so much before the time that is asked for [s]."""


@dataclass(frozen=True)
class Setting:
    """What was simulated in a session: all that decides where the points are.

    Attributes:
        robot: Name of the morphology.
        task: Name of the task.
        scene: Scene that the robot stood in.
        noise: Preset of the sensors' noise.
        low_level: Low-level policy.
        fps: Rate of the control loop [Hz].
        seed: Seed of the session.
        heights: Heights over the task's usual ones.
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
    """Both palms of some episodes, and the points that they were to be at.

    Attributes:
        setting: What was simulated.
        episodes: Indices of the episodes. Shape (n,).
        palms: Position of the left and the right palm in each frame [m]. Shape (n, frames, 2, 3).
        points: Position of their points [m]. Shape (n, 2, 3).
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
        """Distance of the palms from their points, mean over both and over the last `window_s`.

        Returns:
            One for each episode [m]. Shape (n,).
        """
        return self._compute(self.points, window_s)

    def compute_errors_elsewhere(self, window_s: float = WINDOW_S) -> np.ndarray:
        """The same, from the points of the *other* episodes: mean over all of them.

        Who does not look comes as near to these as to its own.

        Returns:
            One for each episode [m]. Shape (n,).
        """
        n = len(self.points)
        shifted = [self._compute(np.roll(self.points, k, axis=0), window_s) for k in range(1, n)]
        return np.mean(shifted, axis=0)

    def _compute(self, points: np.ndarray, window_s: float) -> np.ndarray:
        last = max(1, round(window_s * self.setting.fps))
        gaps = self.palms[:, -last:] - points[:, None]
        return np.linalg.norm(gaps, axis=-1).mean(axis=(1, 2))


def read_hands(root: Path, at: float) -> Hands:
    """Read the hands of a dataset, up to `at` [s] of each episode.

    Args:
        root: A dataset of a simulated robot of this project, with `robot.*` columns.
        at: Time after the episode's first frame at which it is judged [s].

    Raises:
        BadDataset: If it has no such columns, no facts or no points, or an episode is shorter.
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
    """Let the robot stand where it is, in the same episodes: the policy that does nothing.

    Args:
        setting: What is simulated.
        episodes: Indices of the episodes.
        at: For how long [s].
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
            way = []
            for _ in range(frames):
                way.append([stage.plant.get_site_pose(sites[f"{side}_palm"])[:3] for side in SIDES])
                loop.execute(stage.start, 1 / setting.fps)
                stage.update()
            palms.append(way)
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
    """Least mean distance that hands reach which go to the same places in each episode.

    It is found with hindsight: the places are the points' geometric medians, by Weiszfeld's
    iteration. No policy that does not look can do better on these episodes.

    Args:
        points: Of the left and the right palm [m]. Shape (n, 2, 3).

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
    """By how much one is nearer than another, in the same episodes.

    Attributes:
        mean: Mean of the differences; positive where the first is nearer [m].
        interval: Its 95% bootstrap interval over episodes [m].
        nearer: In how many episodes the first is nearer.
        episodes: Of how many.
    """

    mean: float
    interval: Interval
    nearer: int
    episodes: int


def compute_margin(first: np.ndarray, second: np.ndarray) -> Margin:
    """Compare the errors of two, episode by episode.

    Raises:
        BadValue: If they are not of equally many episodes.
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
    """Seed of an episode, as the robot makes it of its session's seed."""
    return int(np.random.SeedSequence([seed, episode]).generate_state(1)[0])


def _read_setting(source: Source) -> Setting:
    source.check([*(f"robot.{side}_wrist" for side in SIDES), "next.success"])
    robot: dict[str, Any] = source.read_config().get("robot", {})
    facts = read_facts(source.root)
    if not facts or not robot.get("task"):
        raise BadDataset(source.root, "it does not say which task was simulated (meta/xop)")
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
            f"episode {entry.index} ends after {length:.2f} s, and is to be judged at "
            f"{frames / source.fps:.2f} s",
        )


def _make_stage(setting: Setting) -> Stage:
    config = SimulationConfig(scene=setting.scene, noise=setting.noise)
    return Stage(make_morphology(setting.robot), setting.task, config, setting.heights)


def _find_offsets(stage: Stage) -> list[np.ndarray]:
    """Pose of each palm in its wrist's frame, which are one rigid body. Shapes (7,)."""
    model, frames = stage.plant.model, stage.morphology.frames
    palms = find_palms(stage.morphology, model)
    offsets = []
    for side in SIDES:
        wrist, palm = frames[f"{side}_wrist"], palms[f"{side}_palm"]
        if model.site(wrist).bodyid[0] != model.site(palm).bodyid[0]:
            raise BadValue(f"{palm} does not move with {wrist}, so where it was is not known")
        at_wrist, at_palm = (stage.plant.get_site_pose(site) for site in (wrist, palm))
        offsets.append(pose_multiply(pose_inverse(at_wrist), at_palm))
    return offsets


def _get_points(stage: Stage) -> np.ndarray:
    """Where the points are. Shape (2, 3).

    Raises:
        BadValue: If the task has none.
    """
    objects = stage.task.objects
    if not all(f"{side}_point" in objects for side in SIDES):
        raise BadValue(f"task '{stage.task.name}' has no points for the palms to be at")
    return np.array([objects[f"{side}_point"].pose[:3] for side in SIDES])
