"""Create `.venv` and install the project in it; started by `setup.sh` with a suitable Python.

Uses only the standard library, since nothing is installed yet. docs/start/setup.md explains the
steps.
"""

from __future__ import annotations

import argparse
import ast
import ctypes
import fcntl
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
STAMP = VENV / ".xop-stamp"
LOCK_FILE = ROOT / "requirements.lock"
MINOR = f"{sys.version_info.major}.{sys.version_info.minor}"

NEEDED_GB = 8.0
"""Disk space for `.venv` (7 GB) and the archives downloaded for it [GB]."""
RENDER_CHECK = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 3'/><geom size='.5' rgba='1 0 0 1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 48, 64) as renderer:
    renderer.update_scene(data)
    assert renderer.render().max() > 0, "the image is black"
"""

VENV_MODULE = "Python's venv"
RENDERING = "software rendering (Mesa's EGL)"
COMPILER = "a C compiler"
HEADERS = "Python's C headers"
PACKAGES = {
    VENV_MODULE: {"apt-get": f"python{MINOR}-venv"},
    RENDERING: {
        "apt-get": "libegl1 libgl1 libgl1-mesa-dri",
        "dnf": "mesa-libEGL mesa-libGL mesa-dri-drivers",
        "pacman": "mesa libglvnd",
        "zypper": "Mesa-libEGL1 Mesa-libGL1 Mesa-dri",
    },
    COMPILER: {
        "apt-get": "gcc libc6-dev linux-libc-dev",
        "dnf": "gcc glibc-devel kernel-headers",
        "pacman": "gcc linux-api-headers",
        "zypper": "gcc glibc-devel linux-glibc-devel",
    },
    HEADERS: {
        "apt-get": f"python{MINOR}-dev",
        "dnf": f"python{MINOR}-devel",
        "pacman": "python",
        "zypper": f"python{MINOR.replace('.', '')}-devel",
    },
    # Needed by the tests of web pages: npm installs Node.js and the headset's emulator.
    "Chromium": dict.fromkeys(("apt-get", "dnf", "pacman", "zypper"), "chromium"),
    "certutil": {
        "apt-get": "libnss3-tools",
        "dnf": "nss-tools",
        "pacman": "nss",
        "zypper": "mozilla-nss-tools",
    },
    "npm": {"apt-get": "npm", "dnf": "npm", "pacman": "npm", "zypper": "npm-default"},
}
"""Packages that provide what pip and uv can't, by requirement and package manager."""
INSTALL_COMMANDS = {
    "apt-get": "apt-get install -y --no-install-recommends",
    "dnf": "dnf install -y",
    "pacman": "pacman -S --noconfirm --needed",
    "zypper": "zypper --non-interactive install",
}
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
"""Programs that `tests/helpers/browser.py` starts, whichever is found first."""

UV_SETTINGS = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "no-index": "UV_NO_INDEX",
    "constraint": "UV_CONSTRAINT",
    "trusted-host": "UV_INSECURE_HOST",
    "default-timeout": "UV_HTTP_TIMEOUT",
    "timeout": "UV_HTTP_TIMEOUT",
    "cert": "SSL_CERT_FILE",
    "proxy": "ALL_PROXY",
}
"""Environment variables of uv that correspond to settings of pip."""


class SetupError(Exception):
    """The set-up can't continue; the message says what to do."""


def say(line: str) -> None:
    """Print one line without buffering."""
    print(line, flush=True)


def make_clean_environment() -> dict[str, str]:
    """Return the environment without variables that point pip to another Python's packages."""
    unwanted = {"PYTHONPATH", "PYTHONHOME", "PIP_TARGET", "PIP_PREFIX", "PIP_USER"}
    return {key: value for key, value in os.environ.items() if key not in unwanted}


