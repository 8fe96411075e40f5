"""The page of a WebXR headset in a real browser: monitor, stand-in operator, emulated headset.

The server, clutch and gestures are the real ones; there is no robot (`desk.py`).
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import headset
import numpy as np
import pytest
from desk import CODE, Desk, wait_for
from PIL import Image
from ports import find_port

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import quat_rotate
from xop_lerobot.operator.display import Cue, Progress, RecordingRequest
from xop_lerobot.operator.frame import OperatorFrame

pytestmark = pytest.mark.slow
HARMLESS = {"taken", "repeated", "clock_unknown"}
"""What the guard may count of a stream that is good: before the first ping, frames have no age."""
NOISE = ("GPU stall", "ReadPixels", "WebGL")
"""What Chromium says of its own software rendering."""
WORLD = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
"""The operator's X forward, Y left, Z up, of WebXR's x right, y up, z back."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from browser import launch

    with launch() as started:
        yield started


@pytest.fixture
def desk() -> Iterator[Desk]:
    with Desk(find_port()) as made:
        yield made


@pytest.fixture
def open_at(browser) -> Iterator[Callable[..., Any]]:
    """Open pages; in the end, none may have complained or fetched from elsewhere."""
    pages = []

    def open_page(
        address: str, prepare: Callable[[Any], None] | None = None, small: bool = False
    ) -> Any:
        # What a headset shows is drawn by the processor.
        size = (480, 320) if small else (800, 500)
        page = browser.new_page(viewport=dict(zip(("width", "height"), size, strict=True)))
        page.set_default_timeout(120_000)
        page.problems, page.requests = [], []
        page.on("console", lambda message: page.problems.append(message.text))
        page.on("pageerror", lambda error: page.problems.append(str(error)))
        page.on("request", lambda request: page.requests.append(request.url))
        if prepare is not None:
            prepare(page)
        page.goto(address)
        pages.append(page)
        return page

    yield open_page
    for page in pages:
        said = [text for text in page.problems if not any(noise in text for noise in NOISE)]
        failed = [text for text in said if "ERR_CONNECTION" in text]  # a computer that went away
        assert said == failed
        own = page.evaluate("location.origin")
        assert all(url.startswith((own, "data:", "blob:")) for url in page.requests)
        page.close()


def read(page: Any, name: str) -> str:
    return page.inner_text(f"#{name}")


def wait_text(page: Any, name: str, text: str) -> None:
    condition = "([id, text]) => document.getElementById(id).innerText.includes(text)"
    page.wait_for_function(condition, arg=[name, text])


READ_ROW = """(y) => {
  const canvas = document.getElementById('camera');
  return [...canvas.getContext('2d').getImageData(0, y, canvas.width, 1).data];
}"""


# A monitor.


def test_a_monitor_shows_what_the_robot_and_the_recording_do(desk, open_at):
    page = open_at(desk.address)
    wait_text(page, "connection", "Connected: you watch")
    wait_text(page, "recording", "episode 3 · 0:12")
    assert page.title() == "Drive xop_g1"
    assert read(page, "title") == "xop_g1"
    assert read(page, "state") == "Holding: nobody drives"
    assert (read(page, "mode"), read(page, "operator")) == ("stationary: it stays", "nobody")
    assert read(page, "delay") == "–"
    assert "palms up, both hands pinched" in read(page, "gestures")
    page.wait_for_selector("#nothing", state="hidden")
    row = np.reshape(page.evaluate(READ_ROW, 120), (-1, 4))
    np.testing.assert_allclose(row[20, :3], (200, 40, 40), atol=12)
    np.testing.assert_allclose(row[300, :3], (40, 170, 60), atol=12)

    desk.changes |= {
        "warnings": ("The left hand is not seen.",),
        "fallen": True,
        "mode": Mode.MOBILE,
        "progress": Progress(4, 100, 64.0, True),
    }
    wait_text(page, "state", "The robot has fallen")
    assert "The left hand is not seen." in read(page, "warnings")
    assert read(page, "mode") == "mobile: it walks"
    assert read(page, "recording") == "episode 4 · 1:04 · ★"
    desk.changes |= {"fallen": False, "warnings": (), "clutch": 0.5, "holding": "Hold on to stop"}
    wait_text(page, "state", "Hold on to stop")
    assert page.is_hidden("#warnings")
    assert page.evaluate("document.querySelector('#clutch div').style.width") == "50%"
    desk.changes["progress"] = None
    wait_text(page, "recording", "not recording")
    assert page.is_disabled("[data-wish=end]")


