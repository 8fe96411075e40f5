"""Jobs for the workers of `test_eval.py`; apart from it, so that a worker has little to import."""

import os
import signal

from xop_lerobot.core.pool import THREAD_VARIABLES


def do(job):
    if job == "fail":
        raise ValueError("bad luck")
    if job == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if job == "threads":
        return [os.environ[name] for name in THREAD_VARIABLES]
    return job * 2, os.getpid()


def run_made(job):
    """Run a trial in no time; seed 1 dies."""
    if job.seed == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return make_trial(job.setup, job.seed)


def make_trial(setup, seed, **changed):
    """A record of a trial, made by hand."""
    from xop_lerobot.evaluation.study import compute_key

    metrics = {"abp": 0.1 * (seed + 1), "tilt": None, "jerk": 10.0, "plan_ms": 5.0}
    way = [[0, 0], [1, 0.5]]
    record = {
        "key": compute_key(setup, seed), "seed": seed, "success": True, "picked_up": False,
        "collision": False, "collisions": [], "fallen": False, "failure": "",
        "completion_s": 10.0 + seed, "sim_s": 12.0, "wall_s": 6.0, "metrics": metrics,
        "code": "0", "plot": {"dt": 0.2, "head_xy": way, "head_error": [0.1, None],
                              "left_error": [None, 0.1], "right_error": [0.1, 0.1]},
    }  # fmt: skip
    return {**record, "robot": setup.robot, "task": setup.task, **changed}
