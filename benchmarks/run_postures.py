"""Drive a simulated robot to random reachable goals of the head, and report those it misses.

    python -m benchmarks.run_postures --robot rby1 --goals 20
    python -m benchmarks.run_postures --robot g1 --goals 10 --noise mild

Goals are head poses of postures that the robot can hold, so each is reachable; the robot goes from
each to the next in stationary mode. The tests do the same with the kinematic proposal alone.
"""

from __future__ import annotations

import argparse
import os
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks.tracking import WorldAlignment
from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import (
    level_pose,
    pose_inverse,
    pose_multiply,
    rotation_error,
)
from xop_lerobot.evaluation.trial import closed_loop
from xop_lerobot.morphology.morphology import make_morphology, say_robots
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.model.posture import Repertoire
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.session import Tick
from xop_lerobot.teleoperation import TeleoperationConfig

NEAR_M, NEAR_DEG = 0.05, 5.0
"""Errors up to which a goal counts as reached [m], [deg]."""
LOWEST, MOST_TILTED = 0.5, 100.0
"""Minimum height [m] and maximum tilt [deg] of a goal: no person's head goes beyond."""


class Head(Device):
    """An operator whose head has the pose `head`; the hands follow its position and heading.

    Args:
        head: Initial pose of the head. Shape (7,).
        wrists: Initial poses of the wrists by name. Shapes (7,).
    """

    self_engaging = True
    start_mode = Mode.STATIONARY

    def __init__(self, head: np.ndarray, wrists: dict[str, np.ndarray]) -> None:
        self.head = head
        level = pose_inverse(level_pose(head))
        self._from_head = {name: pose_multiply(level, pose) for name, pose in wrists.items()}

    def start(self, time: float) -> None:
        """Do nothing: the pose does not depend on time."""

    def read(self, time: float) -> OperatorFrame:
        """Return the head and the hands that follow it."""
        wrists = {
            name: pose_multiply(level_pose(self.head), p) for name, p in self._from_head.items()
        }
        return OperatorFrame(
            time=time, head=self.head, **wrists, pinch=np.full(2, 0.1), mode=self.start_mode
        )


def draw_goals(retargeter: MpcRetargeter, count: int, seed: int) -> np.ndarray:
    """Draw head poses from the robot's repertoire of postures. Shape (count, 7)."""
    morphology, model = retargeter.morphology, retargeter.rollout.model
    repertoire = Repertoire(
        model,
        retargeter.command_model,
        morphology.standing_qpos(),
        morphology.frames["head"],
        morphology.base_body,
        retargeter.problem.support,
        retargeter.problem.load,
    )
    poses = repertoire.poses
    upright = 1 - 2 * np.square(poses[:, 4:6]).sum(axis=1)
    kept = poses[(poses[:, 2] > LOWEST) & (upright > np.cos(np.radians(MOST_TILTED)))]
    return np.random.default_rng(seed).permutation(kept)[:count]


def main(arguments: list[str] | None = None) -> int:
    """Run the check; returns 1 if a goal is missed or the robot falls."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robot", default="rby1", help=f"{say_robots()} (default: rby1)")
    parser.add_argument("--goals", type=int, default=20, help="number of goals (default: 20)")
    parser.add_argument("--hold", type=float, default=6.0, help="time per goal [s] (default: 6)")
    parser.add_argument("--noise", default="off", help="sensor noise (default: off)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the goals (default: 0)")
    args = parser.parse_args(arguments)

    morphology = make_morphology(args.robot)
    plant = Simulation(morphology, SimulationConfig(noise=args.noise, seed=args.seed))
    config = TeleoperationConfig(retargeter=RetargeterConfig(threads=1))
    with closed_loop(plant, config) as (loop, teleoperation):
        loop.reset(args.seed)
        retargeter = teleoperation.retargeter
        assert isinstance(retargeter, MpcRetargeter)

        def measure() -> dict[str, np.ndarray]:
            return retargeter.problem.readings.compute_poses(
                loop.state.true_qpos, morphology.frames
            )

        frames = measure()
        head = frames.pop("head")
        device = teleoperation.device = Head(head, frames)
        teleoperation.alignment = WorldAlignment()
        teleoperation.reset()
        missed = 0
        for i, goal in enumerate(draw_goals(retargeter, args.goals, args.seed)):
            device.head = goal
            for _ in range(round(args.hold / teleoperation.dt)):
                action, _ = teleoperation.step(Tick(loop.state))
                loop.execute(action, teleoperation.dt)
            reached = measure()["head"]
            offset = float(np.linalg.norm(reached[:3] - goal[:3]))
            angle = float(np.degrees(np.linalg.norm(rotation_error(goal[3:], reached[3:]))))
            failed = offset > NEAR_M or angle > NEAR_DEG
            missed += failed
            verdict = "missed" if failed else "reached"
            error = f"{offset * 100:.1f} cm and {angle:.1f} deg"
            print(f"goal {i}: {verdict}, {error} away", flush=True)
            if loop.state.fallen:
                print("the robot has fallen")
                break
        print(f"{args.robot}: {missed} of {args.goals} goals missed")
    return 1 if missed or loop.state.fallen else 0


if __name__ == "__main__":
    sys.exit(main())
