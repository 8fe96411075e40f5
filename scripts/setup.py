"""Make `.venv` and install the project in it; started by `setup.sh` with a Python that fits.

Standard library only, since nothing is installed yet. docs/start/setup.md explains the steps.
"""

from __future__ import annotations

import argparse
import ctypes
import fcntl
import os
import queue
import shutil
import subprocess
import sys
import sysconfig
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
STAMP = VENV / ".xop-stamp"
LOG = VENV / "setup.log"
LOCK_FILE = ROOT / "requirements.lock"

PIP = "pip==26.3"
"""Older ones drop extras of a package without a word."""
DISTRIBUTION = "lerobot_teleoperator_xop"
NEEDED_GB = 8.0
"""Room for `.venv` (6.4 GB) and the archives on their way into it [GB]."""
UNLOADABLE = "torchcodec"
"""Taken out of `.venv` where it can't load; its pin stays."""
HEARTBEAT_S = 20.0
"""Period of a sign of life where the output is no terminal [s]."""
TAIL_LINES = 25

RENDER_CHECK = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 3'/><geom size='.5' rgba='1 0 0 1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 48, 64) as renderer:
    renderer.update_scene(data)
    assert renderer.render().max() > 0, "the picture is black"
"""

GL_PACKAGES = {
    "apt-get": ("libegl1", "libgl1", "libgl1-mesa-dri"),
    "dnf": ("mesa-libEGL", "mesa-libGL", "mesa-dri-drivers"),
    "pacman": ("mesa", "libglvnd"),
    "zypper": ("Mesa-libEGL1", "Mesa-libGL1", "Mesa-dri"),
}
COMPILER_PACKAGES = {
    "apt-get": ("gcc", "libc6-dev", "linux-libc-dev"),
    "dnf": ("gcc", "glibc-devel", "kernel-headers"),
    "pacman": ("gcc", "linux-api-headers"),
    "zypper": ("gcc", "glibc-devel", "linux-glibc-devel"),
}
PYTHON_HEADERS = {"apt-get": "python{}-dev", "dnf": "python{}-devel", "zypper": "python{}-devel"}
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
"""Programs that `tests/helpers/browser.py` starts, whichever is found first."""
TEST_PACKAGES = {
    "apt-get": {"Chromium": "chromium", "certutil": "libnss3-tools", "npm": "npm"},
    "dnf": {"Chromium": "chromium", "certutil": "nss-tools", "npm": "npm"},
    "pacman": {"Chromium": "chromium", "certutil": "nss", "npm": "npm"},
    "zypper": {"Chromium": "chromium", "certutil": "mozilla-nss-tools", "npm": "npm-default"},
}
"""What tests of pages need beside: npm brings Node.js, and fetches the headset's emulator."""
INSTALL_COMMANDS = {
    "apt-get": ("apt-get", "install", "-y", "--no-install-recommends"),
    "dnf": ("dnf", "install", "-y"),
    "pacman": ("pacman", "-S", "--noconfirm", "--needed"),
    "zypper": ("zypper", "--non-interactive", "install"),
}


class SetupError(Exception):
    """The set-up can't go on; the message says what to do."""


def find_manager() -> str | None:
    """Return the system's package manager, None where it is none that is known here."""
    return next((name for name in INSTALL_COMMANDS if shutil.which(name)), None)


def find_root_prefix() -> tuple[str, ...] | None:
    """Return what makes a command run as root without a question, None where that may not be."""
    if os.environ.get("XOP_NO_SYSTEM", "0") == "1":
        return None
    if os.geteuid() == 0:
        return ()
    if shutil.which("sudo"):
        asked = subprocess.run(["sudo", "-n", "true"], capture_output=True, check=False)
        if asked.returncode == 0:
            return ("sudo", "-n")
    return None


