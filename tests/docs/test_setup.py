"""The front door: interpreter search, stamp, lock, messages. Nothing is installed here."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


def load_setup() -> ModuleType:
    spec = importlib.util.spec_from_file_location("xop_setup", ROOT / "scripts" / "setup.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def setup(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Load the set-up with its `.venv` in a folder of its own."""
    module = load_setup()
    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(module, "VENV", tmp_path / ".venv")
    monkeypatch.setattr(module, "PYTHON", tmp_path / ".venv" / "bin" / "python")
    monkeypatch.setattr(module, "STAMP", tmp_path / ".venv" / ".xop-stamp")
    return module


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Make a checkout that holds only what setup.sh looks at, with a recorder as setup.py."""
    (tmp_path / "scripts").mkdir()
    shutil.copy(ROOT / "scripts" / "setup.sh", tmp_path / "scripts")
    (tmp_path / "scripts" / "setup.py").write_text("import sys\nprint(*sys.argv[1:])\n")
    (tmp_path / "pyproject.toml").write_text("[project]\n")
    (tmp_path / "requirements.lock").write_text("six==1.17.0\n")
    return tmp_path


def write_python(path: Path, version: str, *, can_make: bool = True) -> Path:
    """Write a program that answers setup.sh's questions like a Python of `version`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        "#!/bin/sh\n"
        'case "$*" in\n'
        f'  *version_info*) echo "{version}" ;;\n'
        f"  *ensurepip*) exit {0 if can_make else 1} ;;\n"
        '  *) echo "ran $0 $*" ;;\n'
        "esac\n"
    )
    path.chmod(0o755)
    return path


def run_shell(
    checkout: Path, *arguments: str, path: str = "/nowhere", **extra: str
) -> subprocess.CompletedProcess[str]:
    """Run setup.sh with nothing in its environment but tools, `path` and `extra`."""
    tools = checkout / "tools"
    if not tools.exists():
        tools.mkdir()
        for name in ("cat", "cut", "sha256sum", "ls", "dirname", "sh", "mktemp", "rm"):
            found = shutil.which(name)
            assert found is not None
            (tools / name).symlink_to(found)
    environment = {"PATH": f"{path}:{tools}", "HOME": str(checkout / "home"), "XOP_NO_SYSTEM": "1"}
    return subprocess.run(
        ["/bin/sh", checkout / "scripts" / "setup.sh", *arguments],
        env={**environment, **extra},
        capture_output=True,
        text=True,
        check=False,
    )


def has_system_python() -> bool:
    """Whether a folder that setup.sh always looks at holds a Python that fits."""
    folders = ("/usr/bin", "/usr/local/bin", "/opt/homebrew/bin")
    minors = ("3.12", "3.13")
    return (
        any(Path(f"{folder}/python{minor}").exists() for folder in folders for minor in minors)
        or any(Path(f"/opt/python{minor}").exists() for minor in minors)
        or Path("/opt/conda").exists()
        or Path("/opt/pyenv").exists()
    )


needs_bare_system = pytest.mark.skipif(
    has_system_python(), reason="this system has a Python 3.12 or 3.13 of its own"
)


def test_a_shim_that_does_not_run_is_passed_over(checkout: Path) -> None:
    shim = checkout / "shims" / "python3.12"
    shim.parent.mkdir()
    shim.write_text("#!/bin/sh\necho 'pyenv: python3.12: command not found' >&2\nexit 127\n")
    shim.chmod(0o755)
    real = write_python(checkout / "pyenv" / "versions" / "3.12.7" / "bin" / "python3", "3.12.7")
    found = run_shell(
        checkout, "--print-python", path=str(shim.parent), PYENV_ROOT=str(checkout / "pyenv")
    )
    assert found.stdout.strip() == str(real)