def test_notices_are_listed_and_sounded_once(desk, open_at):
    desk.board.post(Cue.MODE, "Long ago.")
    page = open_at(desk.address)
    wait_text(page, "notices", "Long ago.")
    for cue in Cue:
        desk.board.post(cue, f"It was {cue.value}.")
        wait_text(page, "notices", f"It was {cue.value}.")
    assert page.locator("#notices li").count() == 5
    # What was before the page was there is read, not heard.
    assert page.evaluate("app.sounds.played") == [cue.value for cue in Cue]


def test_every_cue_has_a_sound_of_its_own(desk, open_at):
    page = open_at(desk.address)
    tunes = page.evaluate("import('/sounds.js').then((module) => module.TUNES)")
    assert {cue.value for cue in Cue} <= set(tunes)
    assert len({json.dumps(tune) for tune in tunes.values()}) == len(tunes)
    # They sound once somebody has touched the page, and not where that is not wanted.
    page.click("#title")
    made = page.evaluate(
        """async () => {
          const made = [];
          const Tone = OscillatorNode;
          globalThis.OscillatorNode = class extends Tone {
            constructor(...args) { super(...args); made.push(args[1].frequency); }
          };
          const { Sounds } = await import('/sounds.js');
          const sounds = new Sounds();
          sounds.play('engaged');
          sounds.unlock();
          for (let i = 0; i < 500 && !made.length; i++) {
            sounds.play('engaged');
            await new Promise((done) => { setTimeout(done, 20); });
          }
          sounds.muted = true;
          sounds.play('stop');
          return made;
        }"""
    )
    assert made == [440, 660]


def test_buttons_ask_for_things_of_the_recording(desk, open_at):
    page = open_at(desk.address)
    page.wait_for_selector("[data-wish=end]:enabled")
    for request in (RecordingRequest.END, RecordingRequest.SUCCESS, RecordingRequest.STOP):
        page.click(f"[data-wish={request.value}]")
        wait_for(lambda request=request: desk.requests[-1:] == [request], request.value)
    page.click("[data-wish=redo]")  # which cannot be undone, so it takes two
    assert page.inner_text("[data-wish=redo]") == "Press again"
    page.wait_for_function(
        "() => document.querySelector('[data-wish=redo]').innerText === 'Discard, redo'"
    )
    page.evaluate(
        "() => { for (let i = 0; i < 2; i++) document.querySelector('[data-wish=redo]').click(); }"
    )
    wait_for(lambda: len(desk.requests) == 4, "redo")
    assert desk.requests[-1] is RecordingRequest.REDO
    wait_text(page, "connection", "Connected: you watch")


# What goes wrong.


def test_a_wrong_code_is_asked_for_again(desk, open_at):
    page = open_at(desk.device.url)
    wait_text(page, "trouble", "This page needs the pairing code of the robot's computer.")
    page.fill("#code", "wrong12")
    page.click("#ask button")
    wait_text(page, "trouble", "wrong code")
    assert page.is_visible("#ask")
    page.fill("#code", CODE)
    page.click("#ask button")
    wait_text(page, "connection", "Connected: you watch")
    assert page.is_hidden("#ask")
    assert page.is_hidden("#trouble")


