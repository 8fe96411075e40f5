"""One worker of `xop-curate retarget`: a robot that is driven by recorded operators.

Everything but the operator is as in `xop-collect`: the LeRobot devices of robot and teleoperator
in lock-step, one dataset for each episode, and a seed made of the session's and the episode's
index.
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
"""How long a robot may take to settle before the operator begins [s]."""


_OPERATORS: dict[int, Recording] = {}
"""The operator that is to be played, by episode; where the worker and its device meet."""


class RetargetDevice(ReplayDevice):
    """Plays in each episode the operator of that very episode of the source.

    Args:
        config: Its settings; `path` is the source's name alone.
    """

    def connect(self) -> None:
        """Do nothing: the recordings have been read and checked."""

    def begin_episode(self, index: int) -> None:
        """Take the operator of episode `index`."""
        self._recording = _OPERATORS.get(index)


DEVICES.add(DEVICE, RetargetDevice)


class Replayer(Collector):
    """Replays single operators, in any order.

    One that cannot be replayed makes an attempt without frames, which is tried again each time.

    Args:
        config: What they are replayed with.
        run: When this run began [s since the epoch].
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
        """Put the weights into force, and note where the episode comes from."""
        if self.config.weights:
            teleop.change({"weights": dict(self.config.weights)}, source="retarget")
        dataset.more_facts = job.facts

    def get_limit(self, job: RetargetJob) -> int:
        """Frames after which an episode is ended even if the operator could never engage."""
        assert job.recording is not None
        duration = job.recording.duration + self.config.hold_s + _GRACE_S
        return count_ticks(duration, self.config.fps)

    def get_instruction(self, job: RetargetJob, frame: int) -> str:
        """The task in words that the source has at that time."""
        stamps = [stamp for stamp, _ in job.tasks]
        last = np.searchsorted(stamps, frame / self.config.fps + 1e-9, side="right") - 1
        return job.tasks[max(int(last), 0)][1]
