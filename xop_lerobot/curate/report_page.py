"""The page of a report, written as a stream: what comes in the end may stand at its beginning.

Sections of episodes and rows of the table go to two temporary files as they come; in the end
they and the summary are put together. So memory holds one episode, however many there are.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np

from xop_lerobot.core.errors import BadDataset, XopError
from xop_lerobot.core.page import FOOT, dump_script, embed, escape, make_head
from xop_lerobot.curate.inspect import SHOWN, SUMMARISED, Totals, format_value
from xop_lerobot.curate.measures import FIGURES, Episode
from xop_lerobot.curate.source import Source
from xop_lerobot.curate.stills import list_cameras, read_stills
from xop_lerobot.curate.survey import Finding
from xop_lerobot.curate.timeline import PARTS, Band, Panel, Part, describe_changes, encode, thin

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
        f'<div class="strips">{strips}</div>',
        '<details class="timelines"><summary>timelines</summary><div class="timeline"></div>'
        f'<script type="application/json">{dump_script(timeline)}</script></details>',
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
            kind += " failed" if name == "success" and kind == "bad" else ""
            marks.append(f'<span class="mark {kind}">{escape(text)}</span>')
    chips = [
        f"<span><small>{escape(name.replace('_', ' '))}</small> "
        f"{escape(format_value(name, figures[name]))}{escape(_unit(name))}</span>"
        for name in CHIPS
        if figures.get(name) is not None
    ]
    task = " | ".join(entry.tasks)
    return (
        f"<h3>Episode {entry.index} {''.join(marks)} <small>{escape(task)}</small></h3>"
        f'<p class="chips">{" ".join(chips)}</p>'
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
    return f"<details><summary>all metrics and metadata</summary><dl>{lines}</dl></details>"


_ASSETS = resources.files("xop_lerobot.curate") / "page"
_SCRIPTS = ("report.js", "figures.js")
_WHOLE = 3
"""Lines of the totals that are not counts and ranges of metrics."""
_DIGITS = 7
"""Significant digits of a figure in the page."""


class Report:
    """A page that is being written; a context, at whose end it is there whole, or not at all.

    Args:
        path: The page.
        source: The dataset.
        limits: How much of an episode is shown.
        count: How many episodes there will be.
        detailed: How many of them get a section, evenly chosen.
        chosen: Whether they were chosen by index.

    Attributes:
        episodes: How many came so far.
        faulty: How many of them have problems.
    """

    def __init__(
        self, path: Path, source: Source, limits: Limits, count: int, detailed: int, *, chosen: bool
    ) -> None:
        self._path, self._source, self._limits = path, source, limits
        self._count, self._detailed, self._chosen = count, detailed, chosen
        self._draft = path.with_name(f".{path.name}.tmp")
        self._totals = Totals(SUMMARISED)
        self._unknown = set(FIGURES)
        self._judged = _has_task(source)
        self._shown = self.episodes = self.faulty = 0
        self._files = ExitStack()
        self._made: list[Path] = []
        self._rows: IO[str]
        self._sections: IO[str]

    def __enter__(self) -> Self:
        try:
            for folder in reversed(self._find_missing_folders()):
                folder.mkdir()
                self._made.append(folder)
            # Beside the page, where there must be room for it anyway.
            self._rows, self._sections = (
                self._files.enter_context(
                    tempfile.TemporaryFile("w+", encoding="utf-8", dir=self._path.parent)
                )
                for _ in range(2)
            )
        except OSError as error:
            self._clean_up()
            raise XopError(f"'{self._path}' cannot be written: {error}") from error
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._clean_up()

    def _find_missing_folders(self) -> list[Path]:
        return [each for each in self._path.parents if not each.exists()]

    def _clean_up(self) -> None:
        """Leave the page behind, or nothing."""
        self._files.close()
        if self._draft.is_file():
            self._draft.unlink()
        for folder in reversed(self._made):
            if not any(folder.iterdir()):
                folder.rmdir()

    @property
    def frames(self) -> int:
        """How many frames the episodes have that came so far."""
        return self._totals.frames

    def add(self, finding: Finding) -> None:
        """Add an episode."""
        # Evenly: of `count` episodes, those at which the share of `detailed` reaches a new one.
        number = self.episodes
        has_section = (
            (number + 1) * self._detailed // self._count > number * self._detailed // self._count
            if number < self._count
            else False
        )
        problems = list(finding.problems)
        if has_section:
            section, more = make_section(self._source, finding, self._limits)
            problems += more
            self._sections.write(section)
            self._shown += 1
        self._totals.add(finding.figures, bool(problems))
        self.episodes, self.faulty = self.episodes + 1, self.faulty + bool(problems)
        self._judged |= finding.figures.get("success") is True
        self._unknown -= {name for name, value in finding.figures.items() if value is not None}
        values = [
            float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value
            for value in finding.figures.values()
        ]
        row = dump_script([values, problems, has_section])
        self._rows.write(f"{',' if number else ''}\n{row}")

    def finish(self, faults: list[str], missing: list[str]) -> None:
        """Put the page together.

        Args:
            faults: What is wrong with the dataset as a whole.
            missing: What could not be shown for want of columns.
        """
        style = (_ASSETS / "report.css").read_text(encoding="utf-8")
        views = (_ASSETS / "views.html").read_text(encoding="utf-8")
        scripts = [(_ASSETS / name).read_text(encoding="utf-8") for name in _SCRIPTS]
        try:
            with self._draft.open("w", encoding="utf-8") as page:
                page.write(make_head(f"Dataset {self._source.root.resolve().name}", style))
                page.write(self._make_summary(faults, missing))
                page.write('<script type="application/json" id="figures">')
                page.write(f'{{"judged":{dump_script(self._judged)},')
                page.write(f'"figures":{dump_script(self._list_figures())},"rows":[')
                _copy(self._rows, page)
                page.write(f'\n]}}</script>{views}<div class="view" id="view-episodes">')
                _copy(self._sections, page)
                page.write(f'</div>\n{self._make_notes()}\n<script type="text/plain" id="bokeh">')
                page.write(f"{_read_bokeh()}</script>")
                page.writelines(f"\n<script>\n{script}</script>" for script in scripts)
                page.write(FOOT)
                page.flush()
                os.fsync(page.fileno())
            os.replace(self._draft, self._path)
        except OSError as error:
            raise XopError(f"'{self._path}' cannot be written: {error}") from error

    def _list_figures(self) -> list[dict[str, object]]:
        return [
            figure._asdict() | {"kind": figure.kind.name.lower(), "shown": figure.name in SHOWN}
            for figure in FIGURES.values()
        ]

    def _make_summary(self, faults: list[str], missing: list[str]) -> str:
        source = self._source
        root = source.root.resolve()
        lines = self._totals.format().splitlines()
        if self.episodes == 1:  # whose section says the rest
            lines = lines[:_WHOLE]
        parts = [
            f"<h1>Dataset {escape(root.name)}</h1>",
            f'<p class="note">{escape(root)} · {escape(source.robot or "robot not stated")} · '
            f"{source.fps:g} Hz · made {datetime.now(UTC):%Y-%m-%d %H:%M} UTC by "
            "<code>xop-curate report</code></p>",
        ]
        parts += [f'<p class="problem">{escape(fault)}</p>' for fault in faults]
        if self.faulty:
            parts.append(
                f'<p class="problem">{self.faulty} of {self.episodes} episodes cannot be read as a '
                "whole; the table and their sections say why.</p>"
            )
        parts.append(f'<ul id="summary">{"".join(f"<li>{escape(x)}</li>" for x in lines)}</ul>')
        if self._chosen:
            parts.append(
                f'<p class="note">Only {self.episodes} of {source.total_episodes} episodes, '
                "chosen by --episodes.</p>"
            )
        if missing:
            parts.append(
                '<p class="note" id="missing"><b>Partial:</b> this dataset lacks columns, so that '
                f"there is no timeline of {escape('; '.join(missing))}.</p>"
            )
        return "\n".join(parts)

    def _make_notes(self) -> str:
        """Make what stands below the episodes."""
        limits = self._limits
        text = (
            f"At most {limits.pictures} images of a camera, {limits.width} pixels wide, and "
            f"{limits.points} points of a curve; of longer ones the lowest and the highest "
            "value of each piece, so that no peak is lost."
        )
        if self._shown < self.episodes:
            text = (
                f"Images and timelines of {self._shown} of {self.episodes} episodes, evenly "
                f"chosen; --detailed and --episodes choose others. {text}"
            )
        parts = [f'<p class="note" id="limits">{escape(text)}</p>']
        unknown = [name for name in FIGURES if name in self._unknown]
        if unknown and self.episodes:
            parts.append(
                f'<p class="note">Not known of any episode: {escape(", ".join(unknown))}.</p>'
            )
        config = json.dumps(self._source.read_config(), indent=2, ensure_ascii=False)
        if config != "{}":
            parts.append(
                "<details><summary>configuration of the session</summary>"
                f"<pre>{escape(config)}</pre></details>"
            )
        return "\n".join(parts)


def _has_task(source: Source) -> bool:
    """Whether a task of this project ran, which judges its episodes."""
    robot = source.read_config().get("robot")
    return not isinstance(robot, dict) or bool(robot.get("task", True))


def _read_bokeh() -> str:
    """Read the library that draws the figures, as it may stand in a `<script>`."""
    from bokeh.util.paths import bokehjs_path  # noqa: PLC0415 a tenth of a second, if any

    files = (bokehjs_path() / "js" / f"{name}.min.js" for name in ("bokeh", "bokeh-api"))
    text = "\n".join(file.read_text(encoding="utf-8") for file in files)
    return text.replace("</script", "<\\/script")


def _copy(source: IO[str], target: IO[str]) -> None:
    source.seek(0)
    shutil.copyfileobj(source, target)