def test_a_second_operator_is_told_and_watches(desk, open_at):
    first, second = open_at(desk.address), open_at(desk.address.replace("?", "#"))
    first.click("#drive")
    wait_for(lambda: desk.frame is not None, "a frame")
    second.click("#drive")
    wait_text(second, "trouble", "somebody drives already")
    wait_text(second, "connection", "Connected: you watch")
    assert read(second, "drive") == "Drive from here"
    wait_text(second, "operator", "all seen")
    wait_text(first, "connection", "Connected: you drive")


def test_it_comes_back_by_itself(open_at):
    port = find_port()
    with Desk(port) as desk:
        page = open_at(desk.address)
        wait_text(page, "connection", "Connected: you watch")
    wait_text(page, "connection", f"Nobody answers at localhost:{port}. Is the recording running")
    wait_text(page, "state", "Waiting for the robot")
    with Desk(port):
        wait_text(page, "connection", "Connected: you watch")
        wait_text(page, "state", "Holding: nobody drives")


def test_troubles_in_words(desk, open_at):
    page = open_at(desk.address)
    explain = """async ([protocol, answers]) => {
      const { explainFailure } = await import('/link.js');
      return explainFailure({ protocol, host: 'robot:8012' }, answers);
    }"""
    assert page.evaluate(explain, ["https:", True]).startswith(
        "This browser shows the page but refuses its connection: it does not trust the certificate."
    )
    assert page.evaluate(explain, ["https:", False]).startswith("Nobody answers at robot:8012.")
    find = """async (change) => {
      const { findMode } = await import('/headset.js');
      const give = (object, name, value) => {
        Object.defineProperty(object, name, { value, configurable: true });
      };
      if (change === 'insecure') give(window, 'isSecureContext', false);
      if (change === 'none') give(navigator, 'xr', undefined);
      if (change === 'no device') give(navigator, 'xr', { isSessionSupported: async () => false });
      if (change === 'forbidden') {
        give(navigator, 'xr', { isSessionSupported: async () => { throw new Error('no'); } });
      }
      return findMode();
    }"""
    said = {
        "none": "This browser has no WebXR.",
        "no device": "No headset is connected to this browser.",
        "forbidden": "This browser does not let pages use a headset.",
        "insecure": "A headset needs an https address, or a cable: see docs/use/webxr.md.",
    }
    for change, trouble in said.items():
        assert page.evaluate(find, change) == {"mode": None, "trouble": trouble}


def test_frames_never_queue_up(desk, open_at):
    page = open_at(desk.address)
    sent = page.evaluate(
        """async () => {
          const sockets = [];
          globalThis.WebSocket = class {
            static OPEN = 1;
            readyState = 1;
            bufferedAmount = 0;
            sent = [];
            constructor() { sockets.push(this); }
            send(text) { this.sent.push(JSON.parse(text)); this.bufferedAmount = text.length; }
            close() {}
          };
          const { Link } = await import('/link.js');
          const nothing = { state() {}, message() {}, picture() {} };
          const link = new Link('operator', 'code12', nothing);
          const before = link.sendFrame({ head: null });
          const [socket] = sockets;
          socket.onmessage({ data: JSON.stringify({ type: 'welcome' }) });
          const results = [];
          for (let i = 0; i < 4; i++) {
            results.push(link.sendFrame({ head: [i / 3] }));
            if (i === 1) socket.bufferedAmount = 0;
          }
          link.close();
          return { before, results, dropped: link.dropped, sent: socket.sent };
        }"""
    )
    assert sent["before"] is False  # nobody has said that frames are welcome
    assert sent["results"] == [True, False, True, False]
    assert sent["dropped"] == 2
    assert [message["seq"] for message in sent["sent"]] == [1, 2]
    assert sent["sent"][1]["head"] == [0.66667]


# The stand-in operator.


def is_close(frame: OperatorFrame | None, place: Sequence[float], within: float) -> bool:
    return frame is not None and bool(np.linalg.norm(frame.head[:3] - place) < within)


