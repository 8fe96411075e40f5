"""A WebXR headset: its poses in our convention, and what goes over the wire."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import time
from collections.abc import Iterator

import numpy as np
import pytest
from avp_server import wait_for
from PIL import Image
from ports import find_port
from swaying import make_person
from webxr_client import CODE, Page, encode

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.transforms import quat_from_matrix, quat_rotate
from xop_lerobot.operator.devices import DeviceConfig, make_device
from xop_lerobot.operator.devices.webxr import PortTaken, WebXrDevice
from xop_lerobot.operator.display import Cue, Display, Notice, Progress, RecordingRequest
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.webxr.client import ClockOffset
from xop_lerobot.operator.webxr.delay_meter import MAX_FRAMES, DelayMeter
from xop_lerobot.operator.webxr.protocol import Bye, FrameMessage, Pong, parse_message

RIGHT, UP, BACK = np.eye(3)
LEFT, DOWN, FORWARD = -RIGHT, -UP, -BACK


# -- frames, by hand -----------------------------------------------------------------------


def pose(axes, position) -> list[float]:
    """x y z qx qy qz qw of a space whose axes point as given, in WebXR: x right, y up, z back."""
    w, x, y, z = quat_from_matrix(np.array(axes, dtype=float).T)
    return [*map(float, position), x, y, z, w]


def axes_of(found: np.ndarray) -> np.ndarray:
    return np.stack([quat_rotate(found[3:], axis) for axis in np.eye(3)])


def parse(source="hands", **limbs) -> OperatorFrame:
    values = {"type": "frame", "seq": 7, "t": 1500.0, "source": source, "head": None, **limbs}
    message = parse_message(json.dumps(values))
    assert isinstance(message, FrameMessage)
    assert (message.number, message.sent, message.source) == (7, 1.5, source)
    return message.frame


def make_joints(axes, position) -> dict:
    return {"wrist": pose(axes, position), "thumb": [0.1, 1, 0], "index": [0.1, 1.03, 0.04]}


def test_head():
    """1.6 m high, 1 m to the right of and 2 m before the origin: level, then looking left."""
    frame = parse(head=pose((RIGHT, UP, BACK), (1, 1.6, -2)))
    np.testing.assert_allclose(frame.head, [2, -1, 1.6, 1, 0, 0, 0], atol=1e-9)
    assert frame.tracked.tolist() == [True, False, False]
    frame = parse(head=pose((FORWARD, UP, RIGHT), (0, 1.6, 0)))
    np.testing.assert_allclose(axes_of(frame.head), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-9)
    # Looking down, its y is forward, its z up.
    frame = parse(head=pose((RIGHT, FORWARD, UP), (0, 1.6, 0)))
    np.testing.assert_allclose(axes_of(frame.head), [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-9)


def test_wrists():
    """A wrist has z away from the fingers and y out of the back of the hand, in both hands."""
    # Palms down, fingers forward: parallel to the world.
    frame = parse(
        left=make_joints((RIGHT, UP, BACK), (-0.2, 1.1, -0.3)),
        right=make_joints((RIGHT, UP, BACK), (0.2, 1.1, -0.3)),
    )
    np.testing.assert_allclose(frame.left_wrist, [0.3, 0.2, 1.1, 1, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(frame.right_wrist, [0.3, -0.2, 1.1, 1, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(frame.pinch, [0.05, 0.05])
    # Palms up, fingers forward.
    frame = parse(
        left=make_joints((LEFT, DOWN, BACK), (0, 1, 0)),
        right=make_joints((LEFT, DOWN, BACK), (0, 1, 0)),
    )
    for found in (frame.left_wrist, frame.right_wrist):
        np.testing.assert_allclose(axes_of(found), [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-9)
    # Fingers up, palms towards each other: the back of the left hand shows to the left.
    frame = parse(
        left=make_joints((np.cross(LEFT, DOWN), LEFT, DOWN), (0, 1, 0)),
        right=make_joints((np.cross(RIGHT, DOWN), RIGHT, DOWN), (0, 1, 0)),
    )
    np.testing.assert_allclose(axes_of(frame.left_wrist)[[0, 2]], [[0, 0, 1], [0, 1, 0]], atol=1e-9)
    np.testing.assert_allclose(
        axes_of(frame.right_wrist)[[0, 2]], [[0, 0, 1], [0, -1, 0]], atol=1e-9
    )


def test_controllers():
    """A rod in each fist, upright, thumbs up, forearms forward; then palms down."""
    # z of a grip points from the thumb along the rod, x to the right of the wearer in both hands
    # (out of the back of the right one), y to the forearm.
    frame = parse(
        "controllers",
        left={"grip": pose((RIGHT, BACK, DOWN), (-0.2, 1.1, -0.3)), "trigger": 1},
        right={"grip": pose((RIGHT, BACK, DOWN), (0.2, 1.1, -0.3)), "trigger": 0.25},
    )
    for found, y in ((frame.left_wrist, 1), (frame.right_wrist, -1)):
        # Palms show inwards, so the back of the left hand to the left; the wrist is 8 cm behind.
        np.testing.assert_allclose(axes_of(found)[[0, 2]], [[1, 0, 0], [0, y, 0]], atol=1e-9)
        np.testing.assert_allclose(found[:3], [0.22, 0.2 * y, 1.1], atol=1e-9)
    np.testing.assert_allclose(frame.pinch, [0, 0.06])
    frame = parse(
        "controllers",
        left={"grip": pose((DOWN, BACK, LEFT), (-0.2, 1.1, -0.38)), "trigger": 0},
        right={"grip": pose((UP, BACK, RIGHT), (0.2, 1.1, -0.38)), "trigger": 0},
    )
    for found, y in ((frame.left_wrist, 1), (frame.right_wrist, -1)):
        np.testing.assert_allclose(found[:3], [0.3, 0.2 * y, 1.1], atol=1e-9)
        np.testing.assert_allclose(axes_of(found), np.eye(3), atol=1e-9)


def test_standin():
    level = pose((RIGHT, UP, BACK), (0.2, 1.1, -0.3))
    frame = parse("standin", right={"wrist": level, "pinch": 0.03})
    np.testing.assert_allclose(frame.right_wrist, [0.3, -0.2, 1.1, 1, 0, 0, 0], atol=1e-9)
    assert frame.pinch[1] == 0.03
    assert frame.tracked.tolist() == [False, False, True]


def test_a_hand_may_name_its_own_source():
    level = pose((RIGHT, UP, BACK), (-0.2, 1.1, -0.3))
    grip = pose((UP, BACK, RIGHT), (0.2, 1.1, -0.38))
    frame = parse(
        "controllers",
        left={"source": "standin", "wrist": level, "pinch": 0.03},
        right={"grip": grip, "trigger": 0},
    )
    np.testing.assert_allclose(frame.left_wrist[:3], [0.3, 0.2, 1.1], atol=1e-9)
    np.testing.assert_allclose(frame.right_wrist[:3], [0.3, -0.2, 1.1], atol=1e-9)
    np.testing.assert_allclose(frame.pinch, [0.03, 0.08])
    for unknown in ("feet", None, []):
        bad = parse(left={"source": unknown, "wrist": level, "pinch": 0.03})
        assert np.isnan(bad.left_wrist).all()


def test_a_guessed_hand_is_not_seen():
    hand = make_joints((RIGHT, UP, BACK), (0, 1, 0))
    assert not parse(left=hand | {"emulated": True}).tracked.any()
    assert parse(left=hand | {"emulated": False}).tracked[1]


@pytest.mark.parametrize(
    "head",
    [
        [0, 1.6, 0, 0, 0, 0],
        [0, 1.6, 0, 0, 0, 0, "1"],
        [0, 1.6, 0, 0, 0, 0, True],
        [math.nan, 1.6, 0, 0, 0, 0, 1],
        [math.inf, 1.6, 0, 0, 0, 0, 1],
        [10**400, 1.6, 0, 0, 0, 0, 1],
        {"x": 1},
        "head",
        7,
    ],
)
def test_malformed_poses_are_not_finite(head):
    frame = parse(head=head, left={"wrist": head}, right=7)
    assert not np.isfinite(frame.head).all()
    assert not np.isfinite(frame.left_wrist).all()
    assert not np.isfinite(frame.right_wrist).all()
    assert np.isnan(frame.pinch).all()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "no_message"),
        ("[]", "no_message"),
        ("{", "no_message"),
        ("[" * 8000, "no_message"),
        ('{"type": ["frame"]}', "no_message"),
        ('{"type": "frame"}', "bad_frame"),
        ('{"type": "frame", "seq": -1, "t": 0, "source": "hands"}', "bad_frame"),
        ('{"type": "frame", "seq": 1, "t": NaN, "source": "hands"}', "bad_frame"),
        ('{"type": "frame", "seq": 1, "t": 0, "source": ["hands"]}', "bad_frame"),
        ('{"type": "pong", "id": 1.5, "t": 0}', "bad_pong"),
        ('{"type": "wish", "wish": "cake"}', "bad_wish"),
        ('{"type": "wish", "wish": {}}', "bad_wish"),
    ],
)
def test_messages_that_are_none(text, reason):
    assert parse_message(text) == reason


def test_other_messages():
    assert parse_message('{"type": "pong", "id": 3, "t": 250}') == Pong(3, 0.25)
    assert parse_message('{"type": "wish", "wish": "redo"}') is RecordingRequest.REDO
    long = "the headset was\ntaken off " + "x" * 1000
    farewell = parse_message(json.dumps({"type": "bye", "reason": long}))
    assert isinstance(farewell, Bye)
    assert farewell.reason.startswith("the headset was taken off xxx")
    assert len(farewell.reason) == 200


# -- clocks --------------------------------------------------------------------------------


def test_clock_offset():
    """The fastest answer counts, and is as exact as it says."""
    rng, offset, ahead = np.random.default_rng(0), ClockOffset(), 500.0
    for i in range(40):
        there, back = rng.exponential(0.02, 2)
        number = offset.ping(0.1 * i)
        assert offset.pong(number, 0.1 * i + there + ahead, 0.1 * i + there + back)
        assert not offset.pong(number, 0.0, 0.0)
        assert offset.best is not None
        assert abs(offset.best.offset - ahead) <= offset.best.error + 1e-9
    assert offset.best is not None and offset.best.error < 0.01
    assert not offset.pong(12345, 0.0, 0.0)


def test_clock_that_jumps_or_is_forgotten():
    offset = ClockOffset()
    offset.pong(offset.ping(1.0), 101.0, 1.0)
    offset.pong(offset.ping(2.0), 92.0, 2.2)  # the headset has slept for 10 s
    assert offset.best is not None and offset.best.offset == pytest.approx(89.9)
    offset.pong(offset.ping(13.0), 103.0, 13.4)  # older ones are forgotten
    assert offset.best.error == pytest.approx(0.2)
    for _ in range(100):
        offset.ping(14.0)
    assert not offset.pong(4, 0.0, 14.0)


def test_delay_meter():
    meter = DelayMeter(0.3)
    assert meter.measure(0.0) is None and meter.describe(0.0) == ""
    times, now = iter(np.arange(0, 100, 0.02).tolist()), 0.0

    def take(seconds: float, delay: float) -> str:
        nonlocal now
        for _ in range(round(seconds * 50)):
            now = next(times)
            late = meter.take(now, delay, 0.01)
            assert late == (delay > 0.29)
        assert meter.measure(now) == pytest.approx(delay)
        return meter.describe(now)

    assert take(1.2, 0.02) == ""
    assert take(1.2, 0.12) == ("the delay of the headset's stream has grown from 20 to 120 ms")
    assert take(1.2, 0.2) == "the headset's stream is 200 ms late: move slowly"
    assert take(1.2, 0.5) == (
        "the headset's stream is 500 ms late and is not followed beyond 300 ms: free the "
        "network, or raise device.max_delay_s"
    )
    assert take(1.2, 0.02) == ""


def test_the_delay_is_taken_of_so_many_frames_and_no_more():
    meter = DelayMeter(0.3)
    for i in range(3 * MAX_FRAMES):
        meter.take(i / 5000, 0.02, 0.01)
    assert len(meter._frames) == MAX_FRAMES


# -- over the wire -------------------------------------------------------------------------


@pytest.fixture
def device() -> Iterator[WebXrDevice]:
    made = make_device(DeviceConfig(type="webxr", port=find_port(), code=CODE, smoothing=0))
    assert isinstance(made, WebXrDevice)
    made.connect()
    yield made
    made.disconnect()


@pytest.fixture
def page(device) -> Iterator[Page]:
    made = Page(device)
    made.wait_for("ping")
    yield made
    made.close()


def send(page: Page, device: WebXrDevice, message, number: int = 0) -> None:
    before = device.handled
    if isinstance(message, OperatorFrame):
        message = encode(message, number, page.clock())
    page.send(message)
    wait_for(lambda: device.handled > before)


def test_what_is_sent_is_read(device, page):
    assert device.read(0.0) is None
    for i in range(20):
        wanted = make_person(i / 100)
        send(page, device, wanted, i)
        frame = device.read(0.0)
        assert frame is not None and frame.tracked.all()
        for name in ("head", "left_wrist", "right_wrist", "pinch"):
            np.testing.assert_allclose(getattr(frame, name), getattr(wanted, name), atol=3e-5)
    status = device.status
    assert status.counts["taken"] == 20
    assert status.connected and status.trouble == ""
    assert status.delay is not None and 0 <= status.delay < 5.0


def test_what_is_shown_arrives(device, page):
    device.introduce("xop_g1", {"engage": "palms up, pinch and hold"})
    late = Page(device, "monitor")
    assert late.wait_for("welcome") == {
        "type": "welcome",
        "role": "monitor",
        "robot": "xop_g1",
        "gestures": {"engage": "palms up, pinch and hold"},
        "version": 1,
    }
    send(page, device, make_person(0.0))
    device.read(0.0)
    picture = np.full((48, 64, 3), (250, 10, 10), dtype=np.uint8)
    display = Display(
        2.0,
        engaged=True,
        mode=Mode.MOBILE,
        clutch=0.25,
        notices=(Notice(3, Cue.ENGAGED, "Engaged."),),
        warnings=("the left hand is not seen",),
        progress=Progress(1, 20, 0.8, True),
        pictures={"scene": picture // 2, "head": picture},
    )
    device.show(display)
    for viewer in (page, late):
        shown = viewer.wait_for("display")
        assert shown["engaged"] and shown["mode"] == "mobile" and shown["time"] == 2.0
        assert shown["notices"] == [{"number": 3, "cue": "engaged", "text": "Engaged."}]
        assert shown["warnings"] == ["the left hand is not seen"]
        assert shown["progress"]["episode"] == 1 and shown["progress"]["success"] is True
        assert shown["tracked"] == [True, True, True]
        assert shown["clutch"] == 0.25 and shown["fallen"] is False
        wait_for(lambda v=viewer: len(v.pictures) >= 2)
        assert [data[0] for data in viewer.pictures[:2]] == [0, 1]
        seen = np.asarray(Image.open(io.BytesIO(viewer.pictures[0][1:])))
        assert seen.shape == (48, 64, 3)
        assert np.abs(seen.astype(int) - picture).max() < 20
    assert late.wait_for("pose")["head"] == pytest.approx([0, 0.01, 1.6, 1, 0, 0.005, 0], abs=1e-4)
    assert not page.of_type("pose")
    late.close()


def test_show_never_waits_for_those_who_do_not_read(device, page):
    """Somebody stops reading: the control loop goes on, and others still get new pictures."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (720, 1280, 3), dtype=np.uint8)  # hundreds of kB as JPEG
    slow = Page(device, "monitor", reads=False)
    longest, i = 0.0, 0
    while len(page.pictures) < 20:
        i += 1
        begun = time.thread_time()
        device.show(Display(float(i), pictures={"head": noise}))
        longest = max(longest, time.thread_time() - begun)
        time.sleep(0.01)
    assert longest < 0.01  # of its own work; it waits for nobody
    wait_for(lambda: page.of_type("display")[-1]["time"] == i)
    slow.begin_to_read()
    wait_for(lambda: slow.of_type("display") and slow.of_type("display")[-1]["time"] == i)
    assert len(slow.pictures) < 6  # what was on its way, and the newest
    slow.close()


