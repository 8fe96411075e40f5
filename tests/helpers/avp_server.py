"""A Vision Pro for tests: a gRPC server on loopback that speaks Tracking Streamer's protocol."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import grpc
import numpy as np
from ports import find_port

from xop_lerobot.core.transforms import quat_rotate
from xop_lerobot.operator.devices.avp import (
    AXES,
    ENTRIES,
    INDEX_TIP,
    SERVICE,
    THUMB_TIP,
    WORLD,
    HandUpdate,
)
from xop_lerobot.operator.frame import OperatorFrame

SIDES = ("left", "right")
NUM_JOINTS = 27


def rotation(quat: np.ndarray) -> np.ndarray:
    return np.stack([quat_rotate(quat, axis) for axis in np.eye(3)], axis=1)


def set_matrix(message, matrix: np.ndarray) -> None:
    for entry, value in zip(ENTRIES, matrix.ravel(), strict=True):
        setattr(message, entry, float(value))


def encode(frame: OperatorFrame) -> bytes:
    """The message that the app would send of a person as in `frame`."""
    update = HandUpdate()

    def anchor(pose: np.ndarray, name: str) -> np.ndarray:
        matrix = np.eye(4)
        matrix[:3, :3] = WORLD.T @ rotation(pose[3:]) @ AXES[name].T
        matrix[:3, 3] = WORLD.T @ pose[:3]
        return matrix

    set_matrix(update.Head, anchor(frame.head, "head"))
    for side, distance in zip(SIDES, frame.pinch, strict=True):
        hand = getattr(update, f"{side}_hand")
        set_matrix(hand.wristMatrix, anchor(frame.pose(f"{side}_wrist"), f"{side}_wrist"))
        for joint in range(NUM_JOINTS):
            matrix = np.eye(4)
            forwards = 1 if side == "left" else -1
            if joint == THUMB_TIP:
                matrix[:3, 3] = [0.12 * forwards, 0, 0]
            elif joint == INDEX_TIP:
                matrix[:3, 3] = [0.12 * forwards, 0, distance]
            set_matrix(hand.skeleton.jointMatrices.add(), matrix)
    return update.SerializeToString()


class AvpServer:
    """Streams what is given to `send` to every client; `requests` holds what they asked with."""

    def __init__(self, port: int = 0) -> None:
        self.requests: list[bytes] = []
        self._clients: list[queue.Queue[bytes | None]] = []
        self._server = grpc.server(ThreadPoolExecutor(4), options=[("grpc.so_reuseport", 0)])
        handler = grpc.unary_stream_rpc_method_handler(self._stream)  # bytes to bytes
        self._server.add_generic_rpc_handlers(
            (grpc.method_handlers_generic_handler(SERVICE, {"StreamHandUpdates": handler}),)
        )
        self.port = self._server.add_insecure_port(f"127.0.0.1:{port or find_port()}")
        assert self.port
        self._server.start()

    def _stream(self, request: bytes, context: grpc.ServicerContext) -> Iterator[bytes]:
        mine: queue.Queue[bytes | None] = queue.Queue()
        self.requests.append(request)
        self._clients.append(mine)
        context.add_callback(lambda: mine.put(None))
        while (message := mine.get()) is not None:
            yield message

    def send(self, message: bytes | OperatorFrame) -> None:
        message = encode(message) if isinstance(message, OperatorFrame) else message
        for client in self._clients:
            client.put(message)

    def wait_for_clients(self, number: int = 1, timeout: float = 120.0) -> None:
        wait_for(lambda: len(self._clients) >= number, timeout)

    def hang_up(self) -> None:
        """End the calls of all clients."""
        clients, self._clients = self._clients, []
        for client in clients:
            client.put(None)

    def close(self) -> None:
        self.hang_up()
        self._server.stop(grace=0).wait()


def wait_for(condition, timeout: float = 120.0) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "it does not come"
        time.sleep(0.001)
