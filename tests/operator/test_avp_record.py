"""`lerobot-record` of a G1 in real time, driven by a Vision Pro that replays real people.

The headset's server sends real messages over a real connection, on the wall clock: somebody
engages by the clutch's gesture, moves as people did in the recordings, and ends the episode by a
raised hand. The person waits for what the robot does, so that a slow machine takes longer and
nothing else.
"""

from __future__ import annotations

import dataclasses
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from avp_server import AvpServer
from headset_rig import RETARGETER
from lerobot.datasets import LeRobotDataset

from tests.recording.test_lerobot_cli import record_flags, run
from xop_lerobot.core.transforms import make_pose, pose_multiply, quat_from_rpy
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.recording import Recording, load_recording
from xop_lerobot.recording.facts import read_facts
from xop_lerobot.session import get_session

pytestmark = pytest.mark.slow

SHARED = Path(os.environ.get("XOP_SHARED", Path(__file__).parents[3] / "shared"))
RATE = 60
PATIENCE_S = 240.0
POSTURES = {  # of a hand: orientation against the head's heading, height against the head [m]
    "rest": (quat_from_rpy(0, 0, 0), -0.5),
    "palms up": (quat_from_rpy(np.pi, 0, 0), -0.5),
    "halt": (quat_from_rpy(0, -np.pi / 2, 0), -0.25),
}


class Person(threading.Thread):
    """Somebody who engages, moves as in `recording`, and ends the episode."""

    def __init__(self, server: AvpServer, recording: Recording) -> None:
        super().__init__(daemon=True)
        self._server, self._recording = server, recording
        self._rng = np.random.default_rng(0)
        self.done: list[str] = []
        self.over = threading.Event()

    def run(self) -> None:
        self._server.wait_for_clients(timeout=PATIENCE_S)
        first = self._recording.frame_at(0.0)
        while not self.over.is_set() and not is_engaged():
            self._send_for(0.4, lambda _: self._pose(first, "palms up", closed=(False, False)))
            self._send_for(
                20.0, lambda _: self._pose(first, "palms up", closed=(True, True)), is_engaged
            )
        self.done.append("engaged")
        self._send_for(1.5, lambda _: first)
        self._send_for(self._recording.duration, self._recording.frame_at)
        last = self._recording.frame_at(self._recording.duration)
        self.done.append("played")
        while not self.over.is_set():
            self._send_for(0.5, lambda _: self._pose(last, "rest", closed=(False, False)))
            self._send_for(0.7, lambda _: self._pose(last, "halt", closed=(False, False)))
            self._send_for(8.0, lambda _: self._pose(last, "halt", closed=(False, True)))

    def _send_for(
        self,
        length: float,
        make: Callable[[float], OperatorFrame],
        until: Callable[[], bool] = lambda: False,
    ) -> None:
        start = time.monotonic()
        while (t := time.monotonic() - start) < length and not until():
            if self.over.is_set():
                return
            self._server.send(self._tremble(make(t)))
            time.sleep(1 / RATE)

    def _tremble(self, frame: OperatorFrame) -> OperatorFrame:
        """No pose comes twice to the bit: that would be a stream that has died."""
        poses = {}
        for name in ("head", "left_wrist", "right_wrist"):
            pose = frame.pose(name).copy()
            pose[:3] += self._rng.normal(0, 0.0003, 3)
            poses[name] = pose
        return dataclasses.replace(frame, **poses)

    def _pose(self, frame: OperatorFrame, posture: str, closed: tuple[bool, bool]) -> OperatorFrame:
        """The head of `frame`, with the hands as they rest and the right one in `posture`."""
        yaw = np.arctan2(*_forward(frame.head)[1::-1])
        level = make_pose(frame.head[:3], quat_from_rpy(0, 0, float(yaw)))
        wrists = []
        for side, y in (("left", 0.2), ("right", -0.2)):
            both = posture == "palms up"
            quat, height = POSTURES[posture if both or side == "right" else "rest"]
            wrists.append(pose_multiply(level, make_pose(np.array([0.35, y, height]), quat)))
        pinch = np.where(closed, 0.008, 0.07)
        left, right = wrists
        return dataclasses.replace(frame, left_wrist=left, right_wrist=right, pinch=pinch)


def _forward(head: np.ndarray) -> np.ndarray:
    return pose_multiply(head, np.array([1.0, 0, 0, 1, 0, 0, 0]))[:3] - head[:3]


def is_engaged() -> bool:
    for _ in range(500):
        tick = get_session().tick
        if tick is None or tick.command is not None:
            return tick is not None and tick.engaged
        time.sleep(0.001)  # observed, and not decided yet
    return False


def test_lerobot_record_of_a_g1_in_real_time(tmp_path, monkeypatch):
    files = sorted((SHARED / "operator").glob("*.npz"))
    if not files:
        pytest.skip("the real recordings are not here")
    root, server = tmp_path / "data", AvpServer()
    person = Person(server, load_recording(files[0]))
    person.start()
    flags = [
        "--robot.type=xop_g1", "--robot.clock=realtime", "--robot.width=64", "--robot.height=48",
        "--teleop.type=xop", "--teleop.device.type=avp", "--teleop.device.host=127.0.0.1",
        f"--teleop.device.port={server.port}", f"--teleop.retargeter.type={RETARGETER}",
        # A busy machine is slow, and that is no fault of the headset.
        "--teleop.device.stale_s=5", "--teleop.gestures.clutch.max_gap=5",
        "--teleop.gestures.raised.max_gap=5", "--play_sounds=false",
        *record_flags(root, num_episodes=1, episode_time_s=PATIENCE_S, single_task="walk"),
    ]  # fmt: skip
    try:
        run(monkeypatch, "lerobot-record", *flags)
    finally:
        person.over.set()
        person.join(timeout=20)
        server.close()
    assert person.done == ["engaged", "played"]
    (facts,) = read_facts(root)
    print(f"{RETARGETER}: {facts['real_fps']:.1f} frames a second, {facts['length']} frames")
    assert facts["clock"] == "realtime"
    assert not facts["fallen"]
    assert facts["length"] < 0.9 * PATIENCE_S * 25  # a gesture has ended it, not its time
    dataset = LeRobotDataset("local/toy", root=root)
    rows = dataset.hf_dataset.with_format("numpy")
    engaged = np.ravel(rows["operator.engaged"])
    assert not engaged[0]
    assert engaged[-1]
    assert np.count_nonzero(np.diff(engaged)) == 1
    heads = np.stack(rows["operator.head"])[engaged]
    moved = np.ptp(heads[:, :3], axis=0)
    assert moved.max() > 0.1
    assert (np.stack(rows["operator.pinch"])[-1] < [1, 0.02]).all()
    action = np.stack(rows["action"])
    assert np.isfinite(action).all()
    assert np.ptp(action[engaged], axis=0).max() > 0.05
