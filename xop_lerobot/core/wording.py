"""Small words for messages."""

from __future__ import annotations


def say_count(count: int, noun: str) -> str:
    """Return a number of things in words: 1 episode, 2 episodes.

    Args:
        count: How many.
        noun: What, in the singular; a regular one.
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
