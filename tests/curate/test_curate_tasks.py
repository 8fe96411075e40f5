"""The words of tasks, wherever a writer of datasets has put them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from curate_data import make_foreign, make_synthetic
from lerobot.datasets import LeRobotDataset
from lerobot_rows import get_episodes, get_row

from xop_lerobot.core.errors import BadDataset
from xop_lerobot.curate.cli import main
from xop_lerobot.curate.task_words import TASKS_FILE, has_index_of_words, read_tasks

WORDS = ["task 0", "task 1"]
NUMBERS = pa.array([0, 1])
TABLES = {
    "a column": pa.table({"task_index": NUMBERS, "task": WORDS}),
    "a column before": pa.table({"task": WORDS, "task_index": NUMBERS}),
    "a column of large text": pa.table(
        {"task_index": NUMBERS, "task": pa.array(WORDS, pa.large_string())}
    ),
    "a column of categories": pa.table(
        {"task_index": NUMBERS, "task": pa.array(WORDS).dictionary_encode()}
    ),
    "a column among others": pa.table({"split": ["a", "b"], "task_index": NUMBERS, "task": WORDS}),
    "a column of another name": pa.table({"task_index": NUMBERS, "instruction": WORDS}),
    "another order": pa.table({"task_index": pa.array([1, 0]), "task": WORDS[::-1]}),
    "numbers as floats": pa.table({"task_index": pa.array([0.0, 1.0]), "task": WORDS}),
    "pandas' own counter": pa.Table.from_pandas(
        pd.DataFrame({"task_index": [0, 1], "task": WORDS})
    ),
    "an index without a name": pa.Table.from_pandas(
        pd.DataFrame({"task_index": [0, 1]}, index=pd.Index(WORDS))
    ),
}
VERBS = {
    "filter": ["--where", "length > 1"],
    "trim": [],
    "merge": [],
    "label": ["--success", "length > 1"],
    "repair": [],
}


@pytest.fixture(scope="module")
def foreign(tmp_path_factory) -> Path:
    return make_foreign(tmp_path_factory.mktemp("foreign") / "data", 2, 12, video=False)


@pytest.fixture
def data(foreign, tmp_path) -> Path:
    return Path(shutil.copytree(foreign, tmp_path / "data"))


def read_words(root: Path) -> list[list[str]]:
    """Each episode's words: as the metadata says, and as LeRobot shows its first row."""
    dataset = LeRobotDataset("local/out", root=root)
    episodes = get_episodes(dataset)
    shown = [get_row(dataset, int(start))["task"] for start in episodes["dataset_from_index"]]
    listed = [tasks for tasks in episodes["tasks"]]
    assert listed == [[words] for words in shown]
    return listed


@pytest.mark.parametrize("kind", TABLES)
def test_words_are_found_wherever_they_are(data, kind):
    pq.write_table(TABLES[kind], data / TASKS_FILE)
    assert read_tasks(data) == {0: "task 0", 1: "task 1"}
    assert has_index_of_words(data) == (kind == "an index without a name")


@pytest.mark.slow
@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("kind", ["a column", "an index without a name"])
def test_every_verb_keeps_them(data, tmp_path, verb, kind):
    pq.write_table(TABLES[kind], data / TASKS_FILE)
    out = tmp_path / "out"
    assert main([verb, "--root", str(data), "--out", str(out), *VERBS[verb], "--quiet"]) == 0
    assert read_words(out) == [["task 0"], ["task 1"]]


def test_split_keeps_them(data, tmp_path):
    pq.write_table(TABLES["a column"], data / TASKS_FILE)
    flags = ["--out", str(tmp_path / "out"), "--parts", "a=0", "b=1"]
    assert main(["split", "--root", str(data), *flags]) == 0
    assert [read_words(tmp_path / "out" / part) for part in "ab"] == [[["task 0"]], [["task 1"]]]


def test_two_writers_are_merged(data, foreign, tmp_path):
    pq.write_table(TABLES["another order"], data / TASKS_FILE)
    roots = ["--root", str(foreign), str(data)]
    assert main(["merge", *roots, "--out", str(tmp_path / "out")]) == 0
    assert read_words(tmp_path / "out") == [["task 0"], ["task 1"]] * 2


def test_operator_with_several_tasks_is_retargeted_with_their_words(tmp_path):
    """The words of a row are asked for only where an episode has more than one."""
    from curate_data import rewrite

    from xop_lerobot.curate.clip import Step
    from xop_lerobot.curate.retarget_job import Operators
    from xop_lerobot.curate.source import Source

    root = make_synthetic(tmp_path / "data", 1, 40)
    pq.write_table(TABLES["a column"], root / TASKS_FILE)
    (meta,) = root.glob("meta/episodes/*/*.parquet")
    rewrite(meta, {"tasks": [WORDS]})
    (rows,) = root.glob("data/*/*.parquet")
    rewrite(rows, {"task_index": [0] * 25 + [1] * 15})
    rewrite(rows, {"operator.pinch": pa.array([[0.05, 0.05]] * 40, pa.list_(pa.float32(), 2))})
    with Source(root) as source:
        (job,) = Operators(source, Step.now("retarget")).read([0])
    assert job.fault == ""
    assert [words for _, words in job.tasks] == WORDS
    assert job.tasks[1][0] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("table", "fault"),
    [
        (
            pa.table({"task_index": NUMBERS, "task": NUMBERS}),
            "must have one text column, the task descriptions, beside task_index. "
            "Its columns: task_index, task",
        ),
        (
            pa.table({"task_index": NUMBERS, "a": WORDS, "b": WORDS}),
            "must have one text column, the task descriptions, beside task_index. "
            "Its columns: task_index, a, b",
        ),
        (
            pa.table({"task_index": NUMBERS, "task": ["a", None]}),
            "must give number and words of each task, got 1: None",
        ),
        (
            pa.table({"task_index": pa.array([0, 0]), "task": WORDS}),
            "gives task 0 twice: 'task 0' and 'task 1'",
        ),
        (pa.table({"task": WORDS}), "is not readable ("),
        (pa.table({"task_index": ["x", "y"], "task": WORDS}), "is not readable ("),
    ],
)
def test_what_says_no_words_is_refused(data, tmp_path, capsys, table, fault):
    pq.write_table(table, data / TASKS_FILE)
    with pytest.raises(BadDataset) as caught:
        read_tasks(data)
    assert caught.value.fault.startswith(f"meta/tasks.parquet {fault}")
    flags = ["--where", "length > 1", "--out", str(tmp_path / "out")]
    assert main(["filter", "--root", str(data), *flags]) == 1
    assert f"meta/tasks.parquet {fault}" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
