"""`xop-doctor`: what it finds on machines that are ready and on such that are not."""

from __future__ import annotations

import contextlib
import datetime
import importlib.metadata
import json
import re
import socket
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from avp_server import AvpServer
from ports import find_port
from websockets.exceptions import ConnectionClosed
from webxr_client import Page

from xop_lerobot.core.transforms import make_pose, quat_exp
from xop_lerobot.doctor import checks, cli
from xop_lerobot.doctor.checks import (
    check_disk,
    check_gl,
    check_interpreter,
    check_plugin,
    find_faults,
)
from xop_lerobot.doctor.finding import Answer, Finding, Level, Setup, run_child
from xop_lerobot.doctor.headset import check_certificate, check_headset, check_ports
from xop_lerobot.operator.devices.webxr import WebXrDevice
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.webxr.certificate import get_certificate

LEROBOT = importlib.metadata.version("lerobot")
ROBOTS = "xop_g1, xop_rby1, xop_rby1m"


def test_interpreter(monkeypatch):
    found = check_interpreter(Setup())
    assert found.level is Level.OK, found.text
    monkeypatch.setattr(checks, "DISTRIBUTION", "nobody-has-this")
    found = check_interpreter(Setup())
    assert found.level is Level.FAIL
    assert found.advice == "install it into this Python: pip install -e . in the project's folder"
    assert find_faults(["numpy>=1", "numpy<1", "not-there>=2", "torch; extra == 'x'"]) == [
        f"numpy is {np.__version__}, and <1 is needed",
        "not-there is not installed",
    ]
    monkeypatch.setattr(checks, "DISTRIBUTION", "numpy")
    monkeypatch.setattr("platform.python_version", lambda: "2.7.18")
    assert check_interpreter(Setup()).advice == "make a new environment with that Python"


@pytest.mark.slow
def test_gl(monkeypatch):
    found = check_gl(Setup())
    assert found.level in (Level.OK, Level.WARN), found.text
    assert found.figures["picture_ms"] > 0
    monkeypatch.setenv("MUJOCO_GL", "off")
    found = check_gl(Setup())
    assert found.level is Level.FAIL
    assert "rendering is switched off" in found.text
    assert found.advice.endswith("or unset MUJOCO_GL=off")


def test_children_may_crash_and_hang():
    assert run_child("print(sys.argv) if False else print('well')") == Answer(True, "well")
    assert run_child("raise ValueError('no good')") == Answer(False, "ValueError: no good")
    crashed = run_child("import os; os.abort()")
    assert not crashed.ok
    assert run_child("import time; time.sleep(60)", timeout=0.5) == Answer(
        False, "no answer within 0.5 s"
    )


def test_plugin(monkeypatch):
    known: dict = {
        "robots": ["xop_g1", "xop_rby1", "xop_rby1m"], "teleoperators": ["xop"], "patches": 15,
        "refused": [], "warned": [],
    }  # fmt: skip

    def answer(ok: bool, value: object) -> Finding:
        text = value if isinstance(value, str) else f"noise\n{json.dumps(value)}"
        monkeypatch.setattr(checks, "run_child", lambda *_, **__: Answer(ok, text))
        return check_plugin(Setup())

    fine = answer(True, known)
    assert (fine.level, fine.text) == (
        Level.OK,
        f"LeRobot {LEROBOT} knows {ROBOTS} and the teleoperator xop; all 15 patches fit it",
    )
    missing = answer(True, known | {"robots": ["xop_g1", "xop_rby1m"], "teleoperators": []})
    assert (missing.level, missing.text) == (Level.FAIL, "LeRobot does not know xop_rby1, xop")
    assert (
        answer(False, "ImportError: torch").text == "LeRobot cannot be loaded: ImportError: torch"
    )


