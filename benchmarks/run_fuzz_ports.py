"""Send garbage to every port that the project opens, and report the effects.

    python -m benchmarks.run_fuzz_ports --bytes 10000000

Everything stays on this machine. Each server under test runs in its own process, so that a crash or
growing memory shows, while a well-behaved operator or client keeps using it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "helpers"))

PORTS = ("webxr", "webxr-tls", "control", "avp")


def main() -> int:
    """Fuzz the ports and print a table; returns 1 if a fault was found."""
    import fuzzing

    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--bytes", type=int, default=10_000_000, help="bytes sent to each port")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ports", nargs="+", choices=PORTS, default=PORTS)
    settings = parser.parse_args()
    runs = {
        "webxr": lambda: fuzzing.fuzz_webxr(settings.bytes, settings.seed),
        "webxr-tls": lambda: fuzzing.fuzz_webxr(settings.bytes, settings.seed, tls=True),
        "control": lambda: fuzzing.fuzz_control(settings.bytes, settings.seed),
        "avp": lambda: fuzzing.fuzz_avp(settings.bytes, settings.seed),
    }
    print(
        "port         | bytes | connections | s | MB at 10 %, 50 %, end of each kind | objects | "
        "good: sent, taken | longest gap, without garbage [s]"
    )
    failed = False
    for name in settings.ports:
        r = runs[name]()
        memory = "; ".join(", ".join(f"{each:.1f}" for each in kind) for kind in r.memory)
        print(
            f"{r.port:12} | {r.sent} | {r.connections} | {r.seconds:.0f} | {memory} | "
            f"{r.objects[0]}, {r.objects[1]} | "
            f"{r.good[0]}, {r.good[1]} | {r.longest_gap[0]:.2f}, {r.longest_gap[1]:.2f}",
            flush=True,
        )
        for fault in r.find_faults():
            failed = True
            print(f"  FAULT {fault}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