def test_requests(device, page):
    page.send({"type": "wish", "wish": "end"})
    onlooker = Page(device, "monitor")
    onlooker.wait_for("welcome")
    wait_for(lambda: len(device._requests) == 1)
    onlooker.send({"type": "wish", "wish": "success"})
    wait_for(lambda: len(device._requests) == 2)
    assert device.take_requests() == (RecordingRequest.END, RecordingRequest.SUCCESS)
    assert device.take_requests() == ()
    for _ in range(50):
        page.send({"type": "wish", "wish": "redo"})
    send(page, device, "{}")
    assert len(device.take_requests()) == 8
    onlooker.close()


def test_bad_messages_are_counted_and_the_stream_goes_on(device, page):
    send(page, device, make_person(0.0), 1)
    send(page, device, "nonsense")
    send(page, device, {"type": "frame", "seq": "x"})
    values = encode(make_person(0.01), 2, page.clock())
    send(page, device, values | {"head": [None] * 7})
    send(page, device, make_person(0.02), 3)
    counts = device.status.counts
    assert counts == {"taken": 2, "no_message": 1, "bad_frame": 1, "head_not_finite": 1}


def test_nothing_is_followed_before_the_clock_is_known(device):
    mute = Page(device, answers=False)
    mute.wait_for("ping")
    send(mute, device, make_person(0.0))
    assert device.read(0.0) is None
    assert device.status.counts == {"clock_unknown": 1}
    mute.close()


