"""MuJoCo is compiled and its wheel has no stubs: whatever pyright can't see is of any type."""

from typing import Any

def __getattr__(name: str) -> Any: ...
