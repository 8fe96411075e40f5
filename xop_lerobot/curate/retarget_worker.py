"""Worker of `xop-curate retarget`: a robot driven by recorded operators.

Everything but the operator is as in `xop-collect`: LeRobot devices of robot and teleoperator in
lock-step, one dataset per episode, seeded by session and episode index.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.collect.folder import Attempt
from xop_lerobot.collect.worker import Collector
from xop_lerobot.curate.retarget_job import DEVICE
from xop_lerobot.operator.alignment import EngageRefused
from xop_lerobot.operator.devices import DEVICES
from xop_lerobot.operator.devices.replay import ReplayDevice
from xop_lerobot.recording.lockstep import count_ticks

if TYPE_CHECKING:
    from pathlib import Path

    from lerobot_teleoperator_xop.xop import Xop
    from xop_lerobot.curate.retarget_job import RetargetConfig, RetargetJob
    from xop_lerobot.operator.recording import Recording
    from xop_lerobot.recording.dataset import XopDataset

_GRACE_S = 5.0
"""Time for the robot to settle before the operator starts [s]."""


_OPERATORS: dict[int, Recording] = {}
"""Operator to replay, by episode: passes it from the worker to its device."""


class RetargetDevice(ReplayDevice):
    """Plays the operator of the source episode with the same index.

    Args:
        config: Device settings; `path` is only the source's name.
    """

    def connect(self) -> None:
        """Do nothing: the recordings are already read and checked."""

    def begin_episode(self, index: int) -> None:
        """Select the operator of episode `index`."""
        self._recording = _OPERATORS.get(index)


DEVICES.add(DEVICE, RetargetDevice)


class Replayer(Collector):
    """Replays single operators, in any order.

    One that cannot be replayed yields an attempt without frames, repeated in every run.

    Args:
        config: Configuration of the replay.
        run: Start of this run [s since the epoch].
    """

    config: RetargetConfig

    def make(self, job: RetargetJob, folder: Path) -> Attempt:
        """Replay an operator."""
        if job.recording is None:
            return self._leave_out(job, job.fault)
        _OPERATORS.clear()
        _OPERATORS[job.index] = job.recording
        try:
            return super().make(job, folder)
        except EngageRefused as refusal:
            return self._leave_out(job, str(refusal))

    def _leave_out(self, job: RetargetJob, fault: str) -> Attempt:
        elapsed = time.time() - self.run
        return Attempt(job.index, False, fault, False, 0, run=self.run, elapsed=elapsed, cpu_s=0.0)

    def begin(self, job: RetargetJob, teleop: Xop, dataset: XopDataset) -> None:
        """Apply the weights, and set the provenance of the episode."""
        if self.config.weights:
            teleop.change({"weights": dict(self.config.weights)}, source="retarget")
        dataset.more_facts = job.facts

    def get_limit(self, job: RetargetJob) -> int:
        """Frames after which an episode ends even if the operator never engaged."""
        assert job.recording is not None
        duration = job.recording.duration + self.config.hold_s + _GRACE_S
        return count_ticks(duration, self.config.fps)

    def get_instruction(self, job: RetargetJob, frame: int) -> str:
        """Task description of the source at this frame."""
        stamps = [stamp for stamp, _ in job.tasks]
        last = np.searchsorted(stamps, frame / self.config.fps + 1e-9, side="right") - 1
        return job.tasks[max(int(last), 0)][1]
