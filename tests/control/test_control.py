"""Changes from outside: the socket, its client, and keys."""

from __future__ import annotations

import json
import os
import socket
import stat
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from xop_lerobot.control import client as control_client
from xop_lerobot.control import server as control_server
from xop_lerobot.control.client import (
    PRESET_KEYS,
    TOGGLE_KEYS,
    ControlClient,
    NoSession,
    Refused,
    press,
)
from xop_lerobot.control.protocol import MAX_LINE, find_runtime_dir, find_socket
from xop_lerobot.control.server import ControlFault, ControlServer
from xop_lerobot.core.errors import BadValue
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.retarget.changes import make_toggle, parse_change
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.online import OnlineSettings


class Session:
    """The settings of a session without its robot."""

    def __init__(self) -> None:
        self.online = OnlineSettings(make_morphology("rby1"), RetargeterConfig())

    @property
    def settings(self) -> dict:
        return self.online.current.to_dict()

    def change(self, change, source="call") -> dict:
        return self.online.request(parse_change(change), source).to_dict()

    def toggle(self, name, source="call") -> dict:
        return self.online.request_from(lambda now: make_toggle(name, now), source).to_dict()


@pytest.fixture
def target() -> Session:
    return Session()


@pytest.fixture
def server(tmp_path, target):
    server = ControlServer(tmp_path / "run" / "xop.sock", target)
    yield server
    server.close()
    server.close()


@pytest.fixture
def client(server):
    with ControlClient(server.path, timeout=60) as client:
        yield client


