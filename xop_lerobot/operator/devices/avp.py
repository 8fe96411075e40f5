"""Apple Vision Pro with the app Tracking Streamer.

The headset is the gRPC server: `StreamHandUpdates` of `handtracking.HandTrackingService` takes one
`HandUpdate` and streams more of them. Message descriptors are built here, so no generated code is
needed.
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
"""`Head.m00` of a request that states its sender; the app sends zeros to others."""
VERSION = "2.50"
"""Protocol version of this client."""
VERSION_CODE = 25000
"""`Head.m30` of a request: the version as a number."""
SIGNALS = frozenset({666.0, 777.0, 778.0, 888.0, 999.0})
"""`Head.m00` of messages that contain no head pose."""
THUMB_TIP, INDEX_TIP = 4, 9
"""Joint indices of a skeleton."""
ORTHONORMAL = 0.02
"""Largest deviation of R Rᵀ from the identity for a rotation."""

ENTRIES = tuple(f"m{row}{column}" for row in range(4) for column in range(4))

# Columns: our axes in the anchor's frame. The head's anchor is aligned with the world. A left wrist
# anchor has x towards the fingers and y out of the palm; a right one has both reversed.
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
    pool = descriptor_pool.DescriptorPool()  # other packages may define the same names
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("handtracking.HandUpdate"))


HandUpdate: Any = _make_message_class()
"""Message class of the protocol; built at runtime, so type checkers do not know its fields."""


def make_request(client_ip: str) -> bytes:
    """Make the request that starts a stream.

    Args:
        client_ip: Own IPv4 address, as seen by the headset.
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
        The frame at time 0, with NaN for invalid values; or the reason why there is none: `empty`
        is what the app sends to a client whose version it refuses.
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
    """Read a `Matrix4x4`, whose entries are named m<row><column>. Shape (4, 4)."""
    return np.array([getattr(message, entry) for entry in ENTRIES]).reshape(4, 4)


def _to_pose(matrix: np.ndarray, name: str) -> np.ndarray:
    """Pose of an anchor in the operator's world; NaN if the matrix is not a pose. Shape (7,)."""
    rotation = matrix[:3, :3]
    if not np.isfinite(matrix).all() or np.abs(rotation).max() > 1 + ORTHONORMAL:
        return np.full(7, np.nan)
    skew = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if skew > ORTHONORMAL or np.linalg.det(rotation) < 0:
        return np.full(7, np.nan)
    quat = quat_from_matrix(WORLD @ rotation @ AXES[name])
    return make_pose(WORLD @ matrix[:3, 3], quat)


def _measure_pinch(joints: list[Message]) -> float:
    """Distance of the thumb and index tips [m]; NaN without a skeleton."""
    if len(joints) <= INDEX_TIP:
        return np.nan
    thumb, index = (
        np.array([getattr(joints[i], f"m{row}3") for row in range(3)])
        for i in (THUMB_TIP, INDEX_TIP)
    )
    return float(np.linalg.norm(thumb - index))


MAX_MESSAGE = 256 * 1024
"""Largest message; longer ones end the connection. One with two hands has about 5 kB [bytes]."""


class AvpDevice(LiveDevice):
    """A Vision Pro running Tracking Streamer, which is the server.

    The stream has neither stamps nor tracking flags: frames are stamped at receipt, and lost limbs
    are detected by poses that no longer change.

    Args:
        config: Device settings; `host` is required.

    Raises:
        BadValue: If `host` is missing.
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
        """Address of the headset."""
        return f"Vision Pro at {self._target}"

    def stream(self) -> None:
        """Connect and receive until the stream ends.

        Raises:
            StreamLost: If it ends, or nobody answers.
        """
        options = [
            ("grpc.max_receive_message_length", MAX_MESSAGE),
            ("grpc.use_local_subchannel_pool", 1),
            ("grpc.enable_http_proxy", 0),  # the headset is in the local network
        ]
        with grpc.insecure_channel(self._target, options=options) as channel:
            # No deserializer: a malformed message is then counted instead of ending the stream.
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
        """Cancel the call, if there is one."""
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