def test_taken_off_and_put_on_again(device, page):
    send(page, device, make_person(0.0), 1)
    assert device.read(0.0).tracked.all()
    page.send({"type": "bye", "reason": "the headset was taken off"})
    wait_for(lambda: not device.status.connected)
    assert not device.read(0.0).tracked.any()  # at once, not when the stream is stale
    assert device.status.trouble == "the headset was taken off"
    send(page, device, make_person(0.02), 2)
    assert not device.read(0.0).tracked.any()  # somebody else may wear it
    assert device.read(0.0).tracked.all()
    assert device.status.trouble == ""


def test_why_the_head_was_lost_is_told_though_frames_go_on(device, page):
    send(page, device, make_person(0.0), 1)
    assert device.read(0.0).tracked.all()
    page.send({"type": "bye", "reason": "the headset was recentred"})
    send(page, device, make_person(0.02), 2)
    assert not device.read(0.0).tracked.any()
    assert device.trouble == "the headset was recentred"
    send(page, device, make_person(0.04), 3)
    assert device.read(0.0).tracked.all()
    assert device.trouble == ""


def test_a_page_that_is_loaded_anew(device, page):
    """Its clock and its numbers begin anew, and the head may be anywhere."""
    send(page, device, make_person(0.0), 900)
    device.read(0.0)
    page.close()
    wait_for(lambda: not device.status.connected)
    assert device.status.trouble == "the page has closed the connection"
    assert not device.read(0.0).tracked.any()
    begun = time.monotonic()
    new = Page(device, clock=lambda: time.monotonic() - begun)
    new.wait_for("ping")
    elsewhere = make_person(0.5)
    elsewhere = dataclasses.replace(elsewhere, head=elsewhere.head + [9, 0, 0, 0, 0, 0, 0])
    send(new, device, elsewhere, 1)
    assert not device.read(0.0).tracked.any()
    assert device.read(0.0).tracked[0]
    assert device.status.connections == 2
    new.close()


def test_disconnect_says_so_and_frees_the_port(device, page):
    device.disconnect()
    assert page.wait_for("refused")["reason"] == "the session has ended"
    page.wait_until_closed()
    device.connect()
    again = Page(device)
    again.wait_for("welcome")
    again.close()
    device.disconnect()
    device.disconnect()


def test_port_that_is_taken(device):
    other = make_device(DeviceConfig(type="webxr", port=device.port, code=CODE))
    with pytest.raises(
        PortTaken,
        match=rf"cannot listen at 127.0.0.1 port {device.port}: .*Choose another "
        "--teleop.device.port, or end the session that uses it",
    ):
        other.connect()
    other.disconnect()


def test_settings():
    with pytest.raises(BadValue, match="device.code must have at least 6 letters or digits"):
        make_device(DeviceConfig(type="webxr", code="short"))
    with pytest.raises(BadValue, match=r"device.tls=false needs a host that only this machine"):
        make_device(DeviceConfig(type="webxr", host="0.0.0.0", tls=False))
    with pytest.raises(BadValue, match="device.max_delay_s must be finite and above 0, got 0"):
        DeviceConfig(type="webxr", max_delay_s=0)
