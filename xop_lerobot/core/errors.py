"""Errors of the library. Messages name the thing, what was expected, what came, and the choices."""

from __future__ import annotations

from collections.abc import Iterable


class XopError(Exception):
    """Root of all errors that this project raises on purpose."""


class UnknownName(XopError, KeyError):
    """A name is not one of the known ones; the message lists them.

    Args:
        kind: Kind of the name, for example ``"robot"``.
        name: The unknown name.
        known: All valid names.
    """

    def __init__(self, kind: str, name: object, known: Iterable[str]) -> None:
        self.kind, self.name, self.known = kind, name, sorted(known)
        super().__init__(f"unknown {kind} {name!r}. Known: {', '.join(self.known) or '(none)'}")

    def __str__(self) -> str:  # KeyError would print the repr of the message
        return self.args[0]


class DuplicateName(XopError):
    """A name is registered twice."""

    def __init__(self, kind: str, name: str) -> None:
        super().__init__(f"{kind} {name!r} is registered already")


class BadShape(XopError, ValueError):
    """An array does not have the expected shape."""

    def __init__(self, name: str, expected: object, actual: object) -> None:
        super().__init__(f"{name} must have shape {expected}, got {actual}")


class BadValue(XopError):
    """A value is out of range or of the wrong type.

    Deliberately not a ValueError: LeRobot's command line parser hides the text of those.
    """


class BadRecording(XopError, ValueError):
    """An operator recording is missing or malformed; the message names the file and the fault."""

    def __init__(self, path: object, fault: str) -> None:
        super().__init__(f"operator recording '{path}': {fault}")


class BadDataset(XopError, ValueError):
    """A dataset is missing or malformed; the message names its directory and the fault."""

    def __init__(self, root: object, fault: str) -> None:
        self.root, self.fault = root, fault
        super().__init__(f"dataset '{root}': {fault}")


class NotConnected(XopError):
    """A device or robot is used before `connect()`."""

    def __init__(self, name: str) -> None:
        super().__init__(f"{name} is not connected. Call connect() first.")


class LinkError(XopError):
    """Robot and teleoperator could not be connected to one session."""


class PolicyFileError(XopError):
    """A low-level policy's file is missing, has the wrong checksum or the wrong shape."""
