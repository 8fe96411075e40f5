"""The page of a report, written as a stream: what comes in the end may stand at its beginning.

Sections of episodes and rows of the table go to two temporary files as they come; in the end
they and the summary are put together. So memory holds one episode, however many there are.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from contextlib import ExitStack
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from xop_lerobot.core.errors import XopError
from xop_lerobot.core.page import FOOT, dump_script, escape, make_head
from xop_lerobot.curate.figures import FIGURES
from xop_lerobot.curate.inspect import SHOWN, SUMMARISED
from xop_lerobot.curate.report_episode import Limits, make_section
from xop_lerobot.curate.source import Source
from xop_lerobot.curate.survey import Finding
from xop_lerobot.curate.tables import Totals

_ASSETS = resources.files("xop_lerobot.curate") / "page"
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
        script = (_ASSETS / "report.js").read_text(encoding="utf-8")
        try:
            with self._draft.open("w", encoding="utf-8") as page:
                page.write(make_head(f"Dataset {self._source.root.resolve().name}", style))
                page.write(self._make_summary(faults, missing))
                page.write((_ASSETS / "report.html").read_text(encoding="utf-8"))
                page.write('<script type="application/json" id="figures">')
                page.write(f'{{"figures":{dump_script(self._list_figures())},"rows":[')
                _copy(self._rows, page)
                page.write(f"]}}</script>\n<h2>Episode by episode</h2>\n{self._make_note()}\n")
                _copy(self._sections, page)
                page.write(f"<script>\n{script}</script>{FOOT}")
                page.flush()
                os.fsync(page.fileno())
            os.replace(self._draft, self._path)
        except OSError as error:
            raise XopError(f"'{self._path}' cannot be written: {error}") from error

    def _list_figures(self) -> list[dict[str, object]]:
        return [
            {
                "name": figure.name,
                "kind": figure.kind.name.lower(),
                "unit": figure.unit,
                "text": figure.text,
                "shown": figure.name in SHOWN,
            }
            for figure in FIGURES.values()
        ]

    def _make_summary(self, faults: list[str], missing: list[str]) -> str:
        source = self._source
        root = source.root.resolve()
        lines = self._totals.format().splitlines()
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
        unknown = [name for name in FIGURES if name in self._unknown]
        if missing:
            parts.append(
                '<p class="note" id="missing"><b>Partial:</b> this dataset lacks columns, so that '
                f"there is no timeline of {escape('; '.join(missing))}.</p>"
            )
        if unknown and self.episodes:
            parts.append(
                f'<p class="note">Not known of any episode: {escape(", ".join(unknown))}.</p>'
            )
        config = json.dumps(source.read_config(), indent=2, ensure_ascii=False)
        if config != "{}":
            parts.append(
                "<details><summary>configuration of the session</summary>"
                f"<pre>{escape(config)}</pre></details>"
            )
        return "\n".join(parts)

    def _make_note(self) -> str:
        limits = self._limits
        text = (
            f"At most {limits.pictures} pictures of a camera, {limits.width} pixels wide, and "
            f"{limits.points} points of a curve; of longer ones the lowest and the highest "
            "value of each piece, so that no peak is lost."
        )
        if self._shown < self.episodes:
            text = (
                f"Pictures and timelines of {self._shown} of {self.episodes} episodes, evenly "
                f"chosen; --detailed and --episodes choose others. {text}"
            )
        return f'<p class="note" id="limits">{escape(text)}</p>'


def _copy(source: IO[str], target: IO[str]) -> None:
    source.seek(0)
    shutil.copyfileobj(source, target)
