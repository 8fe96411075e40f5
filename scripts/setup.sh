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
home=${HOME:-/root}

# Anything that changes what has to be installed, and where: a moved checkout breaks its .venv.
stamp() {
    { pwd -P; cat pyproject.toml requirements.lock scripts/setup.sh scripts/setup.py; } |
        { sha256sum 2>/dev/null || cksum; } | cut -d ' ' -f 1
}

# Print "3.12.1" when $1 runs.
version_of() {
    "$1" -I -S -c 'import sys; print("%d.%d.%d" % sys.version_info[:3])' 2>/dev/null || true
}
fits() {
    case "$1" in 3.12.* | 3.13.*) return 0 ;; *) return 1 ;; esac
}
can_make_environments() {
    "$1" -I -c 'import ensurepip, venv, ssl, ctypes' >/dev/null 2>&1
}

# Every interpreter worth a look, the tested 3.12 before 3.13, one a line. A pyenv shim exists
# for versions that it then refuses to run, so the versions' own folders are looked at as well.
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

# Let uv download a Python: the uv on the path, or one that an older or newer Python's pip brings.
download_python() {
    folder=$(mktemp -d) || return 1
    uv=$(command -v uv || ls "$home/.local/bin/uv" 2>/dev/null || true)
    if [ -z "$uv" ]; then
        uv=$folder/bin/uv
        python3 -m venv "$folder" >&2 && "$folder/bin/python" -m pip install --quiet uv >&2
    fi && echo "Python 3.12 is brought by uv." >&2 && "$uv" python install --no-bin 3.12 >&2 &&
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
    # setup.py brings the package that Debian and Ubuntu keep `venv` in, or names it.
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