def is_loadable(library: str) -> bool:
    """Whether the dynamic linker finds `library`."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def lacks_gl() -> bool:
    """Whether software rendering lacks a library (EGL, its Mesa vendor, or GL itself)."""
    if sys.platform != "linux" or os.environ.get("MUJOCO_GL", "egl") != "egl":
        return False
    return not all(map(is_loadable, ("libEGL.so.1", "libGL.so.1")))


def lacks_compiler() -> bool:
    """Whether a C compiler or a header is missing that the dependency evdev is built with."""
    if sys.platform != "linux" or any(VENV.glob("lib/python3.*/site-packages/evdev/__init__.py")):
        return False
    headers = (Path(sysconfig.get_path("include")) / "Python.h", Path("/usr/include/linux/input.h"))
    compiler = shutil.which("cc") or shutil.which("gcc")
    return not (compiler and all(header.exists() for header in headers))


def list_system_packages(manager: str, gl: bool, compiler: bool) -> list[str]:
    """List the packages of `manager` that bring rendering and a compiler."""
    packages = list(GL_PACKAGES[manager]) if gl else []
    if compiler:
        packages += COMPILER_PACKAGES[manager]
        own_headers = Path(sysconfig.get_path("include")) / "Python.h"
        if not own_headers.exists() and manager in PYTHON_HEADERS:
            minor = f"{sys.version_info.major}.{sys.version_info.minor}"
            packages.append(PYTHON_HEADERS[manager].format(minor))
    return packages


def install_system_packages(gl: bool, compiler: bool) -> None:
    """Install what the system lacks.

    Raises:
        SetupError: If it may not be installed, or the package manager fails; carries the command.
    """
    names = [
        name
        for name, lacking in (("software rendering (Mesa's EGL)", gl), ("a C compiler", compiler))
        if lacking
    ]
    missing = " and ".join(names)
    verb = "is" if len(names) == 1 else "are"
    manager = find_manager()
    if manager is None:
        raise SetupError(f"{missing} {verb} missing. Install with the system's package manager.")
    packages = list_system_packages(manager, gl, compiler)
    command = (*INSTALL_COMMANDS[manager], *packages)
    by_hand = f"sudo {' '.join(command)}"
    prefix = find_root_prefix()
    if prefix is None:
        raise SetupError(
            f"{missing} {verb} missing and may not be installed here. Run:\n  {by_hand}"
        )
    say(f"Installing {missing}: {' '.join(packages)} (XOP_NO_SYSTEM=1 forbids it)")
    refresh_lists(manager, prefix)
    if not install_packages(manager, prefix, packages):
        raise SetupError(f"the package manager failed:\n{read_tail()}\nRun by hand:\n  {by_hand}")


def refresh_lists(manager: str, prefix: tuple[str, ...]) -> None:
    """Read apt's package lists anew; they may be old or absent, and a failing mirror may pass."""
    if manager == "apt-get":
        run_logged((*prefix, "apt-get", "update"), "reading package lists", dict(os.environ))


def install_packages(manager: str, prefix: tuple[str, ...], packages: list[str]) -> bool:
    """Install `packages`, the output in the log; return whether that went well."""
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    command = (*prefix, *INSTALL_COMMANDS[manager], *packages)
    return run_logged(command, "installing system packages", environment) == 0


def has_browser() -> bool:
    """Whether the tests find a Chromium: named, on the path, or Playwright's own."""
    if os.environ.get("CHROMIUM") or any(map(shutil.which, BROWSERS)):
        return True
    caches = [Path.home() / folder / "ms-playwright" for folder in (".cache", "Library/Caches")]
    if chosen := os.environ.get("PLAYWRIGHT_BROWSERS_PATH"):
        caches = [Path(chosen)]
    return any(next(cache.glob("chromium-*/INSTALLATION_COMPLETE"), None) for cache in caches)


def list_missing_test_tools() -> list[str]:
    """List what the tests of pages lack here; they skip without it."""
    missing = [] if has_browser() else ["Chromium"]
    return missing + [tool for tool in ("certutil", "npm") if not shutil.which(tool)]


def bring_test_tools() -> None:
    """Install what tests of pages need, where that may be; else say what to run, and go on.

    It never fails: without these tools the tests of pages skip, and say so at the end.
    """
    if not (missing := list_missing_test_tools()):
        return
    manager, prefix = find_manager(), find_root_prefix()
    packages = TEST_PACKAGES[manager] if manager else {}
    if manager and prefix is not None:
        with hold_lock():
            names = [packages[tool] for tool in list_missing_test_tools()]
            if names:
                say(f"Installing for the tests: {' '.join(names)} (XOP_NO_SYSTEM=1 forbids it)")
                refresh_lists(manager, prefix)
            for name in names:  # each by itself: one that has no package keeps nothing else out
                install_packages(manager, prefix, [name])
        if not (missing := list_missing_test_tools()):
            return
    if not manager:
        ways = "Install with the system's package manager"
    else:
        names = [packages[tool] for tool in missing]
        ways = f"Run:\n  sudo {' '.join((*INSTALL_COMMANDS[manager], *names))}"
    if "Chromium" in missing:
        ways += f"\nor, for Chromium:\n  {PYTHON} -m playwright install --with-deps chromium"
    verb = "is" if len(missing) == 1 else "are"
    *others, last = missing
    named = f"{', '.join(others)} and {last}" if others else last
    say(f"{named} {verb} missing: tests of pages will skip. {ways}")


