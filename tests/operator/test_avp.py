"""A Vision Pro on loopback: poses come out right, and the stream survives what happens to it."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from avp_server import AvpServer, encode, set_matrix, wait_for
from swaying import make_person

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.transforms import quat_rotate
from xop_lerobot.operator.devices import DeviceConfig, live, make_device
from xop_lerobot.operator.devices.avp import AvpDevice, HandUpdate, make_request, parse_update
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.webxr.pairing import MAX_RATE, RateLimit


@pytest.fixture
def server() -> Iterator[AvpServer]:
    made = AvpServer()
    yield made
    made.close()


@pytest.fixture
def device(server) -> Iterator[Any]:
    config = DeviceConfig(type="avp", host="127.0.0.1", port=server.port, smoothing=0)
    made = make_device(config)
    assert isinstance(made, AvpDevice)
    made.connect()
    server.wait_for_clients()
    yield made
    made.disconnect()


def send(server: AvpServer, device: AvpDevice, message: OperatorFrame | bytes) -> None:
    before = device.handled
    server.send(message)
    wait_for(lambda: device.handled > before)


# -- frames, by hand -----------------------------------------------------------------------


def make_update(**matrices) -> bytes:
    """A message with ARKit's own matrices: world x right, y up, z back."""
    update = HandUpdate()
    for name, (axes, position) in matrices.items():
        matrix = np.eye(4)
        matrix[:3, :3] = np.array(axes, dtype=float).T  # each axis in the world
        matrix[:3, 3] = position
        set_matrix(update.Head if name == "head" else getattr(update, name).wristMatrix, matrix)
    return update.SerializeToString()


RIGHT, UP, BACK = np.eye(3)
LEFT, DOWN, FORWARD = -RIGHT, -UP, -BACK


def axes_of(pose: np.ndarray) -> np.ndarray:
    return np.stack([quat_rotate(pose[3:], axis) for axis in np.eye(3)])


def parse(**matrices) -> OperatorFrame:
    frame = parse_update(make_update(**matrices))
    assert isinstance(frame, OperatorFrame)
    return frame