@pytest.mark.parametrize(
    ("refused", "warned", "level"), [([], ["b."], Level.WARN), (["a."], ["b."], Level.FAIL)]
)
def test_a_lerobot_that_does_not_fit(monkeypatch, refused, warned, level):
    known = {
        "robots": ["xop_g1", "xop_rby1", "xop_rby1m"], "teleoperators": ["xop"], "patches": 15,
        "refused": refused, "warned": warned,
    }  # fmt: skip
    monkeypatch.setattr(checks, "run_child", lambda *_, **__: Answer(True, json.dumps(known)))
    found = check_plugin(Setup())
    assert (found.level, found.figures["misfits"]) == (level, [*refused, *warned])
    assert found.text == (
        f"LeRobot {LEROBOT} knows {ROBOTS} and the teleoperator xop; of 15 patches of it "
        f"{len(refused + warned)} do not fit. {' '.join(refused + warned)}"
    )
    assert found.advice == (
        "install the LeRobot that this release is made for (pip install -e .), or a newer release "
        "of this project"
    )


@pytest.mark.slow
def test_plugin_of_this_machine():
    found = check_plugin(Setup())
    assert found.level is Level.OK
    assert found.text.endswith("; all 15 patches fit it")


def test_disk(tmp_path, monkeypatch):
    deep = tmp_path / "not" / "yet" / "there"
    for free, level in ((50, Level.OK), (5, Level.WARN), (0.2, Level.FAIL)):
        usage = type("Usage", (), {"free": free * 1e9})
        monkeypatch.setattr(checks.shutil, "disk_usage", lambda _, usage=usage: usage)
        found = check_disk(Setup(root=deep))
        assert found.level is level
        assert found.text == f"{free:.1f} GB are free for {deep}"
        assert found.figures["folder"] == str(tmp_path)
    monkeypatch.setattr(checks.os, "access", lambda *_: False)
    assert "cannot be written" in check_disk(Setup(root=deep)).text


def test_ports():
    port = find_port()
    assert check_ports(Setup(port=port)).level is Level.OK
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        taken.listen(1)
        found = check_ports(Setup(port=port))
        assert found.level is Level.FAIL
        assert found.text.startswith(f"port {port} at 127.0.0.1 cannot be opened: ")
        assert check_ports(Setup("avp", "127.0.0.1", port)).text == (
            f"127.0.0.1 answers at port {port}"
        )
    found = check_ports(Setup("avp", "127.0.0.1", port))
    assert found.level is Level.FAIL
    assert found.advice.startswith("open Tracking Streamer in the headset and press Start")
    assert check_ports(Setup("avp")).advice == "pass --host ADDRESS"
    assert check_ports(Setup("webxr", "192.0.2.7", port)).level is Level.FAIL  # nobody's


def test_certificate(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    lan = Setup("webxr", "0.0.0.0")
    assert check_certificate(Setup("avp")).level is Level.SKIP
    assert check_certificate(Setup()).level is Level.SKIP
    found = check_certificate(lan)
    assert (found.level, found.advice) == (Level.OK, "")
    assert found.text.endswith("there is none yet; the next session makes one")
    assert list(tmp_path.iterdir()) == []  # it only looks
    get_certificate()
    found = check_certificate(lan)
    assert found.level is Level.OK
    assert found.figures["days"] > 300
    past = datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=380)
    get_certificate(names=["localhost"], now=past)
    for path in tmp_path.rglob("webxr.*"):
        path.unlink()
    get_certificate(now=past)
    found = check_certificate(lan)
    assert found.level is Level.WARN
    assert found.advice == "headsets will ask again whether to trust it"


# -- a headset -----------------------------------------------------------------------------


class Wearer(threading.Thread):
    """Sends a person at `rate` [Hz] who holds the hands still, or shows but one of them."""

    def __init__(
        self,
        server: AvpServer,
        rate: float = 100,
        one_hand: bool = False,
        hand_rate: float | None = None,
    ) -> None:
        super().__init__(daemon=True)
        self._server, self._rate, self._one_hand = server, rate, one_hand
        self._hand_period = None if hand_rate is None else 1 / hand_rate
        self.over = threading.Event()

    def run(self) -> None:
        i, shown, wrists = 0, -1, []
        while not self.over.wait(1 / self._rate):
            i += 1
            sway = 0.001 * np.array([np.sin(i / 9), np.cos(i / 7), np.sin(i / 5)])
            quat = quat_exp(sway)
            period = self._hand_period
            now = i if period is None else int(time.monotonic() / period)
            if now != shown:  # else the app shows them as it did before
                wrists = [make_pose(sway + [0.3, y, 1.1], quat) for y in (0.2, -0.2)]
            shown = now
            if self._one_hand:
                wrists[0] = np.array([0.3, 0.2, 1.1, 1, 0, 0, 0])  # as the app shows a lost one
            head = make_pose(sway + [0, 0, 1.6], quat)
            self._server.send(OperatorFrame(0.0, head, *wrists, pinch=np.full(2, 0.05)))


