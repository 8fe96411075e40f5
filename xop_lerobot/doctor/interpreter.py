"""Which Python this is, and whether it has the packages that are needed."""

from __future__ import annotations

import importlib.metadata
import platform
import sys

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from xop_lerobot.doctor.finding import Finding, Level, Setup

DISTRIBUTION = "lerobot_teleoperator_xop"


def check_interpreter(setup: Setup) -> Finding:
    """Compare Python and its packages with what the installed distribution asks for."""
    del setup
    here = f"Python {platform.python_version()} in {sys.prefix}"
    try:
        metadata = importlib.metadata.metadata(DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError:
        return Finding(
            Level.FAIL,
            f"{here} does not have {DISTRIBUTION}",
            "install it into this Python: pip install -e . in the project's folder",
        )
    wanted = metadata.get("Requires-Python") or ""
    if not SpecifierSet(wanted).contains(platform.python_version(), prereleases=True):
        return Finding(
            Level.FAIL, f"{here}; {wanted} is needed", "make a new environment with that Python"
        )
    faults = find_faults(importlib.metadata.requires(DISTRIBUTION) or [])
    if faults:
        return Finding(
            Level.FAIL,
            f"{here} lacks packages: {'; '.join(faults)}",
            "install anew: pip install -e . in the project's folder",
            {"faults": faults},
        )
    return Finding(Level.OK, f"{here}, with all packages")


def find_faults(requirements: list[str]) -> list[str]:
    """List the requirements that this Python does not fulfil; extras are left out."""
    faults = []
    for each in requirements:
        requirement = Requirement(each)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            faults.append(f"{requirement.name} is not installed")
            continue
        if not requirement.specifier.contains(version, prereleases=True):
            faults.append(f"{requirement.name} is {version}, and {requirement.specifier} is needed")
    return faults
