"""Files of a collection in progress, which can be killed and resumed at any moment.

Until the dataset is complete, everything is beside its directory, in `<root>.collecting`:

    settings.json            settings of the collection; further runs must have the same
    lock                     held by the running process
    attempts/000007/         a finished episode: attempt.json, and dataset/ if it is kept
    attempts/tmp-…/          an episode in progress
    merged/                  the dataset being merged
    previous/                the dataset that `merged` replaces, while it does

Every transition between states is one rename, after the files are flushed to disk.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from xop_lerobot.core.errors import XopError
from xop_lerobot.core.folders import (
    FolderTaken,
    check_no_mount,
    finish_swap,
    lock_folder,
    swap_in,
    sync,
    sync_tree,
    write_whole,
)
from xop_lerobot.recording.facts import FACTS_DIR

COLLECT_FILE = FACTS_DIR / "collect.json"
"""Record of its collection in a collected dataset."""
DATASET = "dataset"
"""Directory of an episode's dataset within its folder."""


class OtherSettings(XopError):
    """The directory holds a collection with other settings.

    Args:
        root: Directory of the dataset.
        held: Settings of the existing collection.
        asked: Requested settings.
        flag: Flag that names the directory.
    """

    def __init__(
        self, root: Path, held: Mapping[str, Any], asked: Mapping[str, Any], flag: str
    ) -> None:
        names = [name for name in asked if held.get(name) != asked[name]]
        pairs = ", ".join(
            f"{name} {_show(held.get(name))} (asked for: {_show(asked[name])})" for name in names
        )
        super().__init__(
            f"'{root}' was made with other settings: {pairs}. Ask for the same, choose "
            f"another {flag}, or delete it"
        )


def _show(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else json.dumps(value).strip('"')


@dataclass(frozen=True)
class Attempt:
    """One episode, whether it is kept in the dataset or not.

    Attributes:
        index: Index in the collection; with the seed it decides the content.
        success: Whether the task was accomplished.
        failure: Reason of the failure; empty if unknown.
        kept: Whether it is in the dataset.
        frames: Number of frames.
        run: Start time of the run that made it [s since the epoch].
        elapsed: Time from the start of the run until it was finished [s].
        cpu_s: CPU time [s].
    """

    index: int
    success: bool
    failure: str
    kept: bool
    frames: int
    run: float
    elapsed: float
    cpu_s: float


class CollectFolder:
    """Files of a collection.

    Args:
        root: Directory of the dataset that is being collected.

    Attributes:
        root: The same.
        work: Directory of everything unfinished.
        command: Command that owns these files, for messages.
        flag: Its flag that names the directory.
        record: File of the dataset that records how it was made.
    """

    command: ClassVar[str] = "xop-collect"
    flag: ClassVar[str] = "--root"
    record: ClassVar[Path] = COLLECT_FILE

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self.work = self.root.with_name(f"{self.root.name}.collecting")
        self.merged, self.previous = self.work / "merged", self.work / "previous"
        self._attempts, self._settings = self.work / "attempts", self.work / "settings.json"

    @contextmanager
    def hold(self, settings: Mapping[str, Any]) -> Iterator[None]:
        """Check that this collection may use the directory, and lock it.

        Raises:
            FolderTaken: If the directory holds something else, or is locked by another run.
            OtherSettings: If it holds a collection with other settings.
        """
        self._check_root()
        self.work.mkdir(parents=True, exist_ok=True)
        refusal = (
            f"another {self.command} is at work on '{self.root}'. Wait for it, or choose another "
            f"{self.flag}"
        )
        with lock_folder(self.work, refusal):
            try:
                # A dataset is only put aside once `merged` is complete.
                finish_swap(self.root, self.previous, self.merged)
                self._check_settings(settings)
                self._clean_up()
                yield
            finally:
                self._drop_drafts()
                if not self._settings.exists() or self._is_empty():
                    shutil.rmtree(self.work, ignore_errors=True)

    def _check_root(self) -> None:
        root = self.root
        check_no_mount(root, f"Choose a directory inside it as {self.flag}")
        if not root.exists() or (root / self.record).exists():
            return
        if (root / "meta" / "info.json").exists():
            raise FolderTaken(
                f"'{root}' holds a dataset that {self.command} did not make. Choose another "
                f"{self.flag}, or delete it"
            )
        if not root.is_dir() or any(root.iterdir()):
            raise FolderTaken(
                f"'{root}' exists and is no dataset. Choose another {self.flag}, or delete it"
            )

    def _clean_up(self) -> None:
        """Delete leftovers of a killed run: a merge, unfinished episodes, merged episodes."""
        in_dataset = (self._find(each["index"]) for each in self.read_dataset().get("attempts", ()))
        for folder in (self.merged, self.previous, *in_dataset):
            shutil.rmtree(folder, ignore_errors=True)
        self._drop_drafts()

    def _drop_drafts(self) -> None:
        for folder in self._attempts.glob("tmp-*"):
            shutil.rmtree(folder, ignore_errors=True)

    def _check_settings(self, settings: Mapping[str, Any]) -> None:
        held = self.read_dataset().get("settings")
        if held is None and self._settings.exists():
            held = json.loads(self._settings.read_text(encoding="utf-8"))
        if held is not None and held != settings:
            raise OtherSettings(self.root, held, settings, self.flag)
        self._attempts.mkdir(exist_ok=True)
        write_whole(self._settings, settings)

    def _is_empty(self) -> bool:
        """Whether there is no finished episode outside the dataset."""
        return not self.merged.exists() and not any(self._attempts.glob("*"))

    def _find(self, index: int) -> Path:
        return self._attempts / f"{index:06d}"

    # Episodes.

    def read_dataset(self) -> dict[str, Any]:
        """Read the finished dataset's record of its collection; empty without one."""
        path = self.root / self.record
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}

    def list_attempts(self) -> dict[int, Attempt]:
        """List all finished episodes by index, in and outside the dataset."""
        rows = [Attempt(**row) for row in self.read_dataset().get("attempts", ())]
        return {attempt.index: attempt for attempt in rows} | self.read_attempts()

    def read_attempts(self) -> dict[int, Attempt]:
        """Read the finished episodes that are not merged yet, by index."""
        found = {}
        for path in sorted(self._attempts.glob("[0-9]*/attempt.json")):
            attempt = Attempt(**json.loads(path.read_text(encoding="utf-8")))
            found[attempt.index] = attempt
        return found

    def get_dataset(self, index: int) -> Path:
        """Return the directory of the finished episode `index`'s own dataset."""
        return self._find(index) / DATASET

    def open_attempt(self, index: int) -> Path:
        """Create the working directory of episode `index`."""
        folder = self._attempts / f"tmp-{index:06d}-{os.getpid()}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        return folder

    def close_attempt(self, folder: Path, attempt: Attempt) -> None:
        """Mark an episode as finished, so that no kill can lose it.

        One without frames is deleted instead.
        """
        if not attempt.frames:
            shutil.rmtree(folder)
            return
        write_whole(folder / "attempt.json", dataclasses.asdict(attempt))
        sync_tree(folder)
        os.rename(folder, self._find(attempt.index))
        sync(self._attempts)

    def exchange(self, indices: Iterable[int]) -> None:
        """Replace the dataset by the merged one.

        Args:
            indices: Episodes in it, whose own files are deleted.
        """
        swap_in(self.merged, self.root, self.previous)
        for folder in (self.merged, self.previous, *map(self._find, indices)):
            shutil.rmtree(folder, ignore_errors=True)