@pytest.mark.parametrize(
    "place",
    [
        "home/.pyenv/versions/3.13.2/bin/python3",
        "home/.local/share/uv/python/cpython-3.13.2-linux-x86_64-gnu/bin/python3",
        "home/miniforge3/envs/robots/bin/python3",
    ],
)
@needs_bare_system
def test_an_interpreter_off_the_path_is_found(checkout: Path, place: str) -> None:
    real = write_python(checkout / place, "3.13.2")
    assert run_shell(checkout, "--print-python").stdout.strip() == str(real)


@needs_bare_system
def test_the_tested_version_goes_first(checkout: Path) -> None:
    write_python(checkout / "bin" / "python3.13", "3.13.1")
    older = write_python(checkout / "home/.pyenv/versions/3.12.9/bin/python3", "3.12.9")
    found = run_shell(checkout, "--print-python", path=str(checkout / "bin"))
    assert found.stdout.strip() == str(older)


def test_a_python_on_a_path_with_a_space_is_found(checkout: Path) -> None:
    real = write_python(checkout / "my tools" / "python3.12", "3.12.4")
    found = run_shell(checkout, "--print-python", path=str(real.parent))
    assert found.stdout.strip() == str(real)


@needs_bare_system
def test_no_python_that_fits_is_told_with_what_there_is(checkout: Path) -> None:
    old = write_python(checkout / "bin" / "python3", "3.11.2")
    new = write_python(checkout / "bin" / "python", "3.14.0")
    failed = run_shell(checkout, path=str(checkout / "bin"))
    assert failed.returncode == 1
    assert (
        "xop-lerobot needs Python 3.12 or 3.13, and none was found or could be downloaded."
        in failed.stderr
    )
    assert f"  {old}: 3.11.2\n  {new}: 3.14.0\n" in failed.stderr
    assert "  uv python install 3.12 " in failed.stderr
    assert "  pyenv install 3.12\n" in failed.stderr


@needs_bare_system
@pytest.mark.parametrize("at_hand", [True, False], ids=["uv at hand", "uv by another Python's pip"])
def test_where_none_fits_uv_brings_one(checkout: Path, at_hand: bool) -> None:
    brought = write_python(checkout / "brought" / "python3.12", "3.12.9")
    uv = checkout / ("bin" if at_hand else "index") / "uv"
    old = write_python(checkout / "bin" / "python3", "3.10.12")
    uv.parent.mkdir(exist_ok=True)
    uv.write_text(f'#!/bin/sh\ncase "$*" in "python find "*) echo "{brought}" ;; esac\n')
    uv.chmod(0o755)
    old.write_text(
        f'{old.read_text()}[ "$1 $2" = "-m venv" ] && /bin/mkdir "$3/bin" &&\n'
        f'  echo "/bin/cp {uv} $3/bin" > "$3/bin/python" && /bin/chmod +x "$3/bin/python"\n'
    )
    found = run_shell(checkout, "--print-python", path=str(old.parent))
    assert found.stdout == f"{brought}\n", found.stderr


@needs_bare_system
def test_a_python_without_venv_is_the_last_choice(checkout: Path) -> None:
    bare = write_python(checkout / "bin" / "python3.12", "3.12.3", can_make=False)
    search = ("--print-python",)
    assert run_shell(checkout, *search, path=str(bare.parent)).stdout == f"{bare}\n"
    whole = write_python(checkout / "home/miniforge3/bin/python3", "3.13.2")
    assert run_shell(checkout, *search, path=str(bare.parent)).stdout == f"{whole}\n"


