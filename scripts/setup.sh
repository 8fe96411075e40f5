#!/bin/sh
# Set up .venv: find a suitable Python and run setup.py with it, unless nothing has changed.
#
#   sh scripts/setup.sh                set up, or return at once if .venv is up to date
#   sh scripts/setup.sh --print-python only print the interpreter that would be used
#
# XOP_PYTHON=/path/to/python selects the interpreter; XOP_NO_SYSTEM=1 forbids installing system
# packages. docs/start/setup.md explains the steps.
set -eu
cd "$(dirname "$0")/.."
home=${HOME:-/root}

# Print a hash of everything that decides what is installed and where. It includes the path,
# because the scripts in a .venv contain absolute paths and break when the checkout is moved.
stamp() {
    { pwd -P; cat pyproject.toml requirements.lock scripts/setup.sh scripts/setup.py; } |
        { sha256sum 2>/dev/null || cksum; } | cut -d ' ' -f 1
}

# Print the version of the interpreter $1, such as 3.12.1, or nothing if it does not run.
version_of() {
    "$1" -I -S -c 'import sys; print("%d.%d.%d" % sys.version_info[:3])' 2>/dev/null || true
}
fits() {
    case "$1" in 3.12.* | 3.13.*) return 0 ;; *) return 1 ;; esac
}
can_make_environments() {
    "$1" -I -c 'import ensurepip, venv, ssl, ctypes' >/dev/null 2>&1
}

# Print candidate interpreters, one per line, 3.12 before 3.13. A pyenv shim may exist for a version
# that it then refuses to run, so the folders of the versions are searched as well.
candidates() {
    for minor in 3.12 3.13; do
        command -v "python$minor" || true
        ls -d "${PYENV_ROOT:-$home/.pyenv}/versions/$minor".*/bin/python3 \
            "/opt/pyenv/versions/$minor".*/bin/python3 \
            "${UV_PYTHON_INSTALL_DIR:-$home/.local/share/uv/python}/cpython-$minor".*/bin/python3 \
            "/usr/bin/python$minor" "/usr/local/bin/python$minor" \
            "/opt/homebrew/bin/python$minor" "/opt/python$minor/bin/python$minor" \
            2>/dev/null || true
    done
    command -v python3 || true
    command -v python || true
    for root in "${CONDA_PREFIX:-/opt/conda}" "$home/miniforge3" "$home/miniconda3" \
        "$home/anaconda3" /opt/conda; do
        ls -d "$root/bin/python3" "$root"/envs/*/bin/python3 2>/dev/null || true
    done
}

# Download Python 3.12 with uv: the installed uv, or one that pip of any other Python installs.
download_python() {
    folder=$(mktemp -d) || return 1
    uv=$(command -v uv || ls "$home/.local/bin/uv" 2>/dev/null || true)
    if [ -z "$uv" ]; then
        uv=$folder/bin/uv
        python3 -m venv "$folder" >&2 && "$folder/bin/python" -m pip install --quiet uv >&2
    fi && echo "Installing Python 3.12 with uv." >&2 && "$uv" python install --no-bin 3.12 >&2 &&
        python=$("$uv" python find --managed-python 3.12)
    status=$?
    rm -rf "$folder"
    return $status
}

no_python() {
    {
        echo "xop-lerobot needs Python 3.12 or 3.13, and none was found or could be downloaded."
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
        if fits "$version"; then
            python=$path
            can_make_environments "$path" && return
            without_venv=${without_venv:-$path}
        fi
        seen="$seen  $path: ${version:-does not run}
"
    done
    # Debian and Ubuntu package `venv` separately: setup.py installs that package, or names it.
    python=$without_venv
    [ -n "$python" ] || download_python || no_python "$seen"
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
