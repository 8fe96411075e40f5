"""Apple Vision Pro, through its app Tracking Streamer.

The headset is the server: the rpc `StreamHandUpdates` of `handtracking.HandTrackingService` takes
one `HandUpdate` and streams more of them. Descriptors are built here, so no generated code is
needed; both ends of a test use the same ones.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import grpc
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError, Message

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.transforms import make_pose, quat_from_matrix
from xop_lerobot.operator.axes import WORLD
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.operator.devices.live import LiveDevice, StreamLost
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.webxr.addresses import find_own_address
from xop_lerobot.operator.webxr.pairing import MAX_RATE, RateLimit

SERVICE = "handtracking.HandTrackingService"
METHOD = f"/{SERVICE}/StreamHandUpdates"
PORT = 12345
DISCOVERY = 888.0
"""`Head.m00` of a request that names its sender; the app sends zeros to others."""
VERSION = "2.50"
"""The version of the protocol that we speak."""
VERSION_CODE = 25000
"""`Head.m30` of a request: the same as a number."""
SIGNALS = frozenset({666.0, 777.0, 778.0, 888.0, 999.0})
"""`Head.m00` of messages that hold something else than a head."""
THUMB_TIP, INDEX_TIP = 4, 9
"""Joints of a skeleton."""
ORTHONORMAL = 0.02
"""How far R Rᵀ of a rotation may be from the identity."""

ENTRIES = tuple(f"m{row}{column}" for row in range(4) for column in range(4))

# Columns: our axes in those of the anchor. The head's anchor lies as the world does. That of a
# left wrist has x towards the fingers, y out of the palm; of a right one both the other way.
AXES = {
    "head": WORLD.T,
    "left_wrist": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "right_wrist": np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]]),
}


def _make_message_class() -> type[Message]:
    label = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(
        name="xop_handtracking.proto", package="handtracking", syntax="proto3"
    )
    matrix = file.message_type.add(name="Matrix4x4")
    for number, entry in enumerate(ENTRIES, start=1):
        matrix.field.add(
            name=entry, number=number, label=label.LABEL_OPTIONAL, type=label.TYPE_FLOAT
        )

    def add(name: str, fields: dict[str, str], repeated: bool = False) -> None:
        message = file.message_type.add(name=name)
        for number, (field, kind) in enumerate(fields.items(), start=1):
            message.field.add(
                name=field,
                number=number,
                label=label.LABEL_REPEATED if repeated else label.LABEL_OPTIONAL,
                type=label.TYPE_MESSAGE,
                type_name=f".handtracking.{kind}",
            )

    add("Skeleton", {"jointMatrices": "Matrix4x4"}, repeated=True)
    add("Hand", {"wristMatrix": "Matrix4x4", "skeleton": "Skeleton"})
    add("HandUpdate", {"left_hand": "Hand", "right_hand": "Hand", "Head": "Matrix4x4"})
    pool = descriptor_pool.DescriptorPool()  # of its own: other packages may know the same names
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("handtracking.HandUpdate"))


HandUpdate: Any = _make_message_class()
"""Class of the one message of the protocol; built here, so no checker knows its fields."""


def make_request(client_ip: str) -> bytes:
    """Make the request of a stream.

    Args:
        client_ip: Our own IPv4 address, as the headset would see it.
    """
    request = HandUpdate()
    head = request.Head
    octets = [float(octet) for octet in client_ip.split(".")]
    values = (DISCOVERY, *octets, VERSION_CODE)
    for entry, value in zip(("m00", "m01", "m02", "m03", "m10", "m30"), values, strict=True):
        setattr(head, entry, value)
    return request.SerializeToString()


def parse_update(message: bytes) -> OperatorFrame | str:
    """Decode a message of the stream.

    Returns:
        The frame at time 0, in which what is not valid is NaN; or why there is none: `empty` is
        what the app sends to a client whose version it refuses.
    """
    update = HandUpdate()
    try:
        update.ParseFromString(message)
    except DecodeError:
        return "no_message"
    head = update.Head
    if head.m00 in SIGNALS:
        return "signal"
    anchors = (head, update.left_hand.wristMatrix, update.right_hand.wristMatrix)
    if not any(read_matrix(anchor).any() for anchor in anchors):
        return "empty"
    wrists, pinch = [], []
    for side in ("left", "right"):
        hand = getattr(update, f"{side}_hand")
        wrists.append(_to_pose(read_matrix(hand.wristMatrix), f"{side}_wrist"))
        pinch.append(_measure_pinch(hand.skeleton.jointMatrices))
    return OperatorFrame(0.0, _to_pose(read_matrix(head), "head"), *wrists, pinch=np.array(pinch))


def read_matrix(message: Message) -> np.ndarray:
    """Read a `Matrix4x4`, whose entries are m<row><column>. Shape (4, 4)."""
    return np.array([getattr(message, entry) for entry in ENTRIES]).reshape(4, 4)


def _to_pose(matrix: np.ndarray, name: str) -> np.ndarray:
    """Pose in the operator's world of an anchor; NaN if the matrix is no pose. Shape (7,)."""
    rotation = matrix[:3, :3]
    if not np.isfinite(matrix).all() or np.abs(rotation).max() > 1 + ORTHONORMAL:
        return np.full(7, np.nan)
    skew = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if skew > ORTHONORMAL or np.linalg.det(rotation) < 0:
        return np.full(7, np.nan)
    quat = quat_from_matrix(WORLD @ rotation @ AXES[name])
    return make_pose(WORLD @ matrix[:3, 3], quat)