def say(line: str) -> None:
    """Print one line at once."""
    print(line, flush=True)


def read_tail() -> str:
    """Return the last lines of the log."""
    lines = LOG.read_text(errors="replace").splitlines() if LOG.exists() else []
    return "\n".join(f"  | {line}" for line in lines[-TAIL_LINES:])


def describe_line(line: str) -> str | None:
    """Return what a line of pip's output means to a person, None for nothing."""
    words = line.split()
    if line.startswith(("Collecting ", "Installing build dependencies")):
        return " ".join(words[:2]).lower()
    if line.strip().startswith("Downloading "):
        name = words[1].rsplit("/", 1)[-1].split("-", 1)[0]
        return f"downloading {name} {' '.join(words[2:])}"
    if line.startswith("Installing collected packages"):
        return f"unpacking {line.count(',') + 1} packages"
    return None


def run_logged(command: tuple[str, ...], doing: str, environment: dict[str, str]) -> int:
    """Run `command`, its output in the log, and show on one line how far it is.

    Returns:
        Its exit status.
    """
    lines: queue.Queue[str | None] = queue.Queue()
    begun = said = time.monotonic()
    terminal = sys.stdout.isatty()
    with (
        LOG.open("a") as log,
        subprocess.Popen(
            command,
            cwd=ROOT,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
        ) as process,
    ):
        log.write(f"$ {' '.join(command)}\n")
        assert process.stdout is not None
        thread = threading.Thread(target=_pump, args=(process.stdout, lines), daemon=True)
        thread.start()
        try:
            while (line := _next_line(lines)) is not None:
                if line:
                    log.write(line)
                    log.flush()
                    doing = describe_line(line) or doing
                now = time.monotonic()
                if terminal:
                    print(f"\r\033[K  {now - begun:4.0f} s  {doing}"[:100], end="", flush=True)
                elif now - said >= HEARTBEAT_S:
                    say(f"  {now - begun:4.0f} s  {doing}")
                    said = now
        except BaseException:
            process.terminate()
            raise
    if terminal:
        print("\r\033[K", end="", flush=True)
    return process.returncode


def _pump(stream: Iterator[str], lines: queue.Queue[str | None]) -> None:
    for line in stream:
        lines.put(line)
    lines.put(None)


def _next_line(lines: queue.Queue[str | None]) -> str | None:
    """Return the next line, "" after a second without one, None at the end."""
    try:
        return lines.get(timeout=1.0)
    except queue.Empty:
        return ""


def make_clean_environment() -> dict[str, str]:
    """Return the environment less what would lead pip to another Python's packages."""
    return {
        key: value
        for key, value in os.environ.items()
        if key not in {"PYTHONPATH", "PYTHONHOME", "PIP_TARGET", "PIP_PREFIX", "PIP_USER"}
    }


def is_venv_usable() -> bool:
    """Whether `.venv` is of this interpreter's version and its pip runs."""
    try:
        asked = subprocess.run(
            [PYTHON, "-I", "-c", "import pip, sys; print(sys.version_info[:3])"],
            capture_output=True,
            text=True,
            check=False,
        )
    except OSError:
        return False
    return asked.stdout.strip() == str(tuple(sys.version_info[:3]))


def make_venv() -> None:
    """Make `.venv`, anew where what is there can't be used.

    Raises:
        SetupError: If there is too little room, or `venv` fails.
    """
    if is_venv_usable():
        return
    if VENV.exists() or VENV.is_symlink():
        say("Replacing .venv: it is broken or of another Python.")
        VENV.unlink() if VENV.is_symlink() else shutil.rmtree(VENV)
    free_gb = shutil.disk_usage(ROOT).free / 1e9
    if free_gb < NEEDED_GB:
        raise SetupError(f"{ROOT} has {free_gb:.1f} GB free; the set-up needs {NEEDED_GB:.0f} GB.")
    made = subprocess.run(
        [sys.executable, "-I", "-m", "venv", VENV], capture_output=True, text=True, check=False
    )
    if made.returncode != 0:
        raise SetupError(f"python -m venv failed:\n{made.stdout}{made.stderr}")


def run_pip(*arguments: str) -> None:
    """Run the `.venv`'s pip.

    Raises:
        SetupError: If it fails; carries the end of its output.
    """
    options = ["--no-input"] + ["--progress-bar=off"] * (arguments[0] == "install")
    command = (str(PYTHON), "-I", "-m", "pip", *arguments, *options)
    if run_logged(command, "starting pip", make_clean_environment()) != 0:
        raise SetupError(
            f"pip failed:\n{read_tail()}\nThe whole log is {LOG}. Run the same command again "
            "after mending it; what is installed already stays."
        )


