"""The section of one episode in a report: its figures, pictures and timelines."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from xop_lerobot.core.errors import BadDataset, XopError
from xop_lerobot.core.page import dump_script, embed, escape
from xop_lerobot.curate.figures import FIGURES
from xop_lerobot.curate.measures import Episode
from xop_lerobot.curate.source import Source
from xop_lerobot.curate.stills import list_cameras, read_stills
from xop_lerobot.curate.survey import Finding
from xop_lerobot.curate.tables import format_value
from xop_lerobot.curate.timeline import PARTS, Band, Panel, Part, describe_changes
from xop_lerobot.curate.traces import encode, thin

CHIPS = (
    "duration", "tracking_p95", "tracking_angle_p95", "command_roughness", "gap_time",
    "plan_age_p95", "idle_time",
)  # fmt: skip
"""Numbers beside the heading of an episode."""
_LONGEST_FACT = 4000
"""Characters of a fact that are shown."""


@dataclass(frozen=True)
class Limits:
    """How much of an episode is shown.

    Attributes:
        pictures: Pictures of each camera.
        width: Width of a picture [pixel].
        points: Points of a curve.
    """

    pictures: int
    width: int
    points: int


def make_section(source: Source, finding: Finding, limits: Limits) -> tuple[str, list[str]]:
    """Make the section of an episode.

    Returns:
        The section, and what could not be shown beyond what the finding says.
    """
    problems: list[str] = []
    strips = _make_strips(source, finding, limits, problems)
    timeline = _make_timeline(source, finding, limits, problems)
    problems = [each for each in dict.fromkeys(problems) if each not in finding.problems]
    index = finding.entry.index
    parts = [
        f'<section class="episode" id="episode-{index}" data-episode="{index}">',
        _make_heading(finding),
        *(f'<p class="problem">{escape(each)}</p>' for each in (*finding.problems, *problems)),
        strips,
        f'<div class="timeline"></div><script type="application/json">{dump_script(timeline)}'
        "</script>",
        _make_facts(finding),
        "</section>\n",
    ]
    return "\n".join(parts), problems


def _make_heading(finding: Finding) -> str:
    figures, entry = finding.figures, finding.entry
    marks = []
    for name, good, bad in (("success", "success", "no success"), ("fall", "", "fall"),
                            ("collision", "", "collision"), ("trouble", "", "trouble"),
                            ("late", "", "late")):  # fmt: skip
        value = figures.get(name)
        text = good if value else bad if value is False and name == "success" else ""
        text = bad if value and name != "success" else text
        if text:
            kind = "good" if text == good else "bad"
            marks.append(f'<span class="mark {kind}">{escape(text)}</span>')
    chips = [
        f"<span><small>{escape(name.replace('_', ' '))}</small> "
        f"{escape(format_value(name, figures[name]))}{escape(_unit(name))}</span>"
        for name in CHIPS
        if figures.get(name) is not None
    ]
    task = " | ".join(entry.tasks)
    return (
        f"<h3>Episode {entry.index} {''.join(marks)} <small>{escape(task)}</small>"
        '<a class="up" href="#episodes">table</a></h3>'
        f'<p class="chips">{"".join(chips)}</p>'
    )


def _unit(name: str) -> str:
    return f" {FIGURES[name].unit}" if FIGURES[name].unit else ""


# Pictures.


def _make_strips(source: Source, finding: Finding, limits: Limits, problems: list[str]) -> str:
    strips = []
    for camera in list_cameras(source):
        try:
            stills = read_stills(source, finding.entry, camera, limits.pictures, limits.width)
        except BadDataset as error:
            problems.append(error.fault)
            continue
        name = escape(camera.rpartition(".")[2])
        cells = [
            f'<figure data-t="{still.frame / source.fps:.3f}">'
            f'<img alt="{name}, {still.frame / source.fps:.1f} s" '
            f'src="{embed(still.jpeg, "image/jpeg")}">'
            f"<figcaption>{name} {still.frame / source.fps:.1f} s</figcaption></figure>"
            for still in stills
        ]
        if cells:
            strips.append(f'<div class="strip">{"".join(cells)}</div>')
    return "\n".join(strips)


# Timelines.


def _make_timeline(
    source: Source, finding: Finding, limits: Limits, problems: list[str]
) -> dict[str, Any]:
    entry = finding.entry
    wanted = {part: tuple(part.find_columns(source.features, entry)) for part in PARTS}
    rows: dict[str, np.ndarray] | None = None
    names = tuple(dict.fromkeys(name for columns in wanted.values() for name in columns))
    try:
        rows = source.read(entry, names) if names else {}
    except BadDataset:
        rows = None  # if one column is bad, the others are shown all the same
    bands: list[Band] = []
    groups: list[dict[str, Any]] = []
    for part, columns in wanted.items():
        if not columns:
            continue
        try:
            held = source.read(entry, columns) if rows is None else rows
            built = _build(source, finding, part, {name: held[name] for name in columns})
        except BadDataset as error:
            problems.append(error.fault)
            continue
        except XopError as error:
            problems.append(f"episode {entry.index}, {part.title.lower()}: {error}")
            continue
        bands += [each for each in built if isinstance(each, Band)]
        panels = [each for each in built if isinstance(each, Panel)]
        if panels:
            shown = [_encode_panel(panel, limits.points) for panel in panels]
            groups.append({"title": part.title, "panels": shown})
    dt = 1 / source.fps
    return {
        "duration": entry.length * dt,
        "bands": [
            {
                "name": band.name,
                "kind": band.kind,
                "runs": [
                    [round(first * dt, 4), round(last * dt, 4), text]
                    for first, last, text in band.runs
                ],
            }
            for band in bands
        ],
        "changes": describe_changes(entry, source.fps),
        "groups": groups,
    }


def _build(
    source: Source, finding: Finding, part: Part, rows: dict[str, np.ndarray]
) -> Sequence[Panel | Band]:
    robot = finding.figures.get("robot")
    episode = Episode(finding.entry, source.features, rows, 1 / source.fps, robot)
    with np.errstate(all="ignore"):  # what is not finite is not drawn
        return part.build(episode) if finding.entry.length else ()


def _encode_panel(panel: Panel, points: int) -> dict[str, Any]:
    series = []
    for curve in panel.series:
        values = thin(np.asarray(curve.values, float), points)
        series.append(
            {"name": curve.name, "style": curve.style, "colour": curve.colour, **encode(values)}
        )
    return {"title": panel.title, "unit": panel.unit, "series": series}


# Facts.


def _make_facts(finding: Finding) -> str:
    rows = [
        (name, f"{format_value(name, value)}{_unit(name)}")
        for name, value in finding.figures.items()
        if value is not None
    ]
    for name, value in finding.entry.facts.items():
        if name in finding.figures:
            continue
        text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
        rows.append((name, text if len(text) <= _LONGEST_FACT else f"{text[:_LONGEST_FACT]}…"))
    for key, span in finding.entry.videos.items():
        rows.append((key, f"{span.file}, {span.start:.2f} s to {span.stop:.2f} s"))
    rows.append(("rows", str(finding.entry.file)))
    lines = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(text)}</dd></div>" for name, text in rows
    )
    return f"<details><summary>all figures and facts</summary><dl>{lines}</dl></details>"