def _measure_pinch(joints: list[Message]) -> float:
    """Distance of the tips of thumb and index [m]; NaN without a skeleton."""
    if len(joints) <= INDEX_TIP:
        return np.nan
    thumb, index = (
        np.array([getattr(joints[i], f"m{row}3") for row in range(3)])
        for i in (THUMB_TIP, INDEX_TIP)
    )
    return float(np.linalg.norm(thumb - index))


MAX_MESSAGE = 256 * 1024
"""Longer messages end the connection; one of two hands has about 5 kB [bytes]."""


class AvpDevice(LiveDevice):
    """A Vision Pro that runs Tracking Streamer; the headset is the server.

    The stream has neither stamps nor flags: frames are stamped at their receipt, and what is
    lost is told from what no longer changes.

    Args:
        config: Its settings; `host` is required.

    Raises:
        BadValue: If there is no host.
    """

    def __init__(self, config: DeviceConfig, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(config, clock=clock)
        if not config.host:
            raise BadValue(
                "device 'avp' needs the address of the headset: --teleop.device.host=ADDRESS "
                "(Tracking Streamer shows it when it starts)"
            )
        self._target = f"{config.host}:{config.port or PORT}"
        self._call: grpc.Call | None = None
        self._call_lock = threading.Lock()

    @property
    def address(self) -> str:
        """The headset's address."""
        return f"Vision Pro at {self._target}"

    def stream(self) -> None:
        """Connect and receive until the stream ends.

        Raises:
            StreamLost: If it ends, or nobody answers.
        """
        options = [
            ("grpc.max_receive_message_length", MAX_MESSAGE),
            ("grpc.use_local_subchannel_pool", 1),
            ("grpc.enable_http_proxy", 0),  # the headset is in the room
        ]
        with grpc.insecure_channel(self._target, options=options) as channel:
            # Messages stay bytes here: a bad one is counted, and does not end the stream.
            call = channel.unary_stream(METHOD)(make_request(find_own_address(self._target)))
            with self._call_lock:
                self._call = call
            if self._stop.is_set():
                call.cancel()
            rate = RateLimit()
            try:
                for message in call:
                    if rate.is_broken(time.monotonic()):
                        raise StreamLost(f"it sends more than {MAX_RATE} messages in a second")
                    self.hear()
                    self._take(parse_update(message))
            except grpc.RpcError as error:
                raise StreamLost(_describe(error)) from None
            finally:
                with self._call_lock:
                    self._call = None

    def _take(self, frame: OperatorFrame | str) -> None:
        refused = (
            f"{self.address}: Tracking Streamer refuses this version of xop-lerobot, which speaks "
            f"{VERSION} of its protocol: it sends empty updates"
        )
        if isinstance(frame, OperatorFrame):
            if self._trouble == refused:
                self._say("")
            self.receive(frame)
            return
        if frame == "empty":
            self._say(refused)
        self.refuse(frame)

    def interrupt(self) -> None:
        """End the call, if there is one."""
        with self._call_lock:
            if self._call is not None:
                self._call.cancel()


def _describe(error: grpc.RpcError) -> str:
    code = error.code() if isinstance(error, grpc.Call) else None
    if code is grpc.StatusCode.UNAVAILABLE:
        return (
            "nobody answers. Is Tracking Streamer open in the headset, and are both in the same "
            "network"
        )
    if code is grpc.StatusCode.CANCELLED:
        return "the connection was closed"
    if code is grpc.StatusCode.RESOURCE_EXHAUSTED:
        return f"it sent a message of more than {MAX_MESSAGE} bytes"
    if code is grpc.StatusCode.UNIMPLEMENTED:
        return "what answers there is not Tracking Streamer"
    return f"the stream broke off ({code.name if code is not None else error})"
