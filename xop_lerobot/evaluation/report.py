"""Page of a study: tables beside the paper's, plots with intervals, one video per cell.

A single self-contained HTML file with images and videos embedded. The videos are also written
beside it.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.ndimage import gaussian_filter1d

from xop_lerobot.core.errors import BadValue, XopError
from xop_lerobot.core.page import FOOT, embed, escape, make_head
from xop_lerobot.core.transforms import quat_rotate
from xop_lerobot.evaluation.bench_report import describe_machine
from xop_lerobot.evaluation.film import build_film, write_video
from xop_lerobot.evaluation.methods import get_method
from xop_lerobot.evaluation.plots import (
    find_values,
    plot_errors,
    plot_means,
    plot_rates,
    plot_ways,
)
from xop_lerobot.evaluation.published import PUBLISHED_TRIALS, PublishedRow, find_published
from xop_lerobot.evaluation.study import Cell, Results, compute_key
from xop_lerobot.evaluation.summary import Interval, compute_mean_interval, compute_rate_interval
from xop_lerobot.evaluation.trial import Film, TrialSetup, make_stage
from xop_lerobot.plant.rendering import RenderingUnavailable

WIDTH, HEIGHT = 320, 240
"""Size of the videos [px]."""
CAMERA = "task"
LOOK_HEIGHT, DISTANCE = 0.75, 2.6
"""Height above the ground of a following camera's target, and its distance [m]."""
SMOOTHING_S = 0.7
"""Standard deviation of the Gaussian filter on the path that the camera follows [s]."""


def load_film(path: Path) -> Film:
    """Read the recorded positions of a trial.

    Raises:
        BadValue: If the file is missing or malformed.
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
    """Yield an image per recorded position. Shapes (240, 320, 3), uint8.

    Args:
        setup: Setup of the trial, from which robot, scene and furniture are rebuilt.
        seed: Seed of the trial.
        film: Recorded positions.
        camera: Camera of the scene.

    Raises:
        BadValue: If the scene has changed since the recording.
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
        path = None if _has_walls(plant.model) else _smooth(film.qpos[:, :2], film.fps)
        for index, rows in enumerate(zip(film.qpos, film.mocap_pos, film.mocap_quat, strict=True)):
            data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = rows
            if path is not None:
                _follow(plant.model, camera, path[index])
            yield plant.render(camera)
    finally:
        plant.close()


def _has_walls(model: mujoco.MjModel) -> bool:
    """Whether the scene has walls, which would hide the robot from a following camera."""
    return any(model.geom(index).name.startswith("wall_") for index in range(model.ngeom))


def _smooth(path: np.ndarray, fps: int) -> np.ndarray:
    """Smoothed path for a camera to follow. Shape (p, 2)."""
    return gaussian_filter1d(path.astype(float), SMOOTHING_S * fps, axis=0, mode="nearest")


def _follow(model: mujoco.MjModel, camera: str, place: np.ndarray) -> None:
    """Move a fixed camera to look at the robot from nearby, keeping its orientation."""
    index = model.camera(camera).id
    back = quat_rotate(model.cam_quat[index], np.array([0.0, 0.0, 1.0]))
    model.cam_pos[index] = np.array([*place, LOOK_HEIGHT]) + DISTANCE * back


def write_film(
    path: Path, record: Mapping[str, Any], setup: TrialSetup, film: Film, camera: str = CAMERA
) -> int:
    """Write a trial's video, captioned with method and time; return the number of frames."""
    frames = np.stack(list(render_film(setup, record["seed"], film, camera)))
    end = "success" if record["success"] else record["failure"] or "time is up"
    label = f"{setup.method} {setup.variant}".strip()
    name = f"{label}, seed {record['seed']}: {end}"
    return write_video(path, build_film({name: frames}, film.fps), film.fps)


logger = logging.getLogger(__name__)

PAGE = "index.html"
_STYLE = """
tr.theirs td { color: #7a5c1e; background: #fdf8ec; }
tr.absent td { color: #999; }
"""
_EXPLANATION = """
<p class="note">Ours: a simulated person in the headset, the same one with the same seed for every
method; sensors with noise; success judged by the physics. Counts are out of all trials, with
Wilson's 95% interval; means have their standard deviation and, small, the bootstrap 95% interval of
the mean. CT is over successful trials; <i>CT, any</i> also over those that succeed only after the
task's time limit, with their number. The paper names no limit. ABP: mean of |torque × velocity|
over the control steps in standing mode and over legs and waist; in brackets with its sign. Tilt and
jerk: of the carrying palm until 10 cm from the opening. Every metric is defined in
docs/results/evaluation.md.</p>
<p class="note"><b>Rows in brown are the paper's own (10 trials, human operators, a real headset;
Tables II to IV).</b> Its rooms, points and people are not ours: compare methods within a table,
not rows across.</p>
"""


