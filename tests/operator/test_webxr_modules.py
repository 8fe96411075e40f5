"""Modules of the page in Node.js, with a made-up session that does what is asked of it."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from xop_lerobot.core.transforms import compute_heading, quat_from_rpy
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.webxr.protocol import Bye, FrameMessage, parse_message
from xop_lerobot.operator.webxr.server import PAGE

PRELUDE = """
const makePose = ([x, y, z], emulatedPosition = false) => ({
  transform: { position: { x, y, z }, orientation: { x: 0, y: 0, z: 0, w: 1 } }, emulatedPosition,
});
const JOINTS = ['wrist', 'thumb-tip', 'index-finger-tip'];
const hand = (handedness, place, guessed = false) => ({
  handedness, targetRayMode: 'tracked-pointer', gripSpace: null,
  hand: new Map(JOINTS.map((name) => [name, place && makePose(place, guessed)])),
});
const controller = (handedness, place, guessed = false) => ({
  handedness, targetRayMode: 'tracked-pointer', gamepad: { buttons: [{ value: 0.25 }] },
  gripSpace: { pose: place && makePose(place, guessed) },
});
const makeFrame = (inputSources) => ({
  session: { inputSources },
  getViewerPose: () => makePose([0, 1.6, 0]),
  getJointPose: (joint) => joint,
  getPose: (space) => space.pose,
});
"""


@pytest.fixture(scope="module")
def evaluate(tmp_path_factory) -> Callable[[str], Any]:
    """Run a script that prints JSON beside the page's modules; nothing is drawn."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs Node.js (`node`), which is not there")
    folder = tmp_path_factory.mktemp("page")
    shutil.copytree(PAGE, folder, dirs_exist_ok=True)
    (folder / "package.json").write_text('{"type": "module"}')
    (folder / "stage.js").write_text("export class Stage { draw() {} }")

    def run(script: str) -> Any:
        path = Path(folder, "script.js")
        path.write_text(PRELUDE + script)
        done = subprocess.run([node, path], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


def read_frames(evaluate, *lists: str, period_ms: float = 1000 / 72) -> list[OperatorFrame]:
    """Frames with these input sources in turn, as the server reads them."""
    script = f"""
    const {{ readFrame }} = await import('./headset.js');
    const lists = [{", ".join(lists)}];
    const handsAt = {{}};
    console.log(JSON.stringify(
      lists.map((sources, i) => readFrame(makeFrame(sources), {{}}, i * {period_ms}, handsAt))));
    """
    frames = []
    for i, data in enumerate(evaluate(script)):
        message = parse_message(json.dumps({"type": "frame", "seq": i, "t": i, **data}))
        assert isinstance(message, FrameMessage)
        frames.append(message.frame)
    return frames


LEFT, RIGHT = "[-0.2, 1.1, -0.4]", "[0.2, 1.1, -0.4]"
HANDS = f"hand('left', {LEFT}), hand('right', {RIGHT})"
CONTROLLERS = f"controller('left', {LEFT}), controller('right', {RIGHT})"
UNSEEN = "hand('left', null), hand('right', null)"


@pytest.mark.parametrize(
    "sources",
    [
        CONTROLLERS,
        f"{UNSEEN}, {CONTROLLERS}",
        f"{CONTROLLERS}, {UNSEEN}",
        f"hand('left', {LEFT}, true), hand('right', {RIGHT}, true), {CONTROLLERS}",
    ],
)
def test_hands_that_are_not_seen_hide_no_controllers(evaluate, sources):
    (frame,) = read_frames(evaluate, f"[{sources}]")
    assert frame.tracked.all()
    np.testing.assert_allclose(frame.pinch, 0.06)  # a quarter of the trigger
    assert frame.left_wrist[1] > 0 > frame.right_wrist[1]


@pytest.mark.parametrize("sources", [HANDS, f"{HANDS}, {CONTROLLERS}", f"{CONTROLLERS}, {HANDS}"])
def test_hands_that_are_seen_go_before_controllers(evaluate, sources):
    (frame,) = read_frames(evaluate, f"[{sources}]")
    assert frame.tracked.all()
    np.testing.assert_allclose(frame.pinch, 0)
    np.testing.assert_allclose(frame.left_wrist[:3], [0.4, 0.2, 1.1], atol=1e-9)


@pytest.mark.parametrize("also", ["", ", hand('right', null)", ", controller('left', null)"])
def test_a_bare_hand_and_a_controller_are_both_followed(evaluate, also):
    sources = f"[hand('left', {LEFT}), controller('right', {RIGHT}){also}]"
    (frame,) = read_frames(evaluate, sources)
    assert frame.tracked.all()
    np.testing.assert_allclose(frame.left_wrist[:3], [0.4, 0.2, 1.1], atol=1e-9)
    np.testing.assert_allclose(frame.pinch, [0, 0.06])
    # The wrist is behind the fist that holds the controller.
    assert np.linalg.norm(frame.right_wrist[:3] - [0.4, -0.2, 1.1]) == pytest.approx(0.08)


def test_nothing_seen_is_nothing(evaluate):
    frames = read_frames(evaluate, "[]", f"[{UNSEEN}]", "[controller('left', null)]")
    assert [frame.tracked.tolist() for frame in frames] == 3 * [[True, False, False]]


def test_a_controller_on_the_table_takes_over_from_no_hand_that_flickers(evaluate):
    table = "controller('left', [0.5, 0.7, -0.5]), controller('right', [0.6, 0.7, -0.5])"
    lost = f"[{UNSEEN}, {table}]"
    lists = [f"[{HANDS}, {table}]", *[lost] * 9, f"[{HANDS}, {table}]", *[lost] * 11]
    tracked = [f.tracked[1] for f in read_frames(evaluate, *lists, period_ms=100)]
    assert tracked[:11] == [True, *[False] * 9, True]
    assert tracked[11:] == [*[False] * 9, True, True]  # after a second it is what is held


def test_a_headset_that_recentres_lets_go_before_frames_of_the_new_space(evaluate):
    sent = evaluate(f"""
    const {{ Headset }} = await import('./headset.js');
    const space = new EventTarget();
    class Session extends EventTarget {{
      visibilityState = 'visible';
      callbacks = [];
      inputSources = [{HANDS}];
      requestReferenceSpace() {{ return Promise.resolve(space); }}
      requestAnimationFrame(callback) {{ this.callbacks.push(callback); }}
      end() {{ return Promise.resolve(); }}
    }}
    const session = new Session();
    Object.defineProperty(globalThis, 'navigator', {{
      value: {{ xr: {{ requestSession: () => Promise.resolve(session) }} }}, configurable: true,
    }});
    const sent = [];
    const headset = new Headset({{
      frame: () => sent.push({{ type: 'frame' }}),
      moved: (reason) => sent.push({{ type: 'bye', reason }}),
    }}, {{}});
    await headset.start('immersive-vr');
    const tick = () => session.callbacks.splice(0)
      .forEach((call) => call(0, makeFrame(session.inputSources)));
    tick();
    space.dispatchEvent(new Event('reset'));
    tick();
    console.log(JSON.stringify(sent));
    """)
    assert [message["type"] for message in sent] == ["frame", "bye", "frame"]
    farewell = parse_message(json.dumps(sent[1]))
    assert farewell == Bye("the headset was recentred, or has found its place anew")


@pytest.mark.parametrize("roll, pitch", [(0, 0), (0, 85), (20, 60), (-35, 85), (0, 120)])
def test_the_map_shows_the_heading_that_the_robot_follows(evaluate, roll, pitch):
    quat = quat_from_rpy(np.radians(roll), np.radians(pitch), 0.7)
    w, x, y, z = quat.tolist()
    ours, theirs = [1, 2, 1.6, w, x, y, z], [-2, 1.6, -1, -y, z, -x, w]
    found = evaluate(f"""
    const {{ fromOperator, fromWebXr }} = await import('./map.js');
    console.log(JSON.stringify([fromOperator({ours}), fromWebXr({theirs})]));
    """)
    for each in found:
        assert (each["x"], each["y"]) == (1, 2)
        assert each["heading"] == pytest.approx(float(compute_heading(quat)))
