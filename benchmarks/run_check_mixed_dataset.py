"""Run every verb of `xop-curate` on a mixed dataset and check that its source stays unchanged.

    python -m benchmarks.run_make_mixed_dataset --out outputs/mixed
    python -m benchmarks.run_check_mixed_dataset --root outputs/mixed

The SHA-256 over all files of the source is taken before and after each verb. A line per verb gives
its exit code, whether the source is unchanged, and its last line of output. The verbs' results go
to a temporary directory. The exit code is 1 if a verb failed or a source changed.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import shlex
import sys
import tempfile
from pathlib import Path

WHERE = "success and tracking_p95 < 0.2 and not fall"
RUNS: tuple[tuple[str, str], ...] = (
    ("session", "inspect"),
    ("session", "report --out {out}.html"),
    ("session", f'filter --out {{out}} --where "{WHERE}"'),
    ("session", "trim --out {out} --margin 0.3"),
    ("session", "split --out {out} --parts train=0.8 val=0.2"),
    ("session", "merge --root {again} --out {out}"),
    ("session", 'label --out {out} --success "not fall and gaps == 0" --subtask "early=time < 1"'),
    ("session", "retarget --out {out} --robot rby1 --method direct --episodes 0 --workers 1"),
    ("session", "repair --out {out}"),
    ("killed", "repair --out {out}"),
)
"""Source dataset, and the verb with its flags."""


def compute_digest(root: Path) -> str:
    """Compute the SHA-256 over the names and the contents of all files below `root`."""
    whole = hashlib.sha256()
    for path in sorted(root.rglob("*")):
        if path.is_file():
            whole.update(str(path.relative_to(root)).encode())
            whole.update(hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest()


def run_verb(words: list[str]) -> tuple[int, str]:
    """Run a verb; returns its exit code and its last line of output."""
    from xop_lerobot.curate.cli import main as curate

    output, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        try:
            code = curate(words)
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
    lines = (errors if code else output).getvalue().strip().splitlines() or [""]
    written = [line for line in lines if not line.startswith("written to")]
    return code, (written or lines)[-1]


def main() -> int:
    """Run all verbs and print a table; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--root", type=Path, required=True, help="--out of run_make_mixed_dataset")
    settings = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory(prefix="mixed-") as work:
        for number, (name, line) in enumerate(RUNS):
            root, out = settings.root.resolve() / name, Path(work) / str(number)
            if not root.is_dir():
                print(f"{name:13}{line.split()[0]:10}missing")
                continue
            again = Path(work) / "2"  # the result of filter, RUNS[2]
            verb, *flags = shlex.split(line.format(out=out, again=again))
            before = compute_digest(root)
            code, text = run_verb([verb, "--root", str(root), *flags, "--quiet"])
            same = compute_digest(root) == before
            failed += bool(code) or not same
            source = f"unchanged {before[:12]}" if same else "CHANGED"
            print(f"{name:13}{verb:10}exit {code}  source {source}  {text}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
