"""Films of trials, made from the positions that each trial left behind."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.ndimage import gaussian_filter1d

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.transforms import quat_rotate
from xop_lerobot.evaluation.strip import build_film, write_video
from xop_lerobot.evaluation.trial import Film, TrialSetup, make_stage

WIDTH, HEIGHT = 320, 240
CAMERA = "task"
LOOK_HEIGHT, DISTANCE = 0.75, 2.6
"""Where a camera that follows a robot looks over the ground, and from how far [m]."""
SMOOTHING_S = 0.7
"""Standard deviation of the filter of the way that it follows [s]."""


def load_film(path: Path) -> Film:
    """Read the positions of a trial.

    Raises:
        BadValue: If the file is missing or holds something else.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return Film(
                int(arrays["fps"]), arrays["qpos"], arrays["mocap_pos"], arrays["mocap_quat"]
            )
    except (OSError, KeyError, ValueError) as error:
        raise BadValue(f"'{path}' holds no positions of a trial: {error}") from error


def render_film(
    setup: TrialSetup, seed: int, film: Film, camera: str = CAMERA
) -> Iterator[np.ndarray]:
    """Yield a picture of each position. Shapes (240, 320, 3), uint8.

    Args:
        setup: What was tried; its robot, scene and furniture are built anew.
        seed: Its seed.
        film: Its positions.
        camera: Camera of the scene.

    Raises:
        BadValue: If the scene has changed since.
        RenderingUnavailable: If this machine has no OpenGL.
    """
    stage = make_stage(setup, seed)
    plant = stage.plant
    try:
        data = plant.data
        for name in ("qpos", "mocap_pos", "mocap_quat"):
            there, kept = getattr(data, name).shape, getattr(film, name).shape[1:]
            if there != kept:
                raise BadValue(
                    f"the scene of '{setup.task}' has {name} of shape {there}, the trial was "
                    f"recorded with {kept}. Run it again with --fresh"
                )
        ways = None if _has_walls(plant.model) else _smooth(film.qpos[:, :2], film.fps)
        for index, rows in enumerate(zip(film.qpos, film.mocap_pos, film.mocap_quat, strict=True)):
            data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = rows
            if ways is not None:
                _follow(plant.model, camera, ways[index])
            yield plant.render(camera)
    finally:
        plant.close()


def _has_walls(model: mujoco.MjModel) -> bool:
    """Whether the camera must stay in its room."""
    return any(model.geom(index).name.startswith("wall_") for index in range(model.ngeom))


def _smooth(way: np.ndarray, fps: int) -> np.ndarray:
    """A way without its sway, for a camera to follow. Shape (p, 2)."""
    return gaussian_filter1d(way.astype(float), SMOOTHING_S * fps, axis=0, mode="nearest")


def _follow(model: mujoco.MjModel, camera: str, place: np.ndarray) -> None:
    """Move a camera that stands in the world so that it looks at the robot from near."""
    index = model.camera(camera).id
    back = quat_rotate(model.cam_quat[index], np.array([0.0, 0.0, 1.0]))
    model.cam_pos[index] = np.array([*place, LOOK_HEIGHT]) + DISTANCE * back


def write_film(
    path: Path, record: Mapping[str, Any], setup: TrialSetup, film: Film, camera: str = CAMERA
) -> int:
    """Write the film of a trial, with its method and time, and return the number of pictures."""
    frames = np.stack(list(render_film(setup, record["seed"], film, camera)))
    end = "success" if record["success"] else record["failure"] or "time is up"
    label = f"{setup.method} {setup.variant}".strip()
    name = f"{label}, seed {record['seed']}: {end}"
    return write_video(path, build_film({name: frames}, film.fps), film.fps)