def send_raw(path: Path, data: bytes) -> tuple[dict, bytes]:
    """What comes back for raw bytes: the first answer, and what follows it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as raw:
        raw.settimeout(60)
        raw.connect(str(path))
        raw.sendall(data)
        with raw.makefile("rb") as lines:
            return json.loads(lines.readline()), lines.readline()


# -- requests ------------------------------------------------------------------------------


def test_a_change_is_answered_with_what_will_hold(client, target):
    settings = client.request({"preset": "conservative", "weights": {"position": 2.0}})
    assert settings["preset"] == "conservative"
    assert settings["weights"] == {"position": 2.0}
    assert target.settings["preset"] == "default"  # until the next tick
    (applied,) = target.online.take()
    assert applied.to_dict() == {
        "source": "control",
        "change": {"preset": "conservative", "weights": {"position": 2.0}},
    }
    assert client.request({"get": "settings"}) == settings
    assert client.request({"toggle": "upright"})["constraints"] == ["upright"]
    assert client.request({"toggle": "upright"})["constraints"] == []


REFUSALS = {
    '{"weights": {"positon": 1}}': "unknown weight 'positon'. Known: change, collision",
    '{"weights": {"position": -1}}': (
        "weight 'position' must be a number above 0 and at most 1e+06, got -1"
    ),
    '{"weights": {"terminal": NaN}}': "weight 'terminal' must be a number from 0 to 1e+06, got nan",
    '{"weights": {"terminal": 1e999}}': (
        "weight 'terminal' must be a number from 0 to 1e+06, got inf"
    ),
    '{"preset": "fast"}': "unknown preset 'fast'. Known: aggressive, conservative, default, table1",
    '{"colour": "red"}': "unknown setting 'colour'. Known: body, constraints, mode, preset,",
    "{}": "a change must change something: preset, weights, variant,",
    '{"mode": 1}': "mode must be a name, got 1",
    '{"targets": []}': "there must be a target: head, left_wrist, right_wrist",
    '{"body": ["tail"]}': "unknown part of the body 'tail'. Known: head_0, head_1,",
    '{"toggle": "lights"}': "unknown constraint or preset 'lights'. Known: aggressive,",
    '{"get": "weather"}': "'get' must be 'settings', got 'weather'",
    '{"get": "settings", "mode": "mobile"}': (
        "'get' must be the only key of a request, got get, mode"
    ),
}


@pytest.mark.parametrize("line", REFUSALS)
def test_a_refused_request_says_why_and_changes_nothing(server, target, line):
    before = target.online.coming
    good = b'{"get": "settings"}\n'
    reply, after = send_raw(server.path, line.encode() + b"\n" + good)
    assert not reply["ok"]
    assert reply["error"].startswith(REFUSALS[line])
    assert json.loads(after)["ok"]  # the client may go on
    assert target.online.coming is before
    assert target.online.take() == ()


def test_half_a_bad_change_changes_nothing(client, target):
    with pytest.raises(Refused, match="unknown constraint 'sideways'"):
        client.request({"preset": "aggressive", "constraints": {"sideways": True}})
    assert client.request({"get": "settings"})["preset"] == "default"


@pytest.mark.parametrize(
    "data",
    [
        b"POST / HTTP/1.1\r\n",
        b"\x80\x04\x95.\n",
        b"[1]\n",
        b"[" * 10_000 + b"\n",
        b'{"preset": "' + b"x" * MAX_LINE + b'"}\n',
    ],
    ids=["http", "pickle", "list", "nested", "long"],
)
def test_who_speaks_something_else_is_disconnected(server, target, data):
    reply, after = send_raw(server.path, data + b'{"preset": "aggressive"}\n')
    assert not reply["ok"]
    assert "a request" in reply["error"]
    assert after == b""
    assert target.online.take() == ()


def test_clients_beside_each_other(server, target):
    def ask(weight: str) -> None:
        with ControlClient(server.path) as client:
            for value in range(1, 21):
                client.request({"weights": {weight: value}})

    names = ("position", "orientation", "stance", "control")
    threads = [threading.Thread(target=ask, args=(name,)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(target.online.take()) == len(names)  # of 80 requests, the last of each weight
    assert target.settings["weights"] == dict.fromkeys(names, 20)


def test_who_asks_too_fast_waits_for_the_answers(server, client, monkeypatch):
    """The first burst is answered at once; then the requests come as evenly as they may."""
    client.request({"get": "settings"})  # it has been let in
    now = 100.0

    def sleep(wait: float) -> None:
        nonlocal now
        now += wait

    clock = SimpleNamespace(monotonic=lambda: now, sleep=sleep)
    monkeypatch.setattr(control_server, "time", clock)
    server._due = 0.0

    def ask(times: int) -> float:
        begun = now
        for _ in range(times):
            client.request({"get": "settings"})
        return now - begun

    assert ask(50) == pytest.approx(0.0)
    assert ask(200) == pytest.approx(2.0)
    now += 60.0  # who was silent may ask at once again, and no more at once than before
    assert ask(50) == pytest.approx(0.0)
    assert ask(100) == pytest.approx(1.0)


def test_who_comes_again_and_again_waits_too(server, monkeypatch):
    waits: list[float] = []
    clock = SimpleNamespace(monotonic=lambda: 100.0, sleep=waits.append)
    monkeypatch.setattr(control_server, "time", clock)
    server._due = 0.0
    for _ in range(26):  # a connection and a line are two
        send_raw(server.path, b"GET / HTTP/1.1\r\n")
    assert waits


def test_too_many_clients_are_sent_away(server):
    clients = [ControlClient(server.path) for _ in range(8)]
    for client in clients:
        client.request({"get": "settings"})
    with ControlClient(server.path) as one_more, pytest.raises((Refused, NoSession)):
        one_more.request({"get": "settings"})
    clients[0].request({"get": "settings"})
    for client in clients:
        client.close()


def test_a_fault_of_the_session_does_not_close_the_socket(server, target, monkeypatch, caplog):
    monkeypatch.setattr(target.online, "request", lambda *_: 1 / 0)
    with ControlClient(server.path) as client:
        with pytest.raises(Refused, match="^the request has failed; see the log of the session$"):
            client.request({"preset": "default"})
        assert client.request({"get": "settings"})["preset"] == "default"
    assert "ZeroDivisionError" in caplog.text


# -- the socket ----------------------------------------------------------------------------


def test_only_its_user_may_open_it(server):
    assert stat.S_IMODE(server.path.stat().st_mode) == 0o600
    assert stat.S_IMODE(server.path.parent.stat().st_mode) == 0o700


def test_closing_removes_it_and_ends_the_threads(tmp_path, target):
    path = tmp_path / "xop.sock"
    server = ControlServer(path, target)
    client = ControlClient(path)
    client.request({"get": "settings"})
    server.close()
    assert not path.exists()
    with pytest.raises(NoSession):
        client.request({"get": "settings"})
    client.close()
    assert not any(thread.name == "xop-control" for thread in threading.enumerate())


def test_what_a_killed_session_left_is_replaced(tmp_path, target):
    path = tmp_path / "xop.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as left:
        left.bind(str(path))
    server = ControlServer(path, target)
    with ControlClient(path) as client:
        assert client.request({"get": "settings"})["preset"] == "default"
    server.close()


def test_two_sessions_do_not_share_a_socket(server, target):
    with pytest.raises(ControlFault) as fault:
        ControlServer(server.path, target)
    assert str(fault.value) == (
        f"control socket '{server.path}': another session listens there. Give each its own "
        "--teleop.session or --teleop.control"
    )
    with ControlClient(server.path) as client:  # the first one is as it was
        client.request({"get": "settings"})


def test_a_file_is_not_overwritten(tmp_path, target):
    path = tmp_path / "notes.txt"
    path.write_text("mine")
    with pytest.raises(ControlFault, match="there is a file of that name"):
        ControlServer(path, target)
    assert path.read_text() == "mine"


def test_a_directory_that_others_may_change_is_refused(tmp_path, target):
    folder = tmp_path / "open"
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(ControlFault, match="others may change the directory"):
        ControlServer(folder / "xop.sock", target)


def test_where_the_socket_is(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert find_socket("", "default") is None
    assert find_socket("False", "default") is None
    assert find_socket("True", "left") == tmp_path / "xop" / "left.sock"
    assert find_socket("/run/x.sock", "left") == Path("/run/x.sock")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert find_runtime_dir().name == f"xop-{os.getuid()}"
    with pytest.raises(BadValue, match="the path of a socket may have 100 bytes"):
        find_socket("/" + "x" * 100, "default")
    with pytest.raises(BadValue, match="names no file"):
        find_socket("true", "../../etc/passwd")


# -- xop-control ---------------------------------------------------------------------------


def run(server, capsys, *flags: str) -> dict:
    control_client.main(["--socket", str(server.path), *flags])
    return json.loads(capsys.readouterr().out)


def test_the_command(server, capsys):
    shown = run(server, capsys, "--preset", "conservative", "--weights", "position=2", "stance=0.5")
    assert shown["weights"] == {"position": 2.0, "stance": 0.5}
    shown = run(server, capsys, "--variant", "v2", "--constraints", "upright=on")
    assert (shown["targets"], shown["constraints"]) == (["left_wrist"], ["upright"])
    shown = run(server, capsys, "--targets", "head", "left_wrist", "--body")
    assert (shown["targets"], shown["body"]) == (["head", "left_wrist"], [])
    assert run(server, capsys, "--toggle", "upright")["constraints"] == []
    assert run(server, capsys)["preset"] == "default"  # what is in force: no tick has passed


@pytest.mark.parametrize(
    "flags, error",
    [
        (("--weights", "position"), "--weights takes name=value, got 'position'"),
        (("--weights", "position=two"), "weight 'position' must be a number, got 'two'"),
        (("--constraints", "upright=2"), "constraint 'upright' must be on or off, got '2'"),
        (
            ("--preset", "x"),
            "unknown preset 'x'. Known: "
            "aggressive, conservative, default, table1, table1_charitable",
        ),
    ],
)
def test_mistakes_of_the_command_are_one_line(server, flags, error):
    with pytest.raises(SystemExit) as stop:
        control_client.main(["--socket", str(server.path), *flags])
    assert str(stop.value) == f"error: {error}"


def test_the_command_without_a_session(tmp_path):
    with pytest.raises(SystemExit) as stop:
        control_client.main(["--socket", str(tmp_path / "none.sock")])
    assert str(stop.value) == (
        f"error: no session listens at '{tmp_path / 'none.sock'}' (No such file or directory). "
        "Start it with --teleop.control=true, and name it with --session or --socket"
    )


# -- keys ----------------------------------------------------------------------------------


def test_keys(target, caplog):
    with caplog.at_level("INFO"):
        assert press("C", target)
        assert target.online.coming.preset == "conservative"
        assert press("u", target)
    assert target.online.coming.constraints == {"upright"}
    assert not press("x", target)
    assert [each.source for each in target.online.take()] == ["key", "key"]
    assert caplog.messages[-1] == "Key 'u': preset conservative, constraints upright."


def test_a_key_that_is_refused_says_so(caplog):
    direct = Session()
    direct.online = OnlineSettings(make_morphology("g1"), RetargeterConfig(type="direct"))
    assert press("a", direct)
    assert caplog.messages == [
        "Key 'a' changes nothing: retargeter 'direct' has no presets, weights, targets or "
        "constraints; its mode alone can be changed"
    ]


def test_no_key_is_one_of_lerobots():
    assert not ({*PRESET_KEYS, *TOGGLE_KEYS} & {"n", "r", "q"})
    assert not set(PRESET_KEYS) & set(TOGGLE_KEYS)