def check_rendering() -> None:
    """Render a small picture, as the robots' cameras do.

    Raises:
        SetupError: If that fails, with the command that mends it.
    """
    backend = os.environ.get("MUJOCO_GL", "egl")
    if sys.platform != "linux" or backend in {"0", "disable", "disabled", "false", "off"}:
        return
    rendered = subprocess.run(
        [PYTHON, "-I", "-c", RENDER_CHECK],
        env={**make_clean_environment(), "MUJOCO_GL": backend},
        capture_output=True,
        text=True,
        check=False,
    )
    if rendered.returncode != 0:
        fault = (rendered.stderr.strip().splitlines() or ["no message"])[-1]
        manager = find_manager() or "apt-get"
        command = " ".join((*INSTALL_COMMANDS[manager], *GL_PACKAGES[manager]))
        raise SetupError(
            f"MuJoCo can't render with MUJOCO_GL={backend}: {fault}\nTry: sudo {command}\n"
            "or go on without cameras: MUJOCO_GL=disabled"
        )


def drop_unloadable_torchcodec() -> None:
    """Remove torchcodec where it can't load, as on a machine without FFmpeg's libraries.

    LeRobot then decodes videos with PyAV, as it would anyhow, but without a hundred lines of
    tracebacks at each start.
    """
    loaded = subprocess.run(
        [PYTHON, "-I", "-c", "import torchcodec"], capture_output=True, check=False
    )
    if loaded.returncode != 0:
        run_pip("uninstall", "--yes", UNLOADABLE)


@contextmanager
def hold_lock() -> Iterator[None]:
    """Let one set-up of this checkout run at a time; the lock is on this very file."""
    with Path(__file__).open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("Another set-up of this folder is running; waiting for it.")
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def set_up(stamp: str, install: Callable[[], None]) -> bool:
    """Run `install` and write `stamp`, unless `.venv` carries that stamp already.

    Returns:
        Whether anything was done.
    """
    with hold_lock():
        if STAMP.exists() and STAMP.read_text().strip() == stamp and is_venv_usable():
            return False
        STAMP.unlink(missing_ok=True)
        install()
        STAMP.write_text(f"{stamp}\n")
    return True


def install_all() -> None:
    """Make the environment and install system packages and the project."""
    version = ".".join(map(str, sys.version_info[:3]))
    first = not is_venv_usable()
    say(
        f"Setting up xop-lerobot in .venv with Python {version} ({sys.executable})."
        + (" The first time takes 3 to 6 minutes and 6.4 GB." if first else "")
    )
    make_venv()
    LOG.write_text("")
    gl, compiler = lacks_gl(), lacks_compiler()
    if gl or compiler:
        install_system_packages(gl, compiler)
    run_pip("install", PIP)
    run_pip("install", "-c", str(LOCK_FILE), "-e", f"{ROOT}[dev]")
    drop_unloadable_torchcodec()
    check_rendering()


def write_lock() -> None:
    """Write the installed versions to `requirements.lock`, below its opening comment."""
    skipped = [f"--exclude={name}" for name in (DISTRIBUTION, "pip", "wheel")]
    frozen = subprocess.run(
        [PYTHON, "-I", "-m", "pip", "freeze", "--exclude-editable", *skipped],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    before = LOCK_FILE.read_text().splitlines()
    comment = [line for line in before if line.startswith("#")]
    pins = [line for line in frozen.splitlines() if "==" in line]
    if not any(line.startswith(f"{UNLOADABLE}==") for line in pins):
        pins += [line for line in before if line.startswith(f"{UNLOADABLE}==")]
    pins.sort(key=str.lower)
    LOCK_FILE.write_text("\n".join([*comment, *pins, ""]))
    say(f"{LOCK_FILE}: {len(pins)} versions")


def main() -> int:
    """Run the set-up and return its exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stamp", help="what setup.sh computed from the files that matter")
    parser.add_argument("--test-tools", action="store_true", help="bring what tests need beside")
    parser.add_argument("--write-lock", action="store_true", help="freeze .venv's versions")
    arguments = parser.parse_args()
    if arguments.write_lock:
        write_lock()
        return 0
    if arguments.test_tools:
        bring_test_tools()
        return 0
    if not arguments.stamp:
        parser.error("run scripts/setup.sh, which starts this with --stamp")
    begun = time.monotonic()
    try:
        done = set_up(arguments.stamp, install_all)
    except SetupError as error:
        print(f"set-up failed: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nset-up stopped; the same command goes on with it.", file=sys.stderr)
        return 130
    if done:
        say(f"Set up in {time.monotonic() - begun:.0f} s. The next start takes no time.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
