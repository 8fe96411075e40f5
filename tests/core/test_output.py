"""Every command says what it has to say in a terminal that cannot show all of it."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from curate_data import make_synthetic, rewrite

from xop_lerobot.core.command_line import can_print_anything, format_table, make_output_readable
from xop_lerobot.curate import cli as curate
from xop_lerobot.curate.cli import VERBS
from xop_lerobot.curate.task_words import TASKS_FILE

WORDS = "Tür öffnen … 手"
SPELT = r"Tur offnen ... \u624b"
REPO = Path(__file__).parents[2]


class Terminal:
    """Standard output and error in an encoding, and what was printed."""

    def __init__(self, monkeypatch, encoding: str) -> None:
        self._streams = [io.BytesIO(), io.BytesIO()]
        for name, stream in zip(("stdout", "stderr"), self._streams, strict=True):
            monkeypatch.setattr(sys, name, io.TextIOWrapper(stream, encoding=encoding))
        self._encoding = encoding

    def read(self) -> tuple[str, str]:
        sys.stdout.flush()
        sys.stderr.flush()
        out, err = (stream.getvalue().decode(self._encoding) for stream in self._streams)
        return out, err


def test_tables_align_numbers_right_and_words_left():
    rows = [("reach", "3/20", "1.5 ± 0.2", ""), ("walk on", "11/20", "-", "1 lost")]
    assert format_table(("task", "success", "CT [s]", "note"), rows).splitlines() == [
        "task     success     CT [s]  note",
        "-------  -------  ---------  ------",
        "reach       3/20  1.5 ± 0.2",
        "walk on    11/20          -  1 lost",
    ]
    assert format_table(("task", "n"), []).splitlines() == ["task  n", "----  -"]


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """A dataset with a task whose words are not ASCII, in a folder whose name is not."""
    root = make_synthetic(tmp_path_factory.mktemp("größe") / "data", 2, 30)
    pq.write_table(pa.table({"task_index": [0], "task": [WORDS]}), root / TASKS_FILE)
    for path in root.glob("meta/episodes/*/*.parquet"):
        count = pq.read_metadata(path).num_rows
        rewrite(path, {"tasks": [[WORDS]] * count})
    return root


@pytest.mark.parametrize(
    ("text", "spelt"),
    [
        ("1/s², m/s³", "1/s2, m/s3"),
        ("0.1 ± 0.2 °, 320 × 240", "0.1 +/- 0.2 deg, 320 x 240"),
        ("a → b – c …", "a -> b - c ..."),
        ("Ångström, Łódź, ﬁne", "Angstrom, \\u0141odz, fine"),
        (WORDS, SPELT),
        ("lost \udce9", "lost \\udce9"),
        ("🤖", "\\U0001f916"),
    ],
)
def test_what_a_terminal_cannot_show_is_spelt_out(monkeypatch, text, spelt):
    terminal = Terminal(monkeypatch, "ascii")
    make_output_readable()
    print(text)
    print(text, file=sys.stderr)
    assert terminal.read() == (f"{spelt}\n", f"{spelt}\n")
    assert not can_print_anything()


def test_what_it_can_show_stays(monkeypatch):
    latin = Terminal(monkeypatch, "latin-1")
    make_output_readable()
    print("1/s², 5 °, größer …")
    assert latin.read()[0] == "1/s², 5 °, größer ...\n"
    utf = Terminal(monkeypatch, "utf-8")
    make_output_readable()
    print(f"{WORDS} \udce9")
    assert utf.read()[0] == f"{WORDS} \\udce9\n"
    assert can_print_anything()


def test_streams_that_somebody_has_put_in_place_are_left_alone(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stdout", stream)
    make_output_readable()
    print(WORDS)
    assert sys.stdout is stream
    assert stream.getvalue() == f"{WORDS}\n"


def test_inspect(root, monkeypatch):
    terminal = Terminal(monkeypatch, "ascii")
    assert curate.main(["inspect", "--root", str(root)]) == 1  # for want of LeRobot's index
    out, err = terminal.read()
    assert "1/s2" in out
    assert SPELT in out
    assert "problem: meta/tasks.parquet has the task descriptions in a column" in err


def test_inspect_writes_json_that_is_the_same(root, monkeypatch):
    terminal = Terminal(monkeypatch, "ascii")
    curate.main(["inspect", "--root", str(root), "--json", "-"])
    rows = json.loads(terminal.read()[0])
    assert [row["task"] for row in rows] == [WORDS, WORDS]


RUNS = {
    "filter": ["--where", "'Tür' in task", "--dry-run"],
    "trim": ["--dry-run"],
    "merge": ["--dry-run"],
    "split": ["--parts", "a=0.5", "b=0.5", "--dry-run"],
    "repair": ["--dry-run"],
    "label": ["--success", "'手' in task", "--dry-run"],
    "retarget": ["--robot", "rby1", "--dry-run"],
    "report": ["--dry-run"],
    "inspect": ["--show", "task,command_roughness"],
}


@pytest.mark.parametrize("verb", VERBS)
def test_verbs_of_curate(root, monkeypatch, verb):
    terminal = Terminal(monkeypatch, "ascii")
    assert verb in RUNS
    curate.main([verb, "--root", str(root), *RUNS[verb], "--quiet"])
    with pytest.raises(SystemExit) as end:
        curate.main([verb, "--help"])
    assert end.value.code == 0
    assert curate.main([verb, "--root", str(root / "größer …"), *RUNS[verb]]) in (1, 2)
    out, err = terminal.read()
    assert f"usage: xop-curate {verb}" in out
    assert "grosser" not in err  # ß has no other letter
    assert r"gr\xf6\xdfer" in err or r"gro\xdfer ..." in err


def test_other_commands(monkeypatch):
    terminal = Terminal(monkeypatch, "ascii")
    from xop_lerobot.collect import cli as collect
    from xop_lerobot.control import client
    from xop_lerobot.doctor import cli as doctor
    from xop_lerobot.doctor.finding import Finding, Level
    from xop_lerobot.evaluation import bench, cli

    for command in (collect, bench, cli, doctor, client):
        with pytest.raises(SystemExit) as end:
            command.main(["--help"])
        assert end.value.code == 0
    assert cli.main(["--größe", "…"]) == 2
    assert doctor.main(["--größe", "…"]) == 2
    doctor.print_finding("disk", Finding(Level.FAIL, "5 °C …", "do this"))
    out, err = terminal.read()
    assert out.count("usage: xop-") == 5
    assert err.count(r"gro\xdfe") == 2
    assert "FAIL  disk         5 degC ...\n                   -> do this\n" in out


@pytest.mark.slow
@pytest.mark.parametrize("command", ["xop-record", "lerobot-record"])
def test_recorders(command, tmp_path):
    """Those print the mistakes of the user with their own paths."""
    path = Path(sys.executable).with_name(command)
    if not path.exists():
        pytest.skip(f"{command} is not installed")
    words = [
        "--robot.type=xop_rby1", "--robot.cameras=[]", "--teleop.type=xop",
        "--teleop.device.type=replay", "--teleop.device.path=größer….npz",
        "--dataset.repo_id=local/x", f"--dataset.root={tmp_path}/out", "--dataset.fps=25",
        "--dataset.single_task=x", "--dataset.push_to_hub=false", "--play_sounds=false",
    ]  # fmt: skip
    paths = [REPO, REPO / "robots", REPO / "teleoperators"]
    env = {
        **os.environ, "PYTHONIOENCODING": "ascii", "MUJOCO_GL": "egl",
        "PYTHONPATH": os.pathsep.join(map(str, paths)),
    }  # fmt: skip
    done = subprocess.run([path, *words], env=env, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        r"error: operator recording 'gro\xdfer....npz': there is no such file"
    )
    assert "Traceback" not in done.stderr
