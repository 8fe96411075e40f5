"""A page for tests: what a headset's browser would send, over a real WebSocket."""

from __future__ import annotations

import json
import ssl
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from avp_server import rotation, wait_for
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from xop_lerobot.core.transforms import quat_from_matrix
from xop_lerobot.operator.axes import WORLD
from xop_lerobot.operator.devices.webxr import WebXrDevice
from xop_lerobot.operator.frame import OperatorFrame

CODE = "TESTCODE"
AHEAD_S = 1000.0
"""By how much the page's clock is ahead of the server's, in lock-step [s]."""


def to_webxr(pose: np.ndarray) -> list[float]:
    """Pose of ours as x y z qx qy qz qw in WebXR's world, of a head or a wrist."""
    position = WORLD.T @ pose[:3]
    quat = quat_from_matrix(WORLD.T @ rotation(pose[3:]) @ WORLD)
    return [round(float(x), 5) for x in (*position, *quat[1:], quat[0])]


def make_hand(pose: np.ndarray, pinch: float) -> dict[str, Any]:
    thumb = np.array([0.0, 1, 0])
    return {
        "wrist": to_webxr(pose),
        "thumb": list(thumb),
        "index": list(thumb + [0, pinch, 0]),
        "emulated": False,
    }


def encode(frame: OperatorFrame, number: int, sent: float) -> dict[str, Any]:
    """The message of a page whose wearer is as in `frame`, sent at `sent` [s] of its clock."""
    return {
        "type": "frame",
        "seq": number,
        "t": sent * 1e3,
        "source": "hands",
        "head": to_webxr(frame.head) if frame.tracked[0] else None,
        "left": make_hand(frame.left_wrist, frame.pinch[0]) if frame.tracked[1] else None,
        "right": make_hand(frame.right_wrist, frame.pinch[1]) if frame.tracked[2] else None,
    }


class Page:
    """A connected page. `texts` holds all messages that came, `pictures` all that were binary."""

    def __init__(
        self,
        device: WebXrDevice,
        role: str = "operator",
        code: str = CODE,
        clock: Callable[[], float] = time.monotonic,
        answers: bool = True,
        origin: str | None = None,
        reads: bool = True,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self.clock, self.answers = clock, answers
        self.texts: list[dict[str, Any]] = []
        self.pictures: list[bytes] = []
        if device.certificate is not None:
            tls = ssl.create_default_context(cafile=str(device.certificate.path))
        self.ws = connect(
            f"{device.url.replace('http', 'ws', 1)}ws?code={code}&role={role}",
            ssl=tls,
            origin=origin,  # type: ignore[arg-type]
            open_timeout=120,
            proxy=None,
        )
        self._thread = threading.Thread(target=self._listen, daemon=True)
        if reads:
            self._thread.start()

    def _listen(self) -> None:
        try:
            for message in self.ws:
                if isinstance(message, bytes):
                    self.pictures.append(message)
                    continue
                values = json.loads(message)
                if values["type"] == "ping" and self.answers:
                    self.send({"type": "pong", "id": values["id"], "t": self.clock() * 1e3})
                self.texts.append(values)
        except ConnectionClosed:
            pass

    def send(self, message: dict[str, Any] | str | bytes) -> None:
        self.ws.send(json.dumps(message) if isinstance(message, dict) else message)

    def of_type(self, kind: str) -> list[dict[str, Any]]:
        return [values for values in list(self.texts) if values["type"] == kind]

    def wait_for(self, kind: str) -> dict[str, Any]:
        wait_for(lambda: self.of_type(kind))
        return self.of_type(kind)[-1]

    def wait_until_closed(self) -> tuple[int | None, str]:
        self._thread.join(timeout=120)
        assert not self._thread.is_alive()
        return self.ws.close_code, self.ws.close_reason or ""

    def begin_to_read(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self.ws.close()
        self._thread.join(timeout=120)
