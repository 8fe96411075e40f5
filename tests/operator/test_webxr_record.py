"""An episode of G1 by `lerobot-record`, driven through an emulated headset in a real browser.

Nobody helps: the wearer engages, squats, reaches, marks the episode as a success and saves it,
all by gestures and on the page. Simulated time waits for the machine, the wearer does not: a slow
machine sees a hasty person.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import headset
import numpy as np
import pytest
from headset_rig import RETARGETER
from lerobot.datasets import LeRobotDataset
from ports import find_port

from xop_lerobot.recording.facts import read_facts

pytestmark = pytest.mark.slow
REPO = Path(__file__).parents[2]
CODE = "tested7"
PATIENCE_S = 300.0
"""A machine that does something else besides takes minutes for what takes seconds."""


def build_command(root: Path, port: int, *more: str) -> list[str]:
    return [
        sys.executable, "-m", "lerobot.scripts.lerobot_record",
        "--robot.type=xop_g1", "--robot.width=96", "--robot.height=72", "--robot.cameras=head",
        "--teleop.type=xop", "--teleop.device.type=webxr",
        f"--teleop.device.port={port}", f"--teleop.device.code={CODE}",
        # A machine that is busy is slow: frames come late and far apart.
        "--teleop.device.stale_s=3", "--teleop.device.max_delay_s=10",
        "--teleop.gestures.clutch.max_gap=2", "--teleop.gestures.raised.max_gap=2",
        "--dataset.repo_id=local/webxr", f"--dataset.root={root}", "--dataset.fps=25",
        "--dataset.num_episodes=2", "--dataset.episode_time_s=3600", "--dataset.reset_time_s=0",
        "--dataset.single_task=squat and reach", "--dataset.push_to_hub=false",
        "--dataset.streaming_encoding=true", "--dataset.no_stamp=true", "--play_sounds=false",
        *more,
    ]  # fmt: skip


@contextmanager
def record(root: Path, port: int, *more: str) -> Iterator[subprocess.Popen]:
    """Run the command; what it says is in `root.log`, and shown where the test fails."""
    log = root.with_suffix(".log")
    places = [REPO / "teleoperators", REPO / "robots", REPO]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(map(str, places)),
        "HF_HUB_OFFLINE": "1",
        "HF_LEROBOT_HOME": str(root.parent / "lerobot"),
        "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"),
    }
    with log.open("w") as out:
        process = subprocess.Popen(
            build_command(root, port, *more), stdout=out, stderr=out, env=environment
        )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(timeout=60)
            except subprocess.TimeoutExpired:
                process.kill()
        print(log.read_text()[-4000:])


def wait_for(condition: Callable[[], object], process: subprocess.Popen, what: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert process.poll() is None, "the recording has ended"
        assert time.monotonic() < end, f"{what} does not come"
        time.sleep(0.1)


def listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(1)
        return probe.connect_ex(("127.0.0.1", port)) == 0


def open_headset(browser: Any, port: int) -> Any:
    page = browser.new_page(viewport={"width": 480, "height": 320})
    page.set_default_timeout(1000 * PATIENCE_S)
    headset.install(page)
    page.goto(f"http://localhost:{port}/?code={CODE}")
    page.evaluate("wearer.embody()")
    page.wait_for_function("() => wearer.pose !== null")
    page.wait_for_selector("#headset:not([hidden])")
    page.click("#headset")
    return page


def drive(page: Any) -> None:
    """Engage, squat by 20 cm, raise the right hand by 15 cm, mark a success, end the session."""

    def until(condition: str) -> None:
        page.wait_for_function(f"() => {condition}")

    until("app.hud.display?.tracked.every(Boolean)")
    # The robot must stand; the gesture is made anew until it is granted.
    page.evaluate("wearer.person.hold('engage')")
    until("app.hud.display.engaged")
    page.evaluate("wearer.person.release('engage')")
    until("wearer.person.palms.value[0] === 0")
    page.evaluate("wearer.person.hold('down')")
    until("wearer.person.height < 1.4")
    page.evaluate("wearer.person.release('down')")
    page.evaluate("wearer.person.moveHand(1, [0, 0.15, 0])")
    until("wearer.person.hands[1].left === 0 && wearer.person.speeds.climb.value[0] === 0")
    start = page.evaluate("app.hud.display.time")
    until(f"app.hud.display.time > {start} + 2")  # the robot's seconds, for it to get there
    page.evaluate("app.link.send({ type: 'wish', wish: 'success' })")
    until("app.hud.display.progress.success")
    for name in ("raiseLeft", "raiseRight"):
        page.evaluate(f"wearer.person.hold('{name}')")
    until("wearer.person.raises.every((raise) => raise.value[0] === 1)")
    page.wait_for_timeout(1000)  # until open hands are seen there
    # Frames that come too far apart break a gesture off, and it is made anew.
    done = "!app.hud.display || app.hud.display.notices.some(({ cue }) => cue === 'stop')"
    for _ in range(10):
        for name in ("pinchLeft", "pinchRight"):
            page.evaluate(f"wearer.person.hold('{name}')")
        page.evaluate(f"""async () => {{
          for (let i = 0; i < 150 && !({done}); i++) {{
            await new Promise((go) => {{ setTimeout(go, 100); }});
          }}
        }}""")
        if page.evaluate(done):
            return
        for name in ("pinchLeft", "pinchRight"):
            page.evaluate(f"wearer.person.release('{name}')")
        page.wait_for_timeout(1000)


def test_from_engage_to_save(tmp_path):
    from browser import launch

    port, root = find_port(), tmp_path / "webxr"
    with (
        launch() as browser,
        record(root, port, f"--teleop.retargeter.type={RETARGETER}") as process,
    ):
        wait_for(lambda: listens(port), process, "the page")
        page = open_headset(browser, port)
        drive(page)
        assert process.wait(timeout=PATIENCE_S) == 0
        # The page says that nobody is there any more, and would come back by itself.
        page.wait_for_function("() => app.hud.trouble.includes('Trying again')")
    check(root)


def check(root: Path) -> None:
    """The one episode, and in it what the wearer did."""
    dataset = LeRobotDataset("local/webxr", root=root)
    assert dataset.num_episodes == 1  # `stop` saved it, and no second one began
    (facts,) = read_facts(root)
    print(f"{RETARGETER}: {facts['real_fps']:.1f} frames a second, {facts['length']} frames")
    assert facts["success"]
    assert not facts["fallen"]
    columns = dataset.hf_dataset.with_format("numpy")
    read = {
        key: np.stack(columns[key])
        for key in dataset.features
        if key.startswith(("operator.", "goal.", "robot.head", "action", "next."))
    }
    engaged = np.ravel(read["operator.engaged"]).astype(bool)
    assert np.flatnonzero(np.diff(engaged.astype(int))).size == 1  # once, and until the end
    assert engaged[-1]
    first = int(np.argmax(engaged))
    head, right = read["operator.head"], read["operator.right_wrist"]
    seen = read["operator.tracked"].astype(bool)
    assert seen[engaged].all()
    # The wearer of the emulator, in our axes: 1.6 m high, then 1.4 m, and never elsewhere.
    driven = head[engaged]
    np.testing.assert_allclose(driven[0, :3], [0, 0, 1.6], atol=0.02)
    assert np.abs(driven[:, :2]).max() < 0.02
    assert driven[-1, 2] < 1.45
    np.testing.assert_allclose(np.linalg.norm(driven[:, 3:], axis=1), 1, atol=1e-5)
    assert (right[first, 1], read["operator.left_wrist"][first, 1]) == pytest.approx(
        (-0.2, 0.2), abs=0.1
    )
    assert read["operator.pinch"][first].max() < 0.018  # the gesture that engages
    assert read["operator.pinch"][engaged].max() > 0.06
    # The robot's head went down with it, and no command made a step.
    goal, robot = read["goal.head"][engaged, 2], read["robot.head"][:, 2]
    assert goal[0] - goal.min() > 0.1
    assert robot[first] - robot[first:].min() > 0.06
    names = dataset.features["action"]["names"]
    height = read["action"][:, names.index("height.pos")]
    assert np.abs(np.diff(height)).max() <= 0.25 / 25 + 1e-6
    assert read["next.success"][-1]