def read_output(*command: str | Path) -> str | None:
    """Return the output of a command, or None if it fails or can't be started."""
    try:
        answer = subprocess.run(
            command, env=make_clean_environment(), capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return answer.stdout


def run(*command: str | Path, environment: dict[str, str] | None = None) -> None:
    """Run a command that installs something, showing its output.

    Raises:
        SetupError: If the command fails.
    """
    environment = environment or make_clean_environment()
    if subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode:
        raise SetupError(
            f"the command above failed:\n  {' '.join(map(str, command))}\nFix the cause and run "
            "`make` again; what is already installed is kept."
        )


# -- system packages ----------------------------------------------------------------------------


def is_loadable(library: str) -> bool:
    """Return whether the dynamic linker finds `library`."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def list_missing() -> list[str]:
    """List the requirements for installing and rendering that this system lacks."""
    linux = sys.platform == "linux"
    renders = linux and os.environ.get("MUJOCO_GL", "egl") == "egl"
    # LeRobot depends on evdev, which is published only as source.
    builds = linux and not any(VENV.glob(f"lib/python{MINOR}/site-packages/evdev/__init__.py"))
    has_compiler = shutil.which("cc") or shutil.which("gcc")
    missing = {
        VENV_MODULE: find_spec("ensurepip") is None,
        RENDERING: renders and not all(map(is_loadable, ("libEGL.so.1", "libGL.so.1"))),
        COMPILER: builds and not (has_compiler and Path("/usr/include/linux/input.h").exists()),
        HEADERS: builds and not Path(sysconfig.get_path("include"), "Python.h").exists(),
    }
    return [name for name, is_missing in missing.items() if is_missing]


def has_browser() -> bool:
    """Return whether the tests find Chromium: in $CHROMIUM, on the path, or Playwright's own."""
    if os.environ.get("CHROMIUM") or any(map(shutil.which, BROWSERS)):
        return True
    caches = [Path.home() / folder / "ms-playwright" for folder in (".cache", "Library/Caches")]
    if chosen := os.environ.get("PLAYWRIGHT_BROWSERS_PATH"):
        caches = [Path(chosen)]
    return any(next(cache.glob("chromium-*/INSTALLATION_COMPLETE"), None) for cache in caches)


def list_missing_test_tools() -> list[str]:
    """List the missing tools without which the tests of web pages are skipped."""
    missing = [] if has_browser() else ["Chromium"]
    return missing + [tool for tool in ("certutil", "npm") if not shutil.which(tool)]


def find_manager() -> str | None:
    """Return the system's package manager, or None if there is no supported one."""
    return next(filter(shutil.which, INSTALL_COMMANDS), None)


def find_root_prefix() -> tuple[str, ...] | None:
    """Return a command prefix to run as root without a password, or None if not permitted."""
    if os.environ.get("XOP_NO_SYSTEM", "0") == "1":
        return None
    if os.geteuid() == 0:
        return ()
    return ("sudo", "-n") if read_output("sudo", "-n", "true") is not None else None


def install_missing(list_missing: Callable[[], list[str]]) -> list[str]:
    """Install what `list_missing` names, if permitted, showing the package manager's errors.

    Returns:
        What is still missing.
    """
    missing, manager = list_missing(), find_manager()
    if not missing or manager is None or (prefix := find_root_prefix()) is None:
        return missing
    packages = list_packages(missing, manager)
    say(f"Installing {' '.join(packages)} (XOP_NO_SYSTEM=1 forbids it)")
    if manager == "apt-get":  # its package lists may be outdated or absent
        run_as_root(prefix, "apt-get update")
    for group in packages:  # one at a time: an unavailable package must not block the others
        run_as_root(prefix, f"{INSTALL_COMMANDS[manager]} {group}")
    return list_missing()


def list_packages(missing: list[str], manager: str) -> list[str]:
    """List the packages of `manager` that provide each missing requirement."""
    return [PACKAGES[name][manager] for name in missing if manager in PACKAGES[name]]


def run_as_root(prefix: tuple[str, ...], command: str) -> None:
    """Run a command of the package manager, showing only its errors; failure is ignored."""
    subprocess.run(
        [*prefix, *command.split()],
        env={**os.environ, "DEBIAN_FRONTEND": "noninteractive"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        check=False,
    )


def describe_missing(missing: list[str], consequence: str = "") -> str:
    """Describe what is missing, the consequence, and the command that installs it."""
    *others, last = missing
    named = f"{', '.join(others)} and {last} are" if others else f"{last} is"
    manager = find_manager()
    remedy = "Install with the system's package manager"
    if manager is not None:
        packages = " ".join(list_packages(missing, manager))
        remedy = f"Run:\n  sudo {INSTALL_COMMANDS[manager]} {packages}"
    return f"{named} missing{consequence}. {remedy}"


def install_test_tools() -> None:
    """Install the tools for tests of web pages if permitted; else print how to, and continue."""
    if not list_missing_test_tools():
        return
    with hold_lock():
        missing = install_missing(list_missing_test_tools)
    if missing:
        say(describe_missing(missing, ": tests of pages will skip"))
    if "Chromium" in missing:
        say(f"or, for Chromium:\n  {PYTHON} -m playwright install --with-deps chromium")


# -- the environment ----------------------------------------------------------------------------


def make_uv_environment(pip_settings: str) -> dict[str, str]:
    """Return the environment with pip's settings as uv's variables: uv doesn't read pip's files.

    Args:
        pip_settings: Output of `pip config list`.
    """
    environment = make_clean_environment()
    settings = dict(line.split("=", 1) for line in pip_settings.splitlines() if "=" in line)
    for section in (":env:.", "install.", "global."):  # the first has precedence
        for option, name in UV_SETTINGS.items():
            words = ast.literal_eval(settings.get(section + option, "''")).split()
            # pip ignores a folder that doesn't exist, uv fails.
            words = [word for word in words if not word.startswith("/") or Path(word).exists()]
            if words:
                separator = "," if option == "find-links" else " "
                environment.setdefault(name, separator.join(words))
    if "UV_INDEX" in environment:  # as pip: the best version of all indexes, not the first index
        environment.setdefault("UV_INDEX_STRATEGY", "unsafe-best-match")
    return environment


def is_venv_usable() -> bool:
    """Return whether `.venv` has this interpreter's version and a working pip."""
    version = read_output(PYTHON, "-I", "-c", "import pip, sys; print(sys.version_info[:3])")
    return version == f"{tuple(sys.version_info[:3])}\n"


def make_venv() -> None:
    """Create `.venv`, replacing one that can't be used.

    Raises:
        SetupError: If there is too little disk space, or `venv` fails.
    """
    if is_venv_usable():
        return
    if VENV.exists() or VENV.is_symlink():
        say("Replacing .venv: it is broken or belongs to another Python.")
        VENV.unlink() if VENV.is_symlink() else shutil.rmtree(VENV)
    free_gb = shutil.disk_usage(ROOT).free / 1e9
    if free_gb < NEEDED_GB:
        raise SetupError(f"{ROOT} has {free_gb:.1f} GB free; the set-up needs {NEEDED_GB:.0f} GB.")
    run(sys.executable, "-I", "-m", "venv", VENV)


def install_project() -> None:
    """Install the project and its dependencies in the lock's versions, checked by their hashes.

    With uv, or with pip if uv can't be installed or `XOP_INSTALLER=pip` is set.

    Raises:
        SetupError: If the installation fails.
    """
    pip = (PYTHON, "-I", "-m", "pip", "--disable-pip-version-check")
    try:
        if os.environ.get("XOP_INSTALLER") == "pip":
            raise SetupError("XOP_INSTALLER=pip")
        (pin,) = re.findall(r"^uv==.*(?:\n +--hash.*)*", LOCK_FILE.read_text(), re.MULTILINE)
        (VENV / "uv.txt").write_text(pin)
        run(*pip, "install", "--quiet", "--requirement", VENV / "uv.txt")
    except SetupError:
        say("Installing with pip instead of uv; this takes longer.")
        run(*pip, "install", "--requirement", LOCK_FILE)
        run(*pip, "install", "--no-deps", "--no-build-isolation", "--editable", ROOT)
    else:
        run(
            *(VENV / "bin" / "uv", "pip", "install", "--python", PYTHON),
            *("--compile-bytecode", "--constraints", LOCK_FILE, "--editable", f"{ROOT}[dev]"),
            environment=make_uv_environment(read_output(*pip, "config", "list") or ""),
        )


def check_rendering() -> None:
    """Render a small image, as the robots' cameras do.

    Raises:
        SetupError: If rendering fails, with the command that may fix it.
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
        command = f"{INSTALL_COMMANDS[manager]} {PACKAGES[RENDERING][manager]}"
        raise SetupError(
            f"MuJoCo can't render with MUJOCO_GL={backend}: {fault}\nTry: sudo {command}\n"
            "or continue without cameras: MUJOCO_GL=disabled"
        )


def drop_unloadable_torchcodec() -> None:
    """Remove torchcodec if it can't be loaded, as on a machine without FFmpeg's libraries.

    LeRobot would fall back to PyAV anyway, but only after printing a hundred lines of tracebacks
    at each start.
    """
    if read_output(PYTHON, "-I", "-c", "import torchcodec") is None:
        run(PYTHON, "-I", "-m", "pip", "uninstall", "--quiet", "--yes", "torchcodec")


@contextmanager
def hold_lock() -> Iterator[None]:
    """Hold the lock of this checkout's set-up, on this file; waits for another set-up."""
    with Path(__file__).open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("Another set-up of this folder is running; waiting for it.")
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def set_up(stamp: str, install: Callable[[], None]) -> bool:
    """Run `install` and write `stamp`, unless `.venv` already has that stamp.

    Returns:
        Whether `install` was run.
    """
    with hold_lock():
        if STAMP.exists() and STAMP.read_text().strip() == stamp and is_venv_usable():
            return False
        STAMP.unlink(missing_ok=True)  # an interrupted set-up must not count as complete
        install()
        STAMP.write_text(f"{stamp}\n")
    return True


def install_all() -> None:
    """Install system packages, create the environment and install the project in it.

    Raises:
        SetupError: If any step fails.
    """
    version = ".".join(map(str, sys.version_info[:3]))
    first = not is_venv_usable()
    say(
        f"Setting up xop-lerobot in .venv with Python {version} ({sys.executable})."
        + (" The first time takes 1 to 4 minutes and 7 GB." if first else "")
    )
    if missing := install_missing(list_missing):
        raise SetupError(describe_missing(missing))
    make_venv()
    install_project()
    drop_unloadable_torchcodec()
    check_rendering()


def main() -> int:
    """Run the set-up; returns its exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stamp", help="hash of the files that decide the installation")
    parser.add_argument("--test-tools", action="store_true", help="install the tests' tools only")
    arguments = parser.parse_args()
    if arguments.test_tools:
        install_test_tools()
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
        print("\nset-up interrupted; run the same command to resume it.", file=sys.stderr)
        return 130
    if done:
        say(f"Set up in {time.monotonic() - begun:.0f} s. The next start takes no time.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
