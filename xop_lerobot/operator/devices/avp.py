"""Apple Vision Pro, over the Tracking Streamer app that runs in it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import grpc

from xop_lerobot.core.errors import BadValue
from xop_lerobot.operator.devices.avp_protocol import (
    METHOD,
    PORT,
    VERSION,
    make_request,
    parse_update,
)
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.operator.devices.live import LiveDevice, StreamLost
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.webxr.addresses import find_own_address
from xop_lerobot.operator.webxr.pairing import MAX_RATE, RateLimit

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
