"""Whether LeRobot finds us."""

from __future__ import annotations

import json

from xop_lerobot.doctor.child import run_child
from xop_lerobot.doctor.finding import Finding, Level, Setup

WANTED = {"robots": ("xop_g1", "xop_rby1"), "teleoperators": ("xop",)}
_CODE = """
import json
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators.config import TeleoperatorConfig
print(json.dumps({"robots": sorted(RobotConfig.get_known_choices()),
                  "teleoperators": sorted(TeleoperatorConfig.get_known_choices())}))
"""


def check_plugin(setup: Setup) -> Finding:
    """Ask LeRobot for its types, as its commands do, in a Python of its own."""
    del setup
    answer = run_child(_CODE, timeout=300.0)
    if not answer.ok:
        return Finding(
            Level.FAIL,
            f"LeRobot cannot be loaded: {answer.text}",
            "install it anew: pip install -e .",
        )
    known = json.loads(answer.text.splitlines()[-1])
    missing = [name for kind, names in WANTED.items() for name in names if name not in known[kind]]
    if missing:
        return Finding(
            Level.FAIL,
            f"LeRobot does not know {', '.join(missing)}",
            "install this project into the same Python as LeRobot (pip install -e .), and look "
            "for a warning of LeRobot's about a plugin that it could not import",
            {"missing": missing},
        )
    return Finding(Level.OK, "LeRobot knows xop_g1, xop_rby1 and the teleoperator xop")
