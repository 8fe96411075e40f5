"""LeRobot's own tools, and a checker of others, work on our datasets, recorded and curated."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from curate_data import compute_digests
from curate_recorded import load, read_metadata, read_pictures, read_rows, record_toy
from huggingface_hub.utils import filter_repo_objects
from lerobot.datasets import lerobot_dataset

from xop_lerobot.curate.cli import main
from xop_lerobot.curate.source import Source
from xop_lerobot.recording.facts import read_facts

pytestmark = pytest.mark.slow

LENGTHS = (16, 12, 14)
HEAD = "observation.images.head"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    return record_toy(tmp_path_factory.mktemp("tools") / "toy", LENGTHS, session="tools")


@pytest.fixture(scope="module")
def curated(recorded) -> Path:
    """Labelled, then cut: the pictures begin inside their file."""
    labelled, out = (recorded.with_name(name) for name in ("labelled", "curated"))
    words = ["--success", "episode < 2", "--subtask", "early=time < 0.3"]
    assert main(["label", "--root", str(recorded), "--out", str(labelled), *words]) == 0
    from xop_lerobot.curate.transfer import Clip, Step, transfer

    with Source(labelled) as source:
        clips = [Clip(source, entry, (3, entry.length)) for entry in source.episodes]
        transfer(clips, out, Step.now("test"))
    return out


@pytest.fixture(params=["recorded", "curated"])
def root(request) -> Path:
    return request.getfixturevalue(request.param)


def edit(monkeypatch, root: Path, operation: str, *flags: str) -> None:
    """Run `lerobot-edit-dataset`; its parser reads `sys.argv`."""
    from lerobot.scripts import lerobot_edit_dataset

    words = ["lerobot-edit-dataset", "--repo_id=local/toy", f"--root={root}"]
    words = words[:1] if operation == "merge" else words
    monkeypatch.setattr(sys, "argv", [*words, f"--operation.type={operation}", *flags])
    lerobot_edit_dataset.main()


def check_loads(root: Path, episodes: int) -> Any:
    """LeRobot loads all of it, `xop-curate` too, and no column is missing."""
    dataset = load("local/toy", root=root)
    assert dataset.num_episodes == episodes
    for index in (0, len(dataset) // 2, len(dataset) - 1):
        dataset[index]
    with Source(root) as source:
        entries = list(source.episodes)
        for entry in entries:
            source.read(entry, ["operator.head", "goal.head", "next.success"])
    assert [entry.index for entry in entries] == list(range(episodes))
    return dataset


def check_pictures(root: Path, episode: int, old: Path, before: int) -> None:
    """Pictures are those of the old episode; encoded anew they differ a little."""
    new, whole = read_pictures(root, episode, HEAD, 25), read_pictures(old, before, HEAD, 25)
    assert new.shape == whole.shape
    assert np.abs(new.astype(float) - whole).mean() < 5


def test_delete(root, tmp_path, monkeypatch):
    out = tmp_path / "out"
    flags = ("--new_repo_id=local/out", f"--new_root={out}", "--operation.episode_indices=[1]")
    edit(monkeypatch, root, "delete_episodes", *flags)
    dataset = check_loads(out, 2)
    assert dataset.meta.total_frames == len(dataset)
    for number, episode in enumerate((0, 2)):
        rows, before = read_rows(out, number), read_rows(root, episode)
        for key in ("action", "operator.head", "time.wall"):
            np.testing.assert_array_equal(np.stack(rows[key]), np.stack(before[key]))
        check_pictures(out, number, root, episode)


def test_split(curated, tmp_path, monkeypatch):
    flags = (f"--new_root={tmp_path}", '--operation.splits={"train": [0, 2], "val": [1]}')
    edit(monkeypatch, curated, "split", *flags)
    check_loads(tmp_path / "train", 2)
    check_loads(tmp_path / "val", 1)
    check_pictures(tmp_path / "train", 1, curated, 2)


def test_merge(curated, tmp_path, monkeypatch):
    out = tmp_path / "out"
    flags = (
        "--new_repo_id=local/out", f"--new_root={out}", "--operation.repo_ids=['a', 'b']",
        f"--operation.roots=['{curated}', '{curated}']",
    )  # fmt: skip
    edit(monkeypatch, curated, "merge", *flags)
    check_loads(out, 6)
    for number in (0, 4, 5):
        check_pictures(out, number, curated, number % 3)
    assert read_metadata(out)["xop/seed"].notna().all()  # LeRobot's merge keeps these facts


def test_remove_feature(curated, tmp_path, monkeypatch):
    out = tmp_path / "out"
    flags = (
        "--new_repo_id=local/out", f"--new_root={out}",
        "--operation.feature_names=['retargeter.cost', 'robot.effort']",
    )  # fmt: skip
    edit(monkeypatch, curated, "remove_feature", *flags)
    dataset = check_loads(out, 3)
    assert not {"retargeter.cost", "robot.effort"} & dataset.meta.features.keys()
    check_pictures(out, 2, curated, 2)


def test_what_lerobot_edited_can_be_curated_further(curated, tmp_path, monkeypatch):
    """Facts that LeRobot dropped are not known then; columns are."""
    out = tmp_path / "out"
    flags = ("--new_repo_id=local/out", f"--new_root={out}", "--operation.episode_indices=[0]")
    edit(monkeypatch, curated, "delete_episodes", *flags)
    assert not read_facts(out)
    words = ["filter", "--root", str(out), "--where", "success", "--out", str(tmp_path / "good")]
    assert main([*words, "--quiet"]) == 0
    check_loads(tmp_path / "good", 1)
    assert main(["repair", "--root", str(out), "--dry-run"]) == 0


def test_visualise(curated, tmp_path, monkeypatch):
    from lerobot.scripts import lerobot_dataset_viz

    words = ["--repo-id=local/toy", f"--root={curated}", "--episode-index=1", "--num-workers=0"]
    words += ["--save=1", f"--output-dir={tmp_path}"]
    monkeypatch.setattr(sys, "argv", ["lerobot-dataset-viz", *words])
    lerobot_dataset_viz.main()
    (recording,) = tmp_path.glob("*.rrd")
    assert recording.stat().st_size > 10_000


def test_push_to_hub(curated, monkeypatch):
    """Without a network: what LeRobot would upload is the whole dataset, facts included."""
    calls: dict[str, dict[str, Any]] = {}

    class Hub:
        def __getattr__(self, name: str):
            return lambda *args, **options: calls.update({name: options})

    cards: list[Any] = []
    stock = lerobot_dataset.create_lerobot_dataset_card

    def make_card(**options: Any) -> Any:
        card = stock(**options)
        cards.append(card)
        monkeypatch.setattr(card, "push_to_hub", calls.update)
        return card

    monkeypatch.setattr(lerobot_dataset, "HfApi", Hub)
    monkeypatch.setattr(lerobot_dataset, "create_lerobot_dataset_card", make_card)
    load("me/toy", root=curated).push_to_hub(private=True)
    upload = calls["upload_folder"]
    assert Path(upload["folder_path"]) == curated
    names = list(compute_digests(curated))
    sent = filter_repo_objects(names, ignore_patterns=upload["ignore_patterns"])
    assert sorted(sent) == sorted(names)
    assert {"meta/xop/episodes.jsonl", "meta/xop/config.json", "meta/subtasks.parquet"} < set(names)
    assert calls["create_repo"]["repo_id"] == "me/toy"
    assert '"robot_type": "xop_toy"' in str(cards[0])


def test_doctor(root):
    """The third-party `lerobot-doctor` finds no error."""
    pytest.importorskip("lerobot_doctor", reason="lerobot-doctor is not installed (extra 'dev')")
    script = "import sys; from lerobot_doctor.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", script, str(root)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert "[FAIL]" not in done.stdout
    assert "[PASS]" in done.stdout


def test_info_is_lerobots_own(curated):
    """Keys of `meta/info.json` are those that LeRobot writes."""
    info = json.loads((curated / "meta/info.json").read_text())
    assert info["total_episodes"] == 3
    assert info["total_frames"] == sum(LENGTHS) - 3 * 3
    assert info["splits"] == {"train": "0:3"}
    assert info["features"][HEAD]["info"]["video.codec"] == "h264"