def measure(seconds: float = 1.0, **wearer) -> Finding:
    server = AvpServer()
    worn = Wearer(server, **wearer)
    worn.start()
    try:
        setup = Setup("avp", "127.0.0.1", server.port, seconds=seconds, wait=30.0)
        return check_headset(setup)
    finally:
        worn.over.set()
        worn.join()
        server.close()


def test_a_headset_that_streams():
    found = measure()
    assert "Vision Pro at 127.0.0.1" in found.text
    assert "delay unknown" in found.text
    assert found.figures["rate_hz"] > 1
    assert found.figures["seen"]["head"] > 0
    assert found.figures["delay_ms"] is None


@pytest.mark.slow
def test_a_slow_stream_and_a_lost_hand():
    slow = measure(rate=8)
    assert slow.level is Level.FAIL
    assert slow.advice.startswith("the robot would be disengaged repeatedly")
    lost = measure(one_hand=True)
    assert lost.level in (Level.WARN, Level.FAIL)
    assert lost.figures["seen"]["left"] < 0.5
    assert lost.figures["counts"]["left_frozen"] > 0


def test_hands_that_are_shown_too_seldom():
    found = measure(hand_rate=8, seconds=1.5)
    assert found.level is Level.FAIL
    assert "updates your hands only" in found.text
    assert found.advice.startswith("hold both hands in front of you, in good light")
    assert 3 < found.figures["hand_rates_hz"]["left"] < 12.5


@pytest.mark.slow
def test_an_app_that_refuses_this_version():
    server, over = AvpServer(), threading.Event()

    def refuse() -> None:
        while not over.wait(0.1):
            server.send(b"")  # an update in which everything has its default

    refusing = threading.Thread(target=refuse)
    refusing.start()
    try:
        found = check_headset(Setup("avp", "127.0.0.1", server.port, wait=2.0))
    finally:
        over.set()
        refusing.join()
        server.close()
    assert found.level is Level.FAIL
    assert "Tracking Streamer refuses this version of xop-lerobot" in found.text
    assert found.advice == "update xop-lerobot, or use a version of the app that this one speaks to"


def test_nobody_streams():
    found = check_headset(Setup("avp", "127.0.0.1", find_port(), wait=1.5))
    assert found.level is Level.FAIL
    assert "no pose has come within 1.5 s" in found.text
    assert "nobody answers" in found.text
    assert check_headset(Setup()).level is Level.SKIP


def test_a_page_that_streams(capsys):
    """Its address is printed, and goes beside the object where JSON is asked for."""
    port, findings, printed = find_port(), [], ""
    flags = ["--device=webxr", f"--port={port}", "--only=headset", "--seconds=1", "--json"]
    checking = threading.Thread(target=lambda: findings.append(cli.main([*flags, "--wait=60"])))
    checking.start()
    while "code=" not in printed:
        assert checking.is_alive()
        printed += capsys.readouterr().err
        time.sleep(0.01)
    code = re.findall(r"code=(\w+)", printed)[0]
    door = SimpleNamespace(url=f"http://localhost:{port}/", certificate=None)
    page = Page(cast("WebXrDevice", door), code=code)
    page.wait_for("ping")
    with contextlib.suppress(ConnectionClosed):  # the check is over
        for i in range(4000):
            sway = 0.001 * np.sin(i / 5)
            hand = {"wrist": [0.2 + sway, 1.1, -0.3, 0, 0, 0, 1], "pinch": 0.05}
            page.send(
                {
                    "type": "frame", "seq": i, "t": page.clock() * 1e3, "source": "standin",
                    "head": [sway, 1.6, 0, 0, 0, 0, 1], "left": hand, "right": hand,
                }
            )  # fmt: skip
            time.sleep(0.01)
    checking.join()
    (check,) = json.loads(capsys.readouterr().out)["checks"]
    assert check["figures"]["rate_hz"] > 1
    assert check["figures"]["delay_ms"] >= 0
    assert f"WebXR page at http://localhost:{port}/" in check["text"]