def write_report(
    folder: Path,
    cells: Sequence[Cell],
    found: Sequence[Sequence[Mapping[str, Any]]],
    rows: Sequence[Mapping[str, Any]],
    results: Results,
    videos: int = 1,
) -> Path:
    """Write the page of a study and return its path.

    Args:
        folder: Output folder.
        cells: The study.
        found: Trials of each cell.
        rows: Table row of each cell.
        results: Store with the recorded positions.
        videos: Videos per cell: the first trial, then failures before successes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    parts = [_make_head(cells, found)]
    groups: dict[tuple[str, str], list[int]] = {}
    for index, cell in enumerate(cells):
        groups.setdefault((cell.setup.robot, cell.setup.place), []).append(index)
    for (robot, place), members in groups.items():
        chosen = [cells[i] for i in members]
        trials = [found[i] for i in members]
        parts.append(f"<h2>{escape(f'{robot}: {place}')}</h2>")
        # At other heights than the task's own no row of the paper matches `place`.
        parts.append(_make_table(chosen, trials, [rows[i] for i in members], robot, place))
        parts += _make_plots(folder, re.sub(r"[^\w.-]+", "-", f"{robot}-{place}"), chosen, trials)
        parts += _make_films(folder, chosen, trials, results, videos)
    page = folder / PAGE
    body = "\n".join(parts)
    page.write_text(make_head("Simulation study", _STYLE) + body + FOOT, encoding="utf-8")
    table = json.dumps(list(rows), indent=1, allow_nan=False)
    (folder / "table.json").write_text(table + "\n", encoding="utf-8")
    return page


def _make_head(cells: Sequence[Cell], found: Sequence[Sequence[Mapping[str, Any]]]) -> str:
    count = sum(map(len, found))
    wanted = sum(cell.trials for cell in cells if not cell.absence)
    sim = sum(trial["sim_s"] for trials in found for trial in trials)
    wall = sum(trial["wall_s"] for trials in found for trial in trials)
    codes = sorted({trial["code"] for trials in found for trial in trials})
    machine = ", ".join(f"{name} {value}" for name, value in describe_machine().items())
    pace = f", {sim / wall:.2f} of real time in each process" if wall else ""
    return (
        "<h1>Simulation study</h1>"
        f"<p>{count} of {wanted} trials; {sim / 60:.0f} min simulated{pace}. "
        f"{escape(machine)}. Code version: {escape(', '.join(codes) or 'none')}.</p>" + _EXPLANATION
    )


def label_cell(cell: Cell, cells: Iterable[Cell]) -> str:
    """Method and variant; with the low-level policy if the study has several for it."""
    setup = cell.setup
    label = f"{setup.method} {setup.variant}".strip()
    same = {
        each.setup.low_level
        for each in cells
        if (each.setup.method, each.setup.variant) == (setup.method, setup.variant)
    }
    return f"{label} ({setup.low_level})" if len(same) > 1 else label


_COLUMNS = ("success", "pickup", "collision", "falls", "CT [s]", "CT, any [s]", "ABP [W]",
            "tilt [rad]", "jerk [m/s³]", "head, hands error [cm]", "solve p99 [ms]")  # fmt: skip
_NOTHING = "–"


def _make_table(
    cells: Sequence[Cell],
    found: Sequence[Sequence[Mapping[str, Any]]],
    rows: Sequence[Mapping[str, Any]],
    robot: str,
    task: str,
) -> str:
    """Table of one task of one robot, without empty columns."""
    lines: list[tuple[str, str, list[str]]] = []  # class, title and fields of each row
    for cell, trials, row in zip(cells, found, rows, strict=True):
        title = f"<b>{escape(label_cell(cell, cells))}</b><br><small>"
        title += f"{escape(get_method(cell.setup.method).title)}</small>"
        if trials:
            lines.append(("ours", title, _make_fields(trials, row)))
        else:
            lines.append(("absent", title, [escape(row["note"] or "not run yet")]))
    for each in find_published(robot, task):
        title = f"{each.method} {each.variant}".strip() + f" ({each.low_level})"
        title = f"{escape(title)}<br><small>the paper, {each.setting}</small>"
        lines.append(("theirs", title, _make_published_fields(each)))
    whole = [fields for _, _, fields in lines if len(fields) == len(_COLUMNS)]
    kept = [i for i in range(len(_COLUMNS)) if any(fields[i] != _NOTHING for fields in whole)]
    head = "".join(f"<th>{escape(name)}</th>" for name in ("method", *(_COLUMNS[i] for i in kept)))
    body = []
    for kind, title, fields in lines:
        if len(fields) == 1:
            inside = f'<td colspan="{max(len(kept), 1)}">{fields[0]}</td>'
        else:
            inside = "".join(f"<td>{fields[i]}</td>" for i in kept)
        body.append(f'<tr class="{kind}"><td>{title}</td>{inside}</tr>')
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"


def _make_fields(trials: Sequence[Mapping[str, Any]], row: Mapping[str, Any]) -> list[str]:
    """Fields of one of our rows, in column order."""
    count = len(trials)
    has_pickup = row["task"] == "box_pick_and_place"
    fields = [
        _NOTHING if name == "pickup" and not has_pickup else _format_count(row[name], count)
        for name in ("success", "pickup", "collision", "falls")
    ]
    for name, prefix, digits in (
        ("completion_s", "ct", 1), ("abp", "abp", 2), ("tilt", "tilt", 3), ("jerk", "jerk", 0)
    ):  # fmt: skip
        values = find_values(trials, name)
        field = _format_mean(row[f"{prefix}_mean"], row[f"{prefix}_std"], values, digits)
        if name == "abp" and row["abp_signed_mean"] is not None:
            field += f"<br><small>({row['abp_signed_mean']:+.2f} signed)</small>"
        fields.append(field)
        if name == "completion_s":
            fields.append(_format_any(trials, row))
    errors = (row["head_error_mean"], row["hands_error_mean"])
    fields.append(", ".join(_NOTHING if e is None else f"{e * 100:.1f}" for e in errors))
    p99 = row["plan_p99_ms_mean"]
    fields.append(_NOTHING if p99 is None else f"{p99:.0f}")
    return fields


def _make_published_fields(row: PublishedRow) -> list[str]:
    """Fields of one of the paper's rows, in column order."""
    fields = [
        _NOTHING if count is None else f"{count}/{PUBLISHED_TRIALS}"
        for count in (row.success, row.pickup, row.collision, None)
    ]
    spreads = ((row.ct, 1), (None, 1), (row.abp, 2), (row.tilt, 2), (row.jerk, 0))
    for spread, digits in spreads:
        text = _NOTHING if spread is None else f"{spread[0]:.{digits}f} ± {spread[1]:.{digits}f}"
        fields.append(text)
    return [*fields, _NOTHING, _NOTHING]