def test_a_newcomer_drives_by_mouse_and_keyboard(desk, open_at):
    page = open_at(desk.address)
    page.click("#drive")
    wait_for(lambda: is_close(desk.frame, (0, 0, 1.6), 0.02), "a frame")
    start = desk.frame
    assert start.tracked.all()
    # Palms down, fingers forward: the frames of the wrists lie as the world does.
    for wrist, y in ((start.left_wrist, 0.2), (start.right_wrist, -0.2)):
        np.testing.assert_allclose(wrist[:3], [0.33, y, 1.12], atol=0.02)
        np.testing.assert_allclose(np.abs(wrist[3:]), [1, 0, 0, 0], atol=0.02)

    page.keyboard.down("Space")
    wait_for(lambda: desk.engaged, "engagement")
    up = [quat_rotate(pose[3:], np.array([0.0, 0, 1])) for pose in
          (desk.frame.left_wrist, desk.frame.right_wrist)]  # fmt: skip
    assert all(axis[2] < -0.9 for axis in up)
    page.keyboard.up("Space")
    wait_text(page, "state", "Engaged: the robot follows")
    assert read(page, "drive") == "Stop driving"  # the space bar has pressed no button
    page.wait_for_function("() => app.sounds.played.includes('engaged')")

    page.keyboard.down("w")
    wait_for(lambda: desk.frame.head[0] > 0.4, "a walk forward")
    page.keyboard.up("w")
    page.keyboard.down("q")
    wait_for(lambda: 2 * np.arctan2(desk.frame.head[6], desk.frame.head[3]) > 0.3, "a turn left")
    page.keyboard.up("q")
    page.keyboard.down("f")
    wait_for(lambda: desk.frame.head[2] < 1.5, "a squat")
    page.keyboard.up("f")

    middle = (300, 150)
    page.mouse.move(*middle)
    page.mouse.down()
    before = desk.frame
    page.mouse.move(middle[0], middle[1] - 130, steps=5)
    page.mouse.up()

    def rise(name: str) -> float:
        frame = desk.frame
        return float((frame.pose(name) - frame.head - before.pose(name) + before.head)[2])

    wait_for(lambda: rise("right_wrist") > 0.15, "the right hand")
    assert abs(rise("left_wrist")) < 0.02
    page.keyboard.down("Shift")
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0], middle[1] - 80, steps=5)
    page.mouse.up()
    page.keyboard.up("Shift")
    wait_for(lambda: rise("left_wrist") > 0.09, "the left hand")

    page.keyboard.down("2")
    wait_for(lambda: desk.frame.pinch[1] < 0.015 and desk.frame.pinch[0] > 0.07, "a pinch")
    page.keyboard.up("2")
    for _ in range(10):  # where frames come too slowly, pinches are too long
        page.keyboard.press("m")
        page.wait_for_function("() => app.person.taps[0] === null")
        page.wait_for_timeout(1000)
        if desk.mode is Mode.MOBILE:
            break
    assert desk.mode is Mode.MOBILE
    assert desk.engaged
    assert set(desk.device.status.counts) <= HARMLESS  # nothing was a jump, frozen or out of reach

    page.click("#drive")
    wait_for(lambda: not desk.engaged, "the end")
    wait_text(page, "connection", "Connected: you watch")
    assert page.is_hidden("#keys")


def test_the_keys_can_be_pressed_on_the_page(desk, open_at):
    page = open_at(desk.address)
    page.click("#drive")
    wait_for(desk.sees_all, "a frame")
    page.hover("[data-action=engage]")
    page.mouse.down()
    wait_for(lambda: desk.engaged, "engagement")
    page.mouse.up()
    assert page.evaluate("[...app.person.held]") == []
    # Keys that are held when the window loses the keyboard are let go of.
    page.keyboard.down("w")
    assert page.evaluate("[...app.person.held]") == ["forward"]
    page.evaluate("window.dispatchEvent(new Event('blur'))")
    assert page.evaluate("[...app.person.held]") == []