def test_a_python_without_venv_names_the_package(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(setup, "find_manager", lambda: "apt-get")
    monkeypatch.setattr(setup, "find_spec", lambda name: None)
    missing = setup.list_missing()
    assert missing[0] == "Python's venv"
    package = f"python3.{sys.version_info.minor}-venv"
    command = f"sudo apt-get install -y --no-install-recommends {package}"
    assert command in setup.describe_missing(missing)


def test_a_chosen_python_that_does_not_fit_is_an_error(checkout: Path) -> None:
    old = write_python(checkout / "python", "3.10.1")
    failed = run_shell(checkout, XOP_PYTHON=str(old))
    assert failed.returncode == 1
    assert failed.stderr == f"XOP_PYTHON={old} is 3.10.1; expected Python 3.12 or 3.13.\n"
    absent = run_shell(checkout, XOP_PYTHON="/nowhere/python")
    assert "is not a Python that runs; expected Python 3.12 or 3.13." in absent.stderr


def test_a_second_run_starts_at_once_and_a_change_does_not(checkout: Path) -> None:
    python = write_python(checkout / "bin" / "python3.12", "3.12.5")
    write_python(checkout / ".venv" / "bin" / "python", "3.12.5")
    first = run_shell(checkout, XOP_PYTHON=str(python))
    stamp = re.search(r"--stamp (\w{64})$", first.stdout.strip())
    assert stamp is not None, first
    (checkout / ".venv" / ".xop-stamp").write_text(f"{stamp[1]}\n")
    again = run_shell(checkout)
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")
    # Same Python chosen by name: nothing to do. Another one: the environment is made anew.
    assert run_shell(checkout, XOP_PYTHON=str(python)).stdout == ""
    other = write_python(checkout / "bin" / "python3.13", "3.13.0")
    assert "--stamp" in run_shell(checkout, XOP_PYTHON=str(other)).stdout
    for name in ("pyproject.toml", "requirements.lock", "scripts/setup.py"):
        before = (checkout / name).read_text()
        (checkout / name).write_text(before + "\n# changed\n")
        assert "--stamp" in run_shell(checkout, XOP_PYTHON=str(python)).stdout, name
        (checkout / name).write_text(before)
    (checkout / ".venv" / "bin" / "python").unlink()
    assert "--stamp" in run_shell(checkout, XOP_PYTHON=str(python)).stdout


def test_an_interrupted_set_up_leaves_no_stamp(setup: ModuleType) -> None:
    setup.VENV.mkdir()
    setup.STAMP.write_text("old\n")

    def fail() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        setup.set_up("new", fail)
    assert not setup.STAMP.exists()
    assert setup.set_up("new", lambda: None)
    assert setup.STAMP.read_text() == "new\n"


def test_two_set_ups_at_once_install_once(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    setup.VENV.mkdir()
    monkeypatch.setattr(setup, "is_venv_usable", lambda: True)
    begun, installs = threading.Event(), []

    def install() -> None:
        installs.append("install")
        begun.set()
        time.sleep(0.2)

    other = threading.Thread(target=setup.set_up, args=("stamp", install))
    other.start()
    assert begun.wait(10)
    assert not setup.set_up("stamp", install)
    other.join()
    assert installs == ["install"]


def test_a_broken_environment_is_not_usable(setup: ModuleType) -> None:
    assert not setup.is_venv_usable()
    write_python(setup.PYTHON, "3.6.1")
    assert not setup.is_venv_usable()


def test_too_little_room_is_told_before_anything_is_made(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(setup, "NEEDED_GB", 1e9)
    with pytest.raises(setup.SetupError, match=r"GB free; the set-up needs 1000000000 GB\."):
        setup.make_venv()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("manager", ["apt-get", "dnf", "pacman", "zypper"])
def test_what_may_not_be_installed_is_told_as_a_command(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch, manager: str
) -> None:
    monkeypatch.setenv("XOP_NO_SYSTEM", "1")
    monkeypatch.setattr(setup, "find_manager", lambda: manager)
    monkeypatch.setattr(setup, "list_missing", lambda: [setup.RENDERING])
    with pytest.raises(setup.SetupError) as raised:
        setup.install_all()
    message = str(raised.value)
    assert message.startswith("software rendering (Mesa's EGL) is missing. Run:\n  sudo ")
    assert f"sudo {manager} " in message
    assert message.endswith(setup.PACKAGES[setup.RENDERING][manager])


def test_a_failing_package_manager_shows_its_words(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(setup, "find_manager", lambda: "dnf")
    monkeypatch.setattr(setup, "find_root_prefix", lambda: ("sh", "-c", "echo no mirror >&2"))
    assert setup.install_missing(lambda: [setup.COMPILER]) == [setup.COMPILER]
    assert "no mirror" in capfd.readouterr().err


def test_a_failing_pip_shows_its_output(setup: ModuleType, capfd: pytest.CaptureFixture) -> None:
    name = "no_such_distribution_xop"
    with pytest.raises(setup.SetupError, match=f"failed:\n.* install --no-index {name}\n"):
        setup.run(sys.executable, "-m", "pip", "install", "--no-index", name)
    assert f"No matching distribution found for {name}" in capfd.readouterr().err


# -- what the tests of pages need -----------------------------------------------------------


PROGRAMS = {"chromium": "chromium", "libnss3-tools": "certutil", "npm": "npm"}


@pytest.fixture
def apt(setup: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A system whose apt-get writes down what it is asked for, and where nothing is installed.

    What it can install stands in `shelf`, a line a package; with no such file it fails.
    """
    folder = tmp_path / "bin"
    folder.mkdir()
    places = "".join(
        f'    *" {package}") : > "{folder}/{program}"; /bin/chmod +x "{folder}/{program}" ;;\n'
        for package, program in PROGRAMS.items()
    )
    script = folder / "apt-get"
    script.write_text(
        "#!/bin/sh\n"
        f'echo "$*" >> "{tmp_path}/asked"\n'
        f'[ -f "{tmp_path}/shelf" ] || {{ echo "no mirror answers" >&2; exit 100; }}\n'
        'case "$*" in update) exit 0 ;; esac\n'
        'for package in "$@"; do :; done\n'
        f'while read -r line; do [ "$line" = "$package" ] && found=1; done < "{tmp_path}/shelf"\n'
        '[ -n "$found" ] || { echo "E: Unable to locate package $package"; exit 100; }\n'
        f'case " $*" in\n{places}esac\n'
    )
    script.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setenv("PLAYWRIGHT_BROWSERS_PATH", str(tmp_path / "playwright"))
    monkeypatch.delenv("CHROMIUM", raising=False)
    monkeypatch.delenv("XOP_NO_SYSTEM", raising=False)
    monkeypatch.setattr(setup.os, "geteuid", lambda: 0)
    return tmp_path


def get_asked(system: Path) -> list[str]:
    asked = system / "asked"
    return asked.read_text().splitlines() if asked.exists() else []


def run_setup(setup: ModuleType, monkeypatch: pytest.MonkeyPatch, *flags: str) -> int:
    monkeypatch.setattr(sys, "argv", ["setup.py", *flags])
    return setup.main()


def test_what_the_tests_of_pages_need_is_installed_once(
    setup: ModuleType, apt: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    (apt / "shelf").write_text("chromium\nlibnss3-tools\nnpm\n")
    assert setup.list_missing_test_tools() == ["Chromium", "certutil", "npm"]
    assert run_setup(setup, monkeypatch, "--test-tools") == 0
    install = "install -y --no-install-recommends"
    packages = ("chromium", "libnss3-tools", "npm")
    assert get_asked(apt) == ["update", *(f"{install} {name}" for name in packages)]
    told = capsys.readouterr().out
    assert told == ("Installing chromium libnss3-tools npm (XOP_NO_SYSTEM=1 forbids it)\n")
    # The next time there is nothing to do, and nothing is asked or said.
    assert run_setup(setup, monkeypatch, "--test-tools") == 0
    assert len(get_asked(apt)) == 4
    assert capsys.readouterr().out == ""


def test_a_system_without_chromium_still_gets_the_rest(
    setup: ModuleType, apt: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """As Ubuntu, whose apt has no Chromium."""
    (apt / "shelf").write_text("libnss3-tools\nnpm\n")
    assert run_setup(setup, monkeypatch, "--test-tools") == 0
    assert setup.list_missing_test_tools() == ["Chromium"]
    assert capsys.readouterr().out.splitlines()[1:] == [
        "Chromium is missing: tests of pages will skip. Run:",
        "  sudo apt-get install -y --no-install-recommends chromium",
        "or, for Chromium:",
        f"  {setup.PYTHON} -m playwright install --with-deps chromium",
    ]
    (apt / "playwright" / "chromium-1").mkdir(parents=True)
    (apt / "playwright" / "chromium-1" / "INSTALLATION_COMPLETE").touch()
    assert setup.list_missing_test_tools() == []


def test_without_a_mirror_the_tests_run_all_the_same(
    setup: ModuleType, apt: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    assert run_setup(setup, monkeypatch, "--test-tools") == 0
    told, errors = capfd.readouterr()
    assert "Chromium, certutil and npm are missing: tests of pages will skip. Run:\n" in told
    assert (
        "\n  sudo apt-get install -y --no-install-recommends chromium libnss3-tools npm\n" in told
    )
    assert "no mirror answers" in errors


@pytest.mark.parametrize("manager", ["apt-get", "dnf", "pacman", "zypper", None])
def test_tools_that_may_not_be_installed_are_told_as_a_command(
    setup: ModuleType,
    apt: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    manager: str | None,
) -> None:
    monkeypatch.setenv("XOP_NO_SYSTEM", "1")
    monkeypatch.setattr(setup, "find_manager", lambda: manager)
    assert run_setup(setup, monkeypatch, "--test-tools") == 0
    assert get_asked(apt) == []
    told = capsys.readouterr().out
    assert told.startswith("Chromium, certutil and npm are missing: tests of pages will skip. ")
    if manager is None:
        assert "Install with the system's package manager\n" in told
    else:
        names = " ".join(setup.PACKAGES[tool][manager] for tool in ("Chromium", "certutil", "npm"))
        assert f"  sudo {manager} " in told and f" {names}\n" in told


def test_the_tests_and_the_set_up_look_for_the_same_browsers(setup: ModuleType) -> None:
    from browser import NAMES

    assert setup.BROWSERS == NAMES
    for name, packages in setup.PACKAGES.items():
        managers = ["apt-get"] if name == setup.VENV_MODULE else list(setup.INSTALL_COMMANDS)
        assert list(packages) == managers, name


def test_make_test_brings_the_tools_before_it_tests() -> None:
    shown = subprocess.run(
        ["make", "-n", "-C", ROOT, "--no-print-directory", "test"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    places = [
        next(i for i, line in enumerate(shown) if part in line)
        for part in ("scripts/setup.sh", "scripts/setup.py --test-tools", "-m pytest -q")
    ]
    assert places == sorted(places)


def read_parallel() -> list[str]:
    """How `make test` spreads the tests."""
    (flags,) = re.findall(r"^PARALLEL := (.*)$", (ROOT / "Makefile").read_text(), re.M)
    return flags.split()


@pytest.mark.slow
@pytest.mark.parametrize("flags", [read_parallel(), [], ["-p", "no:xdist"]], ids=" ".join)
def test_what_is_skipped_is_told_at_the_end_with_its_reason(
    tmp_path: Path, flags: list[str]
) -> None:
    (tmp_path / "test_it.py").write_text(
        "import pytest\ndef test_page():\n    pytest.skip('needs Chromium: get it')\n"
    )
    command = [sys.executable, "-m", "pytest", "-q", *flags, "-c", ROOT / "pyproject.toml"]
    done = subprocess.run(
        [*command, "--rootdir", tmp_path, "-p", "no:cacheprovider", tmp_path / "test_it.py"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    *_, skipped, summary = done.stdout.splitlines()
    assert skipped.startswith("SKIPPED [1] ") and skipped.endswith(": needs Chromium: get it")
    assert summary.startswith("1 skipped in ")


@pytest.mark.parametrize("loads", [True, False])
def test_torchcodec_stays_where_it_loads(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch, loads: bool
) -> None:
    setup.PYTHON.parent.mkdir(parents=True)
    setup.PYTHON.write_text(f"#!/bin/sh\nexit {0 if loads else 1}\n")
    setup.PYTHON.chmod(0o755)
    calls: list[tuple[str, ...]] = []
    monkeypatch.setattr(setup, "run", lambda *arguments: calls.append(arguments[4:]))
    setup.drop_unloadable_torchcodec()
    assert calls == ([] if loads else [("uninstall", "--quiet", "--yes", "torchcodec")])


@pytest.mark.parametrize("has_uv", [True, False])
def test_pip_installs_where_there_is_no_uv(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch, has_uv: bool
) -> None:
    setup.VENV.mkdir()
    calls = []

    def run(*command: object, environment: object = None) -> None:
        calls.append(" ".join(Path(str(word)).name for word in command))
        if calls[-1].endswith("uv.txt") and not has_uv:
            raise setup.SetupError("no such distribution")

    monkeypatch.setattr(setup, "run", run)
    setup.install_project()
    by_uv, by_pip = "uv pip install --python", "--requirement requirements.lock"
    assert (by_uv in calls[1], by_pip in calls[1]) == (has_uv, not has_uv)
    assert re.findall(r"^.*==", (setup.VENV / "uv.txt").read_text(), re.M) == ["uv=="]


def test_uv_is_told_what_pip_is_set_to(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    names = {*setup.UV_SETTINGS.values(), "UV_INDEX_STRATEGY"}
    for name in names:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("UV_HTTP_TIMEOUT", "7")
    settings = f"""\
:env:.index-url='file:///chosen'
:env:.find-links='/nowhere {tmp_path} file:///files'
global.extra-index-url='\\nfile:///a\\nfile:///b'
global.index-url='file:///global'
global.timeout='180'
"""
    environment = setup.make_uv_environment(settings)
    assert {name: environment[name] for name in names if name in environment} == {
        "UV_DEFAULT_INDEX": "file:///chosen",
        "UV_FIND_LINKS": f"{tmp_path},file:///files",
        "UV_INDEX": "file:///a file:///b",
        "UV_INDEX_STRATEGY": "unsafe-best-match",
        "UV_HTTP_TIMEOUT": "7",
    }


def test_pip_sees_nothing_of_another_python(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", "/elsewhere")
    monkeypatch.setenv("PIP_USER", "1")
    environment = setup.make_clean_environment()
    assert "PYTHONPATH" not in environment and "PIP_USER" not in environment
    assert environment["PATH"] == os.environ["PATH"]


def read_lock() -> str:
    return (ROOT / "requirements.lock").read_text()


def test_the_lock_pins_every_dependency_and_no_broken_mujoco() -> None:
    pins = dict(re.findall(r"^([a-z0-9-]+)==([^ ]+)", read_lock(), re.M))
    assert {"mujoco", "lerobot", "mink", "daqp", "torch", "accelerate"} <= set(pins)
    assert {"pytest", "pytest-xdist", "uv"} <= set(pins)
    assert pins["lerobot"] == "0.6.1"
    assert int(pins["mujoco"].split(".")[0]) < 4, "4.0.0 has a wrong sparse Newton Hessian"
    assert not any("xop" in name for name in pins)


def test_the_lock_has_a_hash_of_each_and_no_address() -> None:
    _comment, *entries = re.split(r"^(?=[a-z0-9])", read_lock(), flags=re.M)
    assert len(entries) > 100
    assert not [entry for entry in entries if "==" not in entry or "--hash=sha256:" not in entry]
    assert "://" not in read_lock()


def test_make_help_names_every_verb() -> None:
    told = subprocess.run(
        ["make", "-C", ROOT, "--no-print-directory", "help"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    for verb in ("demo", "test", "format", "type", "check", "clean", "help"):
        assert f"  make {verb} " in told