def _format_count(count: int, trials: int) -> str:
    low, high = compute_rate_interval(count, trials)
    return f"{count}/{trials}<br><small>{low:.0%} to {high:.0%}</small>"


def _format_mean(
    mean: float | None, std: float | None, values: Sequence[float], digits: int
) -> str:
    if mean is None or std is None:
        return _NOTHING
    interval: Interval = compute_mean_interval(values)
    return (
        f"{mean:.{digits}f} ± {std:.{digits}f}<br>"
        f"<small>{interval.low:.{digits}f} to {interval.high:.{digits}f}</small>"
    )


def _format_any(trials: Sequence[Mapping[str, Any]], row: Mapping[str, Any]) -> str:
    """Completion time of all trials that ever succeed, and how many do."""
    if row["completed"] is None:
        return _NOTHING
    ever = [trial["completion_s"] for trial in trials if trial["completion_s"] is not None]
    field = _format_mean(row["ct_any_mean"], row["ct_any_std"], ever, 1)
    return f"{field}<br><small>{row['completed']}/{row['trials']}</small>"


def _make_plots(
    folder: Path, name: str, cells: Sequence[Cell], found: Sequence[Sequence[Mapping[str, Any]]]
) -> list[str]:
    groups = {
        label_cell(cell, cells): (cell.setup.method, trials)
        for cell, trials in zip(cells, found, strict=True)
        if trials
    }
    if not groups:
        return []
    parts = []
    for kind, title, picture in (
        ("rates", "Rates, with 95% intervals", plot_rates(groups)),
        ("means", "Every trial, mean and its 95% interval", plot_means(groups)),
        (
            "ways",
            "Path of the head from above; a cross marks the end of a failure",
            plot_ways(groups),
        ),
        ("errors", "Errors over time, first trial of each", plot_errors(groups)),
    ):
        if picture is not None:
            (folder / f"{name}-{kind}.png").write_bytes(picture)
            parts.append(f"<h3>{title}</h3>")
            parts.append(f'<img alt="{title}" src="{embed(picture, "image/png")}">')
    return parts


def choose_trials(trials: Sequence[Mapping[str, Any]], number: int) -> list[Mapping[str, Any]]:
    """Choose the first trial, then failures, then successes, in order of seeds."""
    rest = sorted(trials[1:], key=lambda trial: (trial["success"], trial["seed"]))
    return [*trials[:1], *rest][:number]


def _make_films(
    folder: Path,
    cells: Sequence[Cell],
    found: Sequence[Sequence[Mapping[str, Any]]],
    results: Results,
    number: int,
) -> list[str]:
    parts = []
    for cell, trials in zip(cells, found, strict=True):
        for record in choose_trials(trials, number):
            key = compute_key(cell.setup, record["seed"])
            path = folder / f"{key}.mp4"
            try:
                write_film(path, record, cell.setup, load_film(results.film_path(key)))
            except RenderingUnavailable as error:
                return [f'<p class="note">No videos: {escape(error)}</p>']
            except XopError as error:
                logger.warning("no video of %s: %s", key, error)
                continue
            end = "success" if record["success"] else record["failure"] or "time is up"
            text = escape(f"{label_cell(cell, cells)}, seed {record['seed']}: {end}")
            parts.append(
                '<figure><video controls muted loop width="320" '
                f'src="{embed(path.read_bytes(), "video/mp4")}"></video>'
                f"<figcaption>{text}</figcaption></figure>"
            )
    return ["<h3>Videos</h3>", *parts] if parts else []