def test_head():
    """1.6 m high, 1 m to the right of and 2 m before the origin: level, then looking left."""
    frame = parse(head=((RIGHT, UP, BACK), (1, 1.6, -2)))
    np.testing.assert_allclose(frame.head, [2, -1, 1.6, 1, 0, 0, 0], atol=1e-6)
    # Looking left, its x is forward, its z (backwards) is right.
    frame = parse(head=((FORWARD, UP, RIGHT), (0, 1.6, 0)))
    np.testing.assert_allclose(axes_of(frame.head), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-6)
    # Looking down, its y is forward, its z up.
    frame = parse(head=((RIGHT, FORWARD, UP), (0, 1.6, 0)))
    np.testing.assert_allclose(axes_of(frame.head), [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-6)


def test_wrists():
    """Palms down, fingers forward: parallel to the world. Palms up, inwards and fingers up."""
    # x of a left wrist goes to the fingers, y out of the palm; of a right one, the other way.
    frame = parse(
        left_hand=((FORWARD, DOWN, np.cross(FORWARD, DOWN)), (-0.2, 1.1, -0.3)),
        right_hand=((BACK, UP, np.cross(BACK, UP)), (0.2, 1.1, -0.3)),
    )
    np.testing.assert_allclose(frame.left_wrist, [0.3, 0.2, 1.1, 1, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(frame.right_wrist, [0.3, -0.2, 1.1, 1, 0, 0, 0], atol=1e-6)

    frame = parse(
        left_hand=((FORWARD, UP, np.cross(FORWARD, UP)), (0, 1, 0)),
        right_hand=((BACK, DOWN, np.cross(BACK, DOWN)), (0, 1, 0)),
    )
    for pose in (frame.left_wrist, frame.right_wrist):
        np.testing.assert_allclose(axes_of(pose), [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-6)

    frame = parse(
        left_hand=((UP, RIGHT, np.cross(UP, RIGHT)), (0, 1, 0)),
        right_hand=((DOWN, RIGHT, np.cross(DOWN, RIGHT)), (0, 1, 0)),
    )
    # Fingers up; palms face each other, so the backs of the hands face outwards.
    np.testing.assert_allclose(axes_of(frame.left_wrist)[[0, 2]], [[0, 0, 1], [0, 1, 0]], atol=1e-6)
    np.testing.assert_allclose(
        axes_of(frame.right_wrist)[[0, 2]], [[0, 0, 1], [0, -1, 0]], atol=1e-6
    )


def test_messages_that_are_no_frame():
    assert parse_update(b"\xff\xff\xff") == "no_message"
    for signal in (666, 777, 778, 888, 999):
        update = HandUpdate()
        update.Head.m00 = signal
        assert parse_update(update.SerializeToString()) == "signal"
    zeros = HandUpdate()
    zeros.Head.m00 = zeros.left_hand.wristMatrix.m00 = 0.0
    for empty in (HandUpdate(), zeros):  # what a client of too old a version is sent
        assert parse_update(empty.SerializeToString()) == "empty"


def test_request():
    request = HandUpdate()
    request.ParseFromString(make_request("192.168.1.27"))
    head = request.Head
    assert [head.m00, head.m01, head.m02, head.m03, head.m10] == [888, 192, 168, 1, 27]
    assert head.m30 == 25000


# -- over the wire -------------------------------------------------------------------------


def test_what_is_sent_is_read(server, device: Any):
    assert device.read(0.0) is None
    for i in range(20):
        wanted = make_person(i / 100)
        send(server, device, wanted)
        frame = device.read(0.0)
        assert frame.tracked.all()
        for name in ("head", "left_wrist", "right_wrist", "pinch"):
            np.testing.assert_allclose(getattr(frame, name), getattr(wanted, name), atol=1e-5)
    assert device.status.counts == {"taken": 20}
    request = HandUpdate()
    request.ParseFromString(server.requests[0])
    assert [request.Head.m00, request.Head.m01] == [888, 127]


def test_bad_messages_are_counted_and_the_stream_goes_on(server, device: Any):
    send(server, device, make_person(0))
    send(server, device, b"\xff\xff\xff")
    send(server, device, HandUpdate().SerializeToString())
    send(server, device, make_person(0.01))
    assert device.status.counts == {"taken": 2, "no_message": 1, "empty": 1}
    assert device.status.connections == 1
    assert device.trouble == ""


def test_an_app_that_refuses_this_version_is_told_as_such(server, device: Any, caplog):
    for _ in range(3):
        send(server, device, HandUpdate().SerializeToString())
    assert device.read(0.0) is None
    assert device.trouble == (
        f"Vision Pro at 127.0.0.1:{server.port}: Tracking Streamer refuses this version of "
        "xop-lerobot, which speaks 2.50 of its protocol: it sends empty updates"
    )
    assert caplog.text.count("Tracking Streamer refuses this version") == 1
    send(server, device, make_person(0))  # the app is another one now
    assert device.trouble == ""
    assert device.read(0.0).tracked.all()


def test_a_silent_stream_is_stale_and_then_goes_on(server, device: Any):
    send(server, device, make_person(0))
    assert device.read(0.0).tracked[0]
    time.sleep(0.3)
    stale = device.read(0.0)
    assert not stale.tracked.any()
    assert stale.time - device.status.age < stale.time
    send(server, device, make_person(0.01))
    assert device.read(0.0).tracked.all()


def test_a_backlog_leaves_no_lag(server, device: Any):
    for i in range(60):
        server.send(make_person(i / 100))
    wait_for(lambda: device.handled == 60)
    np.testing.assert_allclose(device.read(0.0).head, make_person(0.59).head, atol=1e-5)


def test_it_connects_again_and_the_head_is_lost_once(server, device: Any, monkeypatch, caplog):
    monkeypatch.setattr(live, "RETRY_S", 0.05)
    send(server, device, make_person(0))
    device.read(0.0)
    server.hang_up()
    wait_for(lambda: not device.status.connected)
    server.wait_for_clients()
    elsewhere = make_person(0.5)
    elsewhere = dataclasses.replace(elsewhere, head=elsewhere.head + [9, 0, 0, 0, 0, 0, 0])
    send(server, device, elsewhere)
    assert not device.read(0.0).tracked.any()
    assert device.read(0.0).tracked[0]
    assert device.status.connections == 2
    assert "the stream has ended. Trying again every" in caplog.text


def test_nobody_answers(monkeypatch, caplog):
    monkeypatch.setattr(live, "RETRY_S", 0.05)
    server = AvpServer()
    port = server.port
    server.close()
    device: Any = make_device(DeviceConfig(type="avp", host="127.0.0.1", port=port))
    device.connect()
    wait_for(lambda: device.status.trouble != "")
    assert device.read(0.0) is None
    assert f"Vision Pro at 127.0.0.1:{port}: nobody answers. Is Tracking" in caplog.text
    assert caplog.text.count("nobody answers") == 1
    device.disconnect()
    device.disconnect()


def test_an_oversized_message_ends_the_connection_and_the_next_is_made(
    server, device, monkeypatch, caplog
):
    monkeypatch.setattr(live, "RETRY_S", 0.05)
    send(server, device, make_person(0))
    server.send(b"\0" * 300_000)
    wait_for(lambda: len(server.requests) == 2)
    assert "it sent a message of more than 262144 bytes" in caplog.text
    send(server, device, make_person(0.01))
    assert device.status.connections == 2


def test_a_flood_ends_the_connection_and_the_next_is_made(server, device, monkeypatch, caplog):
    """A stream that is faster than any headset would take the processor from the robot's loop."""
    monkeypatch.setattr(live, "RETRY_S", 0.05)
    monkeypatch.setattr(RateLimit, "is_broken", lambda limit, time: count(limit) > MAX_RATE)
    taken = []

    def count(limit: RateLimit) -> int:  # as within a second, however slow the machine is
        taken.append(limit)
        return taken.count(limit)

    send(server, device, make_person(0))
    for i in range(MAX_RATE + 1):
        server.send(make_person(i / 1000))
    wait_for(lambda: len(server.requests) == 2)
    assert "it sends more than 400 messages in a second" in caplog.text
    send(server, device, make_person(0.01))
    assert device.status.connections == 2


def test_the_rate_is_counted_over_so_many_frames_and_no_more():
    device: Any = make_device(DeviceConfig(type="avp", host="127.0.0.1"))
    now = 0.0
    device.clock = lambda: now
    for i in range(3 * MAX_RATE):
        now = i / 5000
        device.receive(make_person(now))
    assert len(device._stamps) == MAX_RATE == device.status.rate


def test_it_needs_a_host():
    with pytest.raises(BadValue, match=r"device 'avp' needs the address of the headset"):
        make_device(DeviceConfig(type="avp"))


def test_the_other_client_reads_the_same(tmp_path):
    """`avp-stream` as a second client of our server: same head and wrists, in its convention."""
    python = os.environ.get("XOP_AVP_STREAM_PYTHON", "")
    if not Path(python).is_file():
        pytest.skip("XOP_AVP_STREAM_PYTHON names no Python that has avp-stream 2.51")
    server = AvpServer(port=12345)  # the package knows no other
    script = tmp_path / "client.py"
    script.write_text(
        "import os, sys, numpy as np\n"
        "from avp_stream import VisionProStreamer\n"
        "data = VisionProStreamer(ip='127.0.0.1', record=False).get_latest()\n"
        "keys = ('head', 'left_wrist', 'right_wrist')\n"
        "np.savez(sys.argv[1], pinch=[data['left_pinch_distance'], data['right_pinch_distance']],"
        " **{k: np.asarray(data[k]) for k in keys})\n"
        "os._exit(0)\n"
    )
    out = tmp_path / "seen.npz"
    frame = make_person(0.3)
    client = subprocess.Popen([python, str(script), str(out)])
    try:
        end = time.monotonic() + 60
        while client.poll() is None and time.monotonic() < end:
            server.send(encode(frame))
            time.sleep(0.05)
        assert client.returncode == 0
    finally:
        client.kill()
        client.wait()
        server.close()
    seen = np.load(out)
    ours = parse_update(encode(frame))
    assert isinstance(ours, OperatorFrame)
    # Theirs is x right, y forward, z up: a quarter turn from ours.
    turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    for name in ("head", "left_wrist", "right_wrist"):
        np.testing.assert_allclose(turn @ seen[name][0, :3, 3], ours.pose(name)[:3], atol=1e-5)
    # Their head looks along y with x to the right; of a left wrist x goes to the fingers, of a
    # right one away from them.
    axes = turn @ seen["head"][0, :3, :3]
    np.testing.assert_allclose(axes[:, 1], axes_of(ours.head)[0], atol=1e-5)
    np.testing.assert_allclose(axes[:, 0], -axes_of(ours.head)[1], atol=1e-5)
    for name, sign in (("left_wrist", 1), ("right_wrist", -1)):
        fingers = turn @ seen[name][0, :3, 0] * sign
        np.testing.assert_allclose(fingers, axes_of(ours.pose(name))[0], atol=1e-5)
    np.testing.assert_allclose(seen["pinch"], ours.pinch, atol=1e-5)
