"""Jobs on a Ray cluster: the same as in processes of this machine, whatever dies."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest
from eval_jobs import do

from xop_lerobot.collect.cli import main as collect
from xop_lerobot.core import pool_ray
from xop_lerobot.core.pool_ray import OtherVersions, RayUnavailable, run_jobs_on_ray
from xop_lerobot.core.versions import read_versions
from xop_lerobot.curate.cli import main as curate
from xop_lerobot.recording.facts import read_facts

pytestmark = pytest.mark.slow

REPO = Path(__file__).parents[2]
SETTINGS = (
    "--method=direct", "--plugins=collect_toy", "--cameras=head", "--width=64", "--height=48",
)  # fmt: skip
HOST = ("time.wall", "retargeter.health")
"""Columns that tell of the host's clock."""


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """A local Ray of two cores, which all tests share."""
    ray = pytest.importorskip("ray", reason="Ray is not installed; it is the extra 'ray'")
    with pytest.MonkeyPatch.context() as patch:
        folders = ("tests/helpers", "teleoperators", "robots", ".")
        patch.setenv("PYTHONPATH", os.pathsep.join(str(REPO / name) for name in folders))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_worker_niceness", "0")  # by itself Ray gives way to tests beside it
        ray.init(address="local", num_cpus=2, include_dashboard=False, log_to_driver=False)
        yield
        ray.shutdown()


def test_a_worker_that_dies_or_fails_costs_its_own_job_alone(cluster):
    jobs = [1, "fail", 2, "die", 3, "threads"]
    made = list(run_jobs_on_ray(do, jobs, 2, address="local", tries=2))
    assert [each.job for each in made if each.again] == ["die"]
    results = {each.job: each for each in made if not each.again}
    assert set(results) == set(jobs)
    assert [results[job].value[0] for job in (1, 2, 3)] == [2, 4, 6]
    assert results["die"].error.startswith("the Ray worker died (")
    assert results["fail"].error.startswith("ValueError: bad luck\nTraceback")
    assert set(results["threads"].value) == {"1"}


def test_more_workers_than_cores_take_turns(cluster):
    results = run_jobs_on_ray(do, [1, 2, 3, 4], 4, address="local")
    assert sorted(each.value[0] for each in results) == [2, 4, 6, 8]


def test_machines_must_have_the_same_versions(cluster, monkeypatch):
    versions = json.loads(read_versions()) | {"mujoco": "2.0.0"}
    monkeypatch.setattr(pool_ray, "read_versions", lambda: json.dumps(versions))
    with pytest.raises(OtherVersions, match=r"has mujoco 3\.\S+ \(here: 2\.0\.0\)\. Install the"):
        list(run_jobs_on_ray(do, [1], 1, address="local"))


def test_without_ray(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(RayUnavailable, match=r"^--ray needs Ray, which is not installed here"):
        list(run_jobs_on_ray(do, [1], 1, address="local"))


def read(root: Path) -> pd.DataFrame:
    """All rows of a dataset, without the host's clock."""
    table = pd.concat(pd.read_parquet(path) for path in sorted(root.glob("data/*/*.parquet")))
    return table.drop(columns=list(HOST)).reset_index(drop=True)


def test_same_seeds_same_episodes(cluster, tmp_path):
    """Collected and retargeted on Ray and by a process of this machine."""
    roots = {way: tmp_path / way for way in ("process", "ray")}
    for way, root in roots.items():
        crew = ("--workers=1",) if way == "process" else ("--workers=2", "--ray=local")
        flags = ("--robot=toy", *SETTINGS, *crew)
        task = ("--task=wait", "--seed=2", "--device=looker", "--episodes=3")
        assert collect([*flags, *task, f"--root={root}"]) == 0
        again = ("retarget", f"--root={roots['process']}", f"--out={root}_again")
        assert curate([*again, *flags, "--episodes=0,2", "--hold=0.2", "--quiet"]) == 0
    for one, two in (
        (roots["process"], roots["ray"]),
        (tmp_path / "process_again", tmp_path / "ray_again"),
    ):
        pd.testing.assert_frame_equal(read(one), read(two))
        videos = [sorted(root.rglob("*.mp4")) for root in (one, two)]
        assert videos[0] and [path.read_bytes() for path in videos[0]] == [
            path.read_bytes() for path in videos[1]
        ]
        hashes = [[facts["config_hash"] for facts in read_facts(root)] for root in (one, two)]
        assert hashes[0] == hashes[1]
    assert not list(tmp_path.glob("*.collecting"))
