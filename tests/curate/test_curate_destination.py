"""A new dataset gets to its place as a whole or not at all, whatever happens."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from xop_lerobot.core import folders as module
from xop_lerobot.core.errors import XopError
from xop_lerobot.core.folders import FolderTaken
from xop_lerobot.curate.destination import Destination

REPO = Path(__file__).parents[2]


@pytest.fixture
def source(tmp_path) -> Path:
    root = tmp_path / "source"
    root.mkdir()
    (root / "content").write_text("old")
    return root


def build(draft: Path, text: str = "new") -> None:
    draft.mkdir()
    (draft / "content").write_text(text)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_new_dataset_takes_its_place(source, tmp_path):
    out = tmp_path / "deep" / "down" / "out"
    with Destination(out, source) as draft:
        assert not draft.exists()
        assert draft.parent.is_dir()
        build(draft)
        assert not out.exists()
    assert (out / "content").read_text() == "new"
    assert names(out.parent) == {"out"}
    assert (source / "content").read_text() == "old"


def test_failure_leaves_nothing(source, tmp_path):
    with pytest.raises(RuntimeError), Destination(tmp_path / "deep" / "out", source) as draft:
        build(draft)
        raise RuntimeError
    assert names(tmp_path) == {"source"}


@pytest.mark.parametrize("at_once", [True, False])
def test_in_place(source, tmp_path, monkeypatch, at_once):
    if not at_once:
        monkeypatch.setattr(module, "_exchange_at_once", lambda first, second: False)
    with Destination(None, source) as draft:
        build(draft)
        assert (source / "content").read_text() == "old"
    assert (source / "content").read_text() == "new"
    assert names(tmp_path) == {"source"}


def test_in_place_failure_leaves_the_source(source, tmp_path):
    with pytest.raises(RuntimeError), Destination(None, source) as draft:
        build(draft)
        raise RuntimeError
    assert (source / "content").read_text() == "old"
    assert names(tmp_path) == {"source"}


def test_both_are_there_at_the_moment_of_the_exchange(source, tmp_path):
    new = tmp_path / "new"
    build(new)
    assert module._exchange_at_once(new, source), "this file system exchanges in two steps"
    assert (source / "content").read_text() == "new"
    assert (new / "content").read_text() == "old"


def test_two_renames_that_were_cut_are_put_right(source, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_exchange_at_once", lambda first, second: False)
    rename, calls = os.rename, []

    def cut(first, second):
        calls.append(first)
        if len(calls) == 2:
            raise OSError("the power is gone")
        rename(first, second)

    monkeypatch.setattr(module.os, "rename", cut)
    monkeypatch.setattr(shutil, "rmtree", lambda *args, **options: None)
    with pytest.raises(XopError, match="the power is gone"), Destination(None, source) as draft:
        build(draft)
    assert not source.exists()
    monkeypatch.undo()
    with pytest.raises(RuntimeError), Destination(None, source):
        raise RuntimeError
    assert (source / "content").read_text() == "old"
    assert names(tmp_path) == {"source"}


def test_killed_run_leaves_the_source_and_the_next_one_cleans_up(source, tmp_path):
    code = (
        "import os, signal, sys; from pathlib import Path;"
        "from xop_lerobot.curate.destination import Destination;"
        f"draft = Destination(None, Path({str(source)!r})).__enter__();"
        "draft.mkdir(); (draft / 'content').write_text('half');"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=REPO)
    assert done.returncode == -signal.SIGKILL
    assert (source / "content").read_text() == "old"
    assert names(tmp_path) == {"source", ".source.curating"}
    with Destination(None, source) as draft:
        assert not draft.exists()
        build(draft)
    assert (source / "content").read_text() == "new"
    assert names(tmp_path) == {"source"}


def test_nothing_written_is_an_error(source, tmp_path):
    out = tmp_path / "out"
    with (
        pytest.raises(XopError, match=f"nothing was written for '{out}'"),
        Destination(out, source),
    ):
        pass
    assert names(tmp_path) == {"source"}


@pytest.mark.parametrize("kind", ["file", "empty directory", "link to nowhere"])
def test_existing_out_is_refused(source, tmp_path, kind):
    out = tmp_path / "out"
    if kind == "file":
        out.write_text("")
    elif kind == "empty directory":
        out.mkdir()
    else:
        out.symlink_to("nowhere")
    with pytest.raises(FolderTaken) as caught:
        Destination(out, source)
    assert str(caught.value) == f"'{out}' exists already. Choose another --out, or delete it"


def test_out_inside_of_a_source_is_refused(source, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(FolderTaken) as caught:
        Destination(other / "deep" / "out", source, other)
    assert str(caught.value) == (
        f"'{other / 'deep' / 'out'}' is inside the dataset '{other}'. Choose another --out"
    )


def test_out_that_appears_meanwhile_is_not_touched(source, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(FolderTaken, match="exists already"), Destination(out, source) as draft:
        build(draft)
        build(out, "somebody's")
    assert (out / "content").read_text() == "somebody's"


def test_two_runs_on_one_place(source, tmp_path):
    out = tmp_path / "out"
    with Destination(out, source) as draft:
        build(draft)
        with pytest.raises(FolderTaken) as caught, Destination(out, source):
            pass
        assert str(caught.value) == f"another xop-curate is at work on '{out}'. Wait for it"
        assert (draft / "content").read_text() == "new"
    assert (out / "content").read_text() == "new"


def test_place_that_cannot_be_written(source, tmp_path):
    blocker = tmp_path / "file"
    blocker.write_text("")
    with (
        pytest.raises(XopError, match=f"nothing can be written beside '{blocker / 'out'}'"),
        Destination(blocker / "out", source),
    ):
        pass
    assert names(tmp_path) == {"source", "file"}
