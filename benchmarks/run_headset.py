"""Measure a headset's delays: from sending a frame to its arrival and to the resulting command.

    python -m benchmarks.run_headset --seconds 30
    python -m benchmarks.run_headset --sender browser --retargeter mpc

A sender in its own process sends frames over loopback, stamped by the machine's shared monotonic
clock, engages by the gesture and drives a simulated robot in real time. The sender is either a
program that behaves like the page, or the page itself in headless Chromium with an emulated
headset. The delay to the command includes the wait for the next tick of the control loop, half a
period on average.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from xop_lerobot.morphology.morphology import list_robots

CODE = "BENCHMARK"
SPAWN = multiprocessing.get_context("spawn")
OPEN_S, GESTURE_S = 1.2, 2.0
"""Times for which the hands are open at first, and for which the gesture is held [s]."""
LEVEL, TURNED = [0.0, 0, 0, 1], [0.0, 0, 1, 0]
"""Orientations xyzw of the wrists: level, and turned for the gesture that engages."""


def make_message(number: int, t: float) -> dict[str, Any]:
    """Make the page's message `number` at `t` [s]: a swaying person who engages at 1.2 to 3.2 s."""
    gesture = OPEN_S <= t < OPEN_S + GESTURE_S
    sway = [0.004 * math.sin(3 * t), 0.004 * math.cos(2 * t), 0.004 * math.sin(5 * t)]

    def add(position: Sequence[float]) -> list[float]:
        return [round(a + b, 5) for a, b in zip(position, sway, strict=True)]

    def make_hand(x: float) -> dict[str, Any]:
        thumb, pinch = [x, 1.15, -0.4], 0.008 if gesture else 0.07
        wrist = [*add([x, 1.15, -0.3]), *(TURNED if gesture else LEVEL)]
        joints = [0.12345] * 75  # as many as the page sends, for messages of the same length
        return {"wrist": wrist, "thumb": thumb, "index": [x, 1.15 + pinch, -0.4], "joints": joints}

    head = [*add([0, 1.6, 0]), *LEVEL]
    frame = {"type": "frame", "seq": number, "source": "hands", "t": time.monotonic() * 1e3}
    return frame | {"head": head, "left": make_hand(-0.2), "right": make_hand(0.2)}


def send_frames(port: int, seconds: float, rate: float) -> None:
    """Send frames as the page does, and answer its pings.

    Args:
        port: Port of the WebXR device.
        seconds: Duration [s].
        rate: Frames per second [Hz].
    """
    from websockets.sync.client import connect

    with connect(f"ws://localhost:{port}/ws?code={CODE}&role=operator", proxy=None) as ws:
        begun = time.monotonic()
        for number in range(round(seconds * rate)):
            wait = begun + number / rate - time.monotonic()
            while wait > 0:
                try:
                    values = json.loads(ws.recv(timeout=wait))
                except TimeoutError:
                    break
                if values["type"] == "ping":
                    pong = {"type": "pong", "id": values["id"], "t": time.monotonic() * 1e3}
                    ws.send(json.dumps(pong))
                wait = begun + number / rate - time.monotonic()
            ws.send(json.dumps(make_message(number, time.monotonic() - begun)))


def send_from_browser(port: int, seconds: float, rate: float, origin: Any) -> None:
    """Drive the page in Chromium with an emulated headset.

    Args:
        port: Port of the WebXR device.
        seconds: Duration after the gesture [s].
        rate: Ignored; the browser has its own rate.
        origin: Receives the monotonic time at which the browser's clock was zero [s].
    """
    del rate
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "helpers"))
    import headset
    from browser import launch

    with launch() as browser:
        page = browser.new_page(viewport={"width": 480, "height": 320})
        headset.install(page)
        page.goto(f"http://localhost:{port}/?code={CODE}")
        # Chromium counts from an origin that it gives as time of day; convert it to monotonic time.
        time_of_day = time.time() - time.monotonic()
        origin.value = page.evaluate("performance.timeOrigin") / 1e3 - time_of_day
        page.evaluate("wearer.embody()")
        page.wait_for_function("() => wearer.pose !== null")
        page.wait_for_selector("#headset:not([hidden])")
        page.click("#headset")
        page.wait_for_timeout(1000 * OPEN_S)
        page.evaluate("wearer.person.hold('engage')")
        page.wait_for_timeout(1000 * GESTURE_S)
        page.evaluate("wearer.person.release('engage')")
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for key in ("down", "up"):
                page.evaluate(f"wearer.person.hold('{key}')")
                page.wait_for_timeout(1000)
                page.evaluate(f"wearer.person.release('{key}')")