def test_a_hidden_page_lets_go(desk, open_at):
    page = open_at(desk.address)
    page.click("#drive")
    wait_for(desk.sees_all, "a frame")
    page.keyboard.down("Space")
    wait_for(lambda: desk.engaged, "engagement")
    page.keyboard.up("Space")
    page.evaluate(
        """() => {
          Object.defineProperty(document, 'hidden', { value: true });
          document.dispatchEvent(new Event('visibilitychange'));
        }"""
    )
    wait_text(page, "trouble", "This page was hidden, and the robot was disengaged. Engage again.")
    wait_for(lambda: not desk.engaged, "the end")


def test_the_stand_in_moves_smoothly(desk, open_at):
    """Whatever is pressed and dragged: speed and acceleration of head and hands stay small."""
    page = open_at(desk.address)
    rate = 72
    poses = page.evaluate(
        """async (rate) => {
          const { StandIn, DRIVES } = await import('/standin.js');
          const person = new StandIn();
          const names = [...Object.keys(DRIVES), 'engage', 'pinchLeft', 'pinchRight'];
          let seed = 1;
          const random = () => {
            seed = (seed * 48271) % 2147483647;
            return seed / 2147483647;
          };
          const out = [];
          for (let i = 0; i < 60 * rate; i++) {
            const name = names[Math.floor(random() * names.length)];
            if (random() < 0.1) person.hold(name);
            if (random() < 0.2) person.release(name);
            if (random() < 0.3) {
              const by = [0, 1, 2].map(() => 0.3 * (random() - 0.5));
              person.moveHand(i % 2, by);
            }
            if (random() < 0.01) person.turnPalms();
            if (random() < 0.01) person.doublePinch(i % 2);
            person.step(1 / rate);
            const { head, left, right, pinch } = person.pose;
            out.push([...head, ...left, ...right, ...pinch]);
          }
          return out;
        }""",
        rate,
    )
    poses = np.array(poses)
    for begin, speed, acceleration in ((0, 1.0, 6.0), (7, 3.0, 30.0), (14, 3.0, 30.0)):
        velocity = np.diff(poses[:, begin : begin + 3], axis=0) * rate
        change = np.diff(velocity, axis=0) * rate
        assert np.linalg.norm(velocity, axis=1).max() < speed
        assert np.linalg.norm(change, axis=1).max() < acceleration
        quats = poses[:, begin + 3 : begin + 7]
        np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1, atol=1e-9)
        turn = 2 * np.arccos(np.clip(np.abs((quats[1:] * quats[:-1]).sum(axis=1)), 0, 1)) * rate
        assert turn.max() < 15
        assert np.abs(np.diff(poses[:, begin : begin + 7], axis=0)).max(axis=1).min() > 1e-5
    assert poses[:, 1].min() > 0.79
    assert poses[:, 1].max() < 1.77
    hands = poses[:, 7:10] - poses[:, :3], poses[:, 14:17] - poses[:, :3]
    assert max(np.linalg.norm(hand, axis=1).max() for hand in hands) < 1.3
    assert (poses[:, 21:] > 0).all()


# A headset.

LEVEL = [0, 0, 0, 1]
STANDING = [[0, 1.6, 0, *LEVEL], [-0.2, 1.2, -0.4, *LEVEL], [0.2, 1.2, -0.4, *LEVEL]]


def start_headset(
    desk: Desk, open_at: Callable[..., Any], small: bool = True, **options: Any
) -> Any:
    page = open_at(desk.address, lambda page: headset.install(page, **options), small=small)
    page.evaluate("(pose) => { wearer.pose = pose; }", STANDING)
    page.wait_for_selector("#headset:not([hidden])")
    page.click("#headset")
    wait_for(desk.sees_all, "a frame")
    return page