# -- the planner, and the command ----------------------------------------------------------


@pytest.mark.parametrize(
    ("median", "slow", "level"),
    [(10, 20, Level.OK), (20, 35, Level.WARN), (45, 60, Level.FAIL)],
)
def test_head_room_of_the_planner(monkeypatch, median, slow, level):
    figures = {"wanted_hz": 25.0, "step_ms_median": median, "step_ms_p99": slow}
    monkeypatch.setattr("xop_lerobot.evaluation.bench.run_bench", lambda config: figures)
    monkeypatch.setattr(checks.os, "getloadavg", lambda: (99.0, 0, 0))
    found = checks.check_cpu(Setup(robot="rby1", mode="mobile"))
    assert found.level is level
    assert found.text.startswith(f"a plan for rby1, mobile, takes {median:.1f} ms of the 40 ms")
    assert found.figures["period_ms"] == 40
    if found.advice:
        assert found.advice.endswith("Other programs are using the CPU: close them first.")


@pytest.fixture
def fake_checks(monkeypatch) -> dict:
    def fail(setup: Setup) -> Finding:
        return Finding(Level.FAIL, f"no {setup.robot}", "buy one", {"robots": 0})

    def crash(setup: Setup) -> Finding:
        raise RuntimeError("oh")

    checks = {
        "well": lambda _: Finding(Level.OK, "all is well"),
        "so_so": lambda _: Finding(Level.WARN, "it is slow", "wait"),
        "bad": fail,
        "broken": crash,
    }
    monkeypatch.setattr(cli, "CHECKS", checks)
    return checks


def test_what_it_prints(fake_checks, capsys):
    assert cli.main(["--only", "well,so_so"]) == 0
    assert capsys.readouterr().out == (
        "OK    well         all is well\n"
        "WARN  so_so        it is slow\n"
        "                   → wait\n"
        "\nready: 0 of 2 checks failed, 1 with a warning\n"
    )
    assert cli.main(["--only=bad,broken", "--robot", "rby1"]) == 1
    assert capsys.readouterr().out == (
        "FAIL  bad          no rby1\n"
        "                   → buy one\n"
        "FAIL  broken       RuntimeError: oh\n"
        "\nnot ready: 2 of 2 checks failed, 0 with a warning\n"
    )


def test_json(fake_checks, capsys):
    assert cli.main(["--only=bad,well", "--json"]) == 1
    assert json.loads(capsys.readouterr().out) == {
        "ok": False,
        "checks": [
            {
                "check": "bad", "level": "fail", "text": "no g1", "advice": "buy one",
                "figures": {"robots": 0},
            },
            {
                "check": "well", "level": "ok", "text": "all is well", "advice": "",
                "figures": {},
            },
        ],
    }  # fmt: skip


@pytest.mark.parametrize(
    ("flags", "fault"),
    [
        (["--only=x"], "unknown check 'x'. Known: certificate, cpu, disk, gl, headset, interpret"),
        (["--device=quest"], "unknown --device 'quest'. Known: avp, webxr"),
        (["--mode=fly"], "unknown --mode 'fly'. Known: mobile, stationary"),
        (["--robot=r2d2"], "unknown robot 'r2d2'. Known: "),
        (["--seconds=0"], "--seconds must be above 0, got 0"),
        (["--help-me"], "unknown flag of xop-doctor '--help-me'. Known: "),
    ],
)
def test_mistakes(flags, fault, capsys):
    assert cli.main(flags) == 2
    assert capsys.readouterr().err.startswith(f"error: {fault}")


def test_where_datasets_go(monkeypatch):
    monkeypatch.setenv("HF_LEROBOT_HOME", "/data/robots")
    assert cli.find_root() == Path("/data/robots")
    monkeypatch.delenv("HF_LEROBOT_HOME")
    monkeypatch.setenv("HF_HOME", "/data/hf")
    assert cli.find_root() == Path("/data/hf/lerobot")
    monkeypatch.delenv("HF_HOME")
    assert cli.find_root() == Path.home() / ".cache" / "huggingface" / "lerobot"
