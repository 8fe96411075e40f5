#!/bin/sh
# Make .venv ready: find a Python that fits, then hand over to setup.py, unless nothing changed.
#
#   sh scripts/setup.sh                set up, or start at once when it is done already
#   sh scripts/setup.sh --print-python only print the interpreter that would be used
#
# XOP_PYTHON=/path/to/python chooses the interpreter; XOP_NO_SYSTEM=1 forbids system packages.
# docs/start/setup.md says what is done and why.
set -eu
cd "$(dirname "$0")/.."

# Anything that changes what has to be installed, and where: a moved checkout breaks its .venv.
stamp() {
    { pwd -P; cat pyproject.toml requirements.lock scripts/setup.sh scripts/setup.py; } |
        { sha256sum 2>/dev/null || cksum; } | cut -d ' ' -f 1
}

# Print "3.12.1" when $1 runs and is a version that the locked packages are built for.
version_of() {
    "$1" -I -S -c 'import sys; print("%d.%d.%d" % sys.version_info[:3])' 2>/dev/null || true
}
fits() {
    case "$1" in 3.12.* | 3.13.*) return 0 ;; *) return 1 ;; esac
}

# Every interpreter worth a look, the tested 3.12 before 3.13, one a line. A pyenv shim exists
# for versions that it then refuses to run, so the versions' own folders are looked at as well.
candidates() {
    home=${HOME:-/root}
    for minor in 3.12 3.13; do
        command -v "python$minor" || true
        for root in "${PYENV_ROOT:-$home/.pyenv}" "$home/.pyenv" /opt/pyenv; do
            ls -d "$root/versions/$minor".*/bin/python3 2>/dev/null || true
        done
        ls -d "${UV_PYTHON_INSTALL_DIR:-$home/.local/share/uv/python}/cpython-$minor".*/bin/python3 \
            2>/dev/null || true
        for folder in /usr/bin /usr/local/bin /opt/homebrew/bin "/opt/python$minor/bin"; do
            ls -d "$folder/python$minor" 2>/dev/null || true
        done
        for uv in uv "$home/.local/bin/uv" "$home/.cargo/bin/uv"; do
            if command -v "$uv" >/dev/null 2>&1; then
                "$uv" python find --no-python-downloads "$minor" 2>/dev/null || true
            fi
        done
    done
    command -v python3 || true
    command -v python || true
    for root in "${CONDA_PREFIX:-}" "$home/miniforge3" "$home/miniconda3" "$home/anaconda3" /opt/conda; do
        if [ -n "$root" ]; then
            ls -d "$root/bin/python3" "$root"/envs/*/bin/python3 2>/dev/null || true
        fi
    done
}

can_make_environments() {
    "$1" -I -c 'import ensurepip, venv, ssl, ctypes' >/dev/null 2>&1
}

# Debian and Ubuntu keep `venv` in a package of its own; install it for $1 where that may be.
install_venv_module() {
    package=python$(version_of "$1" | cut -d . -f 1,2)-venv
    [ "${XOP_NO_SYSTEM:-0}" != 1 ] && command -v apt-get >/dev/null || return 1
    sudo=
    if [ "$(id -u)" != 0 ]; then
        sudo -n true 2>/dev/null || return 1
        sudo="sudo -n"
    fi
    echo "Installing the system package $package (XOP_NO_SYSTEM=1 forbids it)." >&2
    { $sudo apt-get update && $sudo apt-get install -y --no-install-recommends "$package"; } \
        >/dev/null 2>&1
    can_make_environments "$1"
}

no_python() {
    {
        echo "xop-lerobot needs Python 3.12 or 3.13, and none was found."
        echo "Looked at:"
        printf '%s' "${1:-  (no Python at all)
}"
        echo "Get one in any of these ways, then run the same command again:"
        echo "  uv python install 3.12                                    (uv: pip install uv)"
        echo "  pyenv install 3.12"
        echo "  sudo apt-get install python3.12 python3.12-venv           (Ubuntu 24.04)"
        echo "  sudo apt-get install python3 python3-venv                 (Debian 13)"
        echo "  sudo dnf install python3.12                               (Fedora)"
        echo "or name one: XOP_PYTHON=/path/to/python3.12 make demo"
    } >&2
    exit 1
}

# Set `python` to the interpreter to build .venv with.
find_python() {
    if [ -n "${XOP_PYTHON:-}" ]; then
        version=$(version_of "$XOP_PYTHON")
        if ! fits "$version"; then
            echo "XOP_PYTHON=$XOP_PYTHON is ${version:-not a Python that runs};" \
                "expected Python 3.12 or 3.13." >&2
            exit 1
        fi
        python=$XOP_PYTHON
        return
    fi
    seen=
    without_venv=
    list=$(candidates)
    IFS='
'
    for path in $list; do
        unset IFS
        case "$seen" in *"  $path: "*) continue ;; esac
        version=$(version_of "$path")
        if ! fits "$version"; then
            seen="$seen  $path: ${version:-does not run}
"
        elif ! can_make_environments "$path"; then
            seen="$seen  $path: $version, but it cannot make environments
"
            without_venv=${without_venv:-$path}
        else
            python=$path
            return
        fi
    done
    if [ -n "$without_venv" ] && install_venv_module "$without_venv"; then
        python=$without_venv
        return
    fi
    if [ -n "$without_venv" ]; then
        without_venv=$(version_of "$without_venv")
        minor=$(echo "$without_venv" | cut -d . -f 1,2)
        seen="$seen  (sudo apt-get install python$minor-venv makes Python $without_venv usable)
"
    fi
    no_python "$seen"
}

if [ "${1:-}" = --print-python ]; then
    find_python
    echo "$python"
    exit
fi

want=$(stamp)
have=$(cat .venv/.xop-stamp 2>/dev/null || true)
if [ "$have" = "$want" ] && current=$(version_of .venv/bin/python) && fits "$current"; then
    if [ -z "${XOP_PYTHON:-}" ] || [ "$(version_of "$XOP_PYTHON")" = "$current" ]; then
        exit 0
    fi
fi
find_python
exec "$python" scripts/setup.py --stamp "$want"