READ_TRUTH = """() => new Promise((done) => {
  device.activeSession.requestReferenceSpace('local-floor').then((space) => {
    device.activeSession.requestAnimationFrame((time, frame) => {
      const out = {};
      for (const source of frame.session.inputSources) {
        for (const name of ['wrist', 'thumb-tip', 'index-finger-tip']) {
          const pose = frame.getJointPose(source.hand.get(name), space);
          out[`${source.handedness} ${name}`] = [...pose.transform.matrix];
        }
      }
      done(out);
    });
  });
})"""


def test_poses_of_a_headset_come_out_in_our_convention(desk, open_at):
    page = start_headset(desk, open_at)
    # The head has gone 0.5 m to the right and 1 m back, stands at 1.4 m and looks 90° to the left;
    # the left hand's fingers point up, the right hand's palm to the left.
    s = np.sqrt(0.5)
    poses = [
        [0.5, 1.4, 1.0, 0, s, 0, s],
        [0.1, 1.2, 0.9, s, 0, 0, s],
        [0.2, 1.1, 0.7, 0, 0, -s, s],
    ]
    page.evaluate("(pose) => { wearer.pose = pose; wearer.pinch = [1, 0]; }", poses)
    moved = [-1.0, -0.5, 1.4]
    # A head that jumps is believed once it has stayed there.
    wait_for(lambda: is_close(desk.frame, moved, 0.01) and desk.frame.tracked.all(), "it")
    page.evaluate("() => { wearer.still = true; }")
    truth = {
        name: np.reshape(matrix, (4, 4)).T for name, matrix in page.evaluate(READ_TRUTH).items()
    }
    wait_for(lambda: not desk.frame.tracked.any(), "the stale stream")  # the last poses stay
    frame = desk.frame
    np.testing.assert_allclose(frame.head[:3], moved, atol=2e-5)
    forward, left, up = (quat_rotate(frame.head[3:], axis) for axis in np.eye(3))
    np.testing.assert_allclose(forward, [0, 1, 0], atol=1e-4)
    np.testing.assert_allclose(left, [-1, 0, 0], atol=1e-4)
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-4)
    for i, side in enumerate(("left", "right")):
        wrist, pose = truth[f"{side} wrist"], frame.pose(f"{side}_wrist")
        np.testing.assert_allclose(pose[:3], WORLD @ wrist[:3, 3], atol=2e-5)
        # A joint has -z towards the fingertips and y out of the back of the hand.
        for axis, theirs in zip(np.eye(3)[[0, 2]], (-wrist[:3, 2], wrist[:3, 1]), strict=True):
            np.testing.assert_allclose(quat_rotate(pose[3:], axis), WORLD @ theirs, atol=1e-4)
        tips = [truth[f"{side} {name}"][:3, 3] for name in ("thumb-tip", "index-finger-tip")]
        distance = np.linalg.norm(np.subtract(*tips))
        np.testing.assert_allclose(frame.pinch[i], distance, atol=3e-5)
    assert frame.pinch[0] < 0.01
    assert frame.pinch[1] > 0.06


def test_what_the_wearer_sees(desk, open_at):
    page = start_headset(desk, open_at, small=False, modes=("immersive-vr",))
    assert page.evaluate("app.mode") == "immersive-vr"
    page.wait_for_function("() => app.headset.stage.aspect > 0")
    page.wait_for_timeout(300)
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), int)
    red = np.all(np.abs(picture - (200, 40, 40)) < 14, axis=2)
    green = np.all(np.abs(picture - (40, 170, 60)) < 14, axis=2)
    columns = [np.flatnonzero(mask.any(axis=0)) for mask in (red, green)]
    half = picture.shape[1] // 2
    for low, high in ((0, half), (half, 2 * half)):  # one for each eye, the right way round
        reds, greens = (c[(c >= low) & (c < high)] for c in columns)
        assert len(reds) > 30
        assert len(greens) > 30
        assert reds.max() < greens.min()
    words = picture[np.flatnonzero(red.any(axis=1)).max() :]
    assert (words > 180).all(axis=2).sum() > 500  # white letters below

    # The words are those of the state, drawn anew only when they change.
    assert "To engage: palms up, both hands pinched" in page.evaluate("app.hud.drawn")
    desk.changes |= {"warnings": ("The plan is late.",), "engaged": True}
    page.wait_for_function("() => app.hud.drawn.includes('The plan is late.')")
    assert "Engaged: the robot follows" in page.evaluate("app.hud.drawn")
    assert "To engage" not in page.evaluate("app.hud.drawn")
    assert page.evaluate("[app.hud.update([]), app.hud.update([])][1]") is False