class Delays:
    """Measured delays and processor times [s]."""

    def __init__(self) -> None:
        self.sent: dict[float, float] = {}
        """Monotonic time at which each frame was sent, by the frame's own time."""
        self.frame: list[float] = []
        self.command: list[float] = []
        self.told: list[float] = []
        self.parse_work: list[float] = []
        """Processor time of the thread, which other load on the machine does not change."""
        self.judge_work: list[float] = []
        self.tick_work: list[float] = []
        self.late_ticks = 0

    def print(self) -> None:
        """Print a row of percentiles for each quantity."""
        for what, delays in (
            ("send -> OperatorFrame", self.frame),
            ("send -> command", self.command),
            ("reported by the device", self.told),
            ("processor: parse", self.parse_work),
            ("processor: judge, smooth", self.judge_work),
            ("processor: frame -> command", self.tick_work),
        ):
            if not delays:
                print(f"  {what:27} none")
                continue
            p50, p99 = np.percentile(np.array(delays) * 1e3, [50, 99])
            print(
                f"  {what:27} n {len(delays):5}  p50 {p50:7.2f} ms  p99 {p99:7.2f} ms  "
                f"max {max(delays) * 1e3:7.2f} ms"
            )


def measure_parsing(delays: Delays) -> None:
    """Time the parsing of 1,000 messages."""
    from xop_lerobot.operator.webxr.protocol import parse_message

    for number in range(1000):
        text = json.dumps(make_message(number, number / 72))
        begun = time.thread_time()
        parse_message(text)
        delays.parse_work.append(time.thread_time() - begun)


def add_device(delays: Delays, origin: Any) -> None:
    """Register the device `measured`: a WebXR page whose frames are timed.

    Args:
        delays: Receives the times.
        origin: Monotonic time at which the sender's clock was zero [s].
    """
    from xop_lerobot.operator.devices import DEVICES
    from xop_lerobot.operator.devices.webxr import WebXrDevice
    from xop_lerobot.operator.frame import OperatorFrame

    class Measured(WebXrDevice):
        def receive(self, frame: OperatorFrame, source_time: float | None = None) -> None:
            before, begun = self._newest, time.thread_time()
            super().receive(frame, source_time)
            delays.judge_work.append(time.thread_time() - begun)
            newest = self._newest
            if newest is not None and newest is not before and source_time is not None:
                sent = source_time + origin.value
                delays.sent[newest.time] = sent
                delays.frame.append(time.monotonic() - sent)

    DEVICES.add("measured", Measured)


def drive(settings: argparse.Namespace, delays: Delays, origin: Any) -> None:
    """Let the sender drive the robot in real time until the sender ends."""
    from xop_lerobot.evaluation.trial import closed_loop
    from xop_lerobot.morphology.morphology import make_morphology
    from xop_lerobot.operator.devices import DeviceConfig
    from xop_lerobot.plant.config import SimulationConfig
    from xop_lerobot.plant.simulation import Simulation
    from xop_lerobot.retarget.config import RetargeterConfig
    from xop_lerobot.session import Tick
    from xop_lerobot.teleoperation import TeleoperationConfig

    fps = settings.fps
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    plant = Simulation(make_morphology(settings.robot), SimulationConfig(), kind="planning")
    config = TeleoperationConfig(
        device=DeviceConfig(type="measured", port=port, code=CODE, max_delay_s=5.0, stale_s=1.0),
        retargeter=RetargeterConfig(type=settings.retargeter),
    )
    with closed_loop(plant, config, fps=fps, realtime=True) as (loop, teleoperation):
        teleoperation.connect()
        loop.reset(seed=0, settle_s=0.8)
        device: Any = teleoperation.device
        arguments: tuple[Any, ...] = (port, settings.seconds, settings.rate)
        send = send_frames
        if settings.sender == "browser":
            send, arguments = send_from_browser, (*arguments, origin)
        page = SPAWN.Process(target=send, args=arguments)
        page.start()
        due = time.monotonic()
        while page.is_alive():
            begun = time.thread_time()
            action, tick = teleoperation.step(Tick(loop.state))
            now = time.monotonic()
            if tick.engaged:
                delays.tick_work.append(time.thread_time() - begun)
            if tick.engaged and tick.frame is not None and tick.frame.time in delays.sent:
                delays.command.append(now - delays.sent[tick.frame.time])
                delays.told.append(device.status.delay or 0.0)
            loop.execute(action, 1 / fps)
            # After a stall of more than 1 s the schedule restarts instead of catching up.
            due = max(due + 1 / fps, time.monotonic() - 1)
            wait = due - time.monotonic()
            delays.late_ticks += wait < 0
            time.sleep(max(wait, 0))
        page.join()


def main() -> None:
    """Run the benchmark and print its delays."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--robot", choices=list_robots(), default="g1")
    parser.add_argument("--retargeter", choices=["direct", "mpc"], default="direct")
    parser.add_argument("--fps", type=int, default=25, help="rate of the control loop [Hz]")
    parser.add_argument("--sender", choices=["program", "browser"], default="program")
    parser.add_argument("--rate", type=float, default=72.0, help="frame rate of the program [Hz]")
    parser.add_argument("--seconds", type=float, default=20.0)
    settings = parser.parse_args()
    delays, origin = Delays(), SPAWN.Value("d", 0.0)
    add_device(delays, origin)
    drive(settings, delays, origin)
    measure_parsing(delays)
    rate = f"{settings.rate:g} Hz" if settings.sender == "program" else "the browser's rate"
    print(
        f"{settings.robot}, {settings.retargeter}, loop at {settings.fps} Hz, frames at "
        f"{rate}, {len(delays.command)} ticks engaged, "
        f"{delays.late_ticks} ticks late, load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    )
    delays.print()


if __name__ == "__main__":
    main()
