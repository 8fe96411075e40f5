"""A robot's computer for tests of the page: the real server and clutch, and no robot."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.operator.devices.webxr import WebXrDevice
from xop_lerobot.operator.display import Cue, Display, NoticeBoard, Progress, RecordingRequest
from xop_lerobot.operator.engagement import Clutch, ClutchRequest
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.gestures import Gesture, GestureConfig, GestureReader

CODE = "tested7"
GESTURES = {"engage": "palms up, both hands pinched, held for 1 s"}


def make_picture(height: int = 240, width: int = 320) -> np.ndarray:
    """A floor and a wall, with something red on the left and something green on the right."""
    picture = np.full((height, width, 3), (150, 165, 180), np.uint8)
    picture[height * 2 // 3 :] = (90, 80, 70)
    picture[height // 3 : height * 3 // 4, : width // 4] = (200, 40, 40)
    picture[height // 3 : height * 3 // 4, -width // 4 :] = (40, 170, 60)
    return picture


class Desk:
    """Ticks at 25 Hz: reads the device, follows clutch and gestures, and shows what came of it.

    Attributes:
        frames: What was read in each tick.
        requests: What was asked for of the recording.
        changes: Changes of what is shown, as fields of `Display`; tests set them.
    """

    def __init__(self, port: int) -> None:
        self.device = WebXrDevice(
            # A machine that is busy is slow, and no fault of the page.
            DeviceConfig(
                type="webxr", port=port, code=CODE, stale_s=1.0, max_delay_s=10.0, smoothing=0
            )
        )
        self.device.introduce("xop_g1", GESTURES)
        self.clutch, self.reader = Clutch(), GestureReader(GestureConfig())
        self.board = NoticeBoard()
        self.engaged, self.mode = False, Mode.STATIONARY
        self.frames: list[OperatorFrame | None] = []
        self.requests: list[RecordingRequest] = []
        self.changes: dict = {"progress": Progress(3, 310, 12.4, False)}
        self.pictures = {"head": make_picture()}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    @property
    def address(self) -> str:
        return f"{self.device.url}?code={CODE}"

    @property
    def frame(self) -> OperatorFrame | None:
        return self.frames[-1] if self.frames else None

    def sees_all(self) -> bool:
        """Whether head and both hands are seen."""
        return self.frame is not None and bool(self.frame.tracked.all())

    def __enter__(self) -> Desk:
        self.device.connect()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(timeout=10)
        self.device.disconnect()

    def _run(self) -> None:
        start = time.monotonic()
        while not self._stop.wait(0.04):
            now = time.monotonic() - start
            frame = self.device.read(now)
            self.frames.append(frame)
            self._follow(frame)
            shown = Display(
                time=now,
                engaged=self.engaged,
                mode=self.mode,
                clutch=self.clutch.progress,
                notices=self.board.notices,
                pictures=self.pictures if len(self.frames) % 8 == 1 else {},
            )
            self.device.show(Display(**{**vars(shown), **self.changes}))
            self.requests += self.device.take_requests()

    def _follow(self, frame: OperatorFrame | None) -> None:
        request = self.clutch.update(frame, self.engaged)
        if request is ClutchRequest.ENGAGE:
            self.engaged = True
            self.board.post(Cue.ENGAGED, "Engaged: the robot follows you.")
        elif request is ClutchRequest.LET_GO:
            self.engaged = False
            self.board.post(Cue.DISENGAGED, "Disengaged: you have let go.")
        if frame is not None and self.reader.update(frame) is Gesture.DOUBLE_PINCH:
            self.mode = Mode(1 - self.mode)
            self.board.post(Cue.MODE, f"Mode: {self.mode.name.lower()}.")


def wait_for(condition: Callable[[], object], what: str = "it", timeout: float = 120.0) -> None:
    """Wait until `condition` holds; slow machines are waited for, dead ones are not."""
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, f"{what} does not come"
        time.sleep(0.02)