def test_hands_that_are_lost_and_sessions_that_end(desk, open_at):
    page = start_headset(desk, open_at)
    page.evaluate("() => { device.hands.left.connected = false; }")
    wait_for(lambda: desk.frame.tracked.tolist() == [True, False, True], "a lost hand")
    page.wait_for_function("() => app.headset.troubles.includes('The left hand is not seen.')")
    page.evaluate("() => { device.hands.left.connected = true; }")
    wait_for(desk.sees_all, "the hand")
    # Taken off: the robot is let go at once, and the page stays connected.
    page.evaluate("() => { device.updateVisibilityState('hidden'); }")
    wait_for(lambda: not desk.frame.tracked.any(), "the end of the stream")
    page.evaluate("() => { device.updateVisibilityState('visible'); }")
    wait_for(desk.sees_all, "the stream")
    page.evaluate("() => { device.updateVisibilityState('visible-blurred'); }")
    page.wait_for_function(
        "() => app.headset.troubles.includes('A menu of the headset is open: close it to go on.')"
    )
    page.evaluate("() => { device.updateVisibilityState('visible'); }")
    wait_for(desk.sees_all, "the stream")
    page.evaluate("() => device.activeSession.end()")
    wait_text(page, "trouble", "The session in the headset has ended.")
    wait_text(page, "connection", "Connected: you watch")
    wait_for(lambda: not desk.frame.tracked.any(), "the end of the stream")
    page.click("#headset")  # and once more
    wait_for(desk.sees_all, "the stream")


def test_controllers(desk, open_at):
    page = start_headset(desk, open_at)
    page.evaluate("() => { device.primaryInputMode = 'controller'; }")
    page.evaluate("() => { device.controllers.right.updateButtonValue('trigger', 1); }")
    wait_for(lambda: desk.sees_all() and desk.frame.pinch[1] < 0.01, "controllers")
    assert desk.frame.pinch[0] == pytest.approx(0.08, abs=0.01)
    page.evaluate("() => { wearer.guessed = true; }")
    wait_for(lambda: desk.frame.tracked.tolist() == [True, False, False], "the guess")
    page.wait_for_function("() => app.headset.troubles.includes('A hand is only guessed.')")


def test_a_headset_that_refuses_says_why(desk, open_at):
    page = open_at(desk.address, headset.install)
    page.wait_for_selector("#headset:not([hidden])")
    refuse = """(name) => {
      navigator.xr.requestSession = async () => { throw new DOMException('no', name); };
    }"""
    for name, text in {
        "NotAllowedError": "The headset has not allowed it.",
        "NotSupportedError": "This headset cannot show such a session.",
        "InvalidStateError": "Another session is open in this headset.",
    }.items():
        page.evaluate(refuse, name)
        page.click("#headset")
        wait_text(page, "trouble", text)
    wait_text(page, "connection", "Connected: you watch")


def test_engage_by_the_hands_of_a_headset(desk, open_at):
    page = start_headset(desk, open_at)
    page.evaluate("wearer.embody()")
    wait_for(desk.sees_all, "a frame")
    page.evaluate("wearer.person.hold('engage')")
    wait_for(lambda: desk.engaged, "engagement")
    page.evaluate("wearer.person.release('engage')")
    page.wait_for_function("() => app.hud.notice === 'Engaged: the robot follows you.'")
    page.evaluate("() => { device.updateVisibilityState('hidden'); }")
    wait_for(lambda: not desk.engaged, "the end")
