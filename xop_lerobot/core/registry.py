"""A name-to-thing table that refuses duplicates and lists the choices when a name is unknown."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pkgutil import resolve_name
from typing import cast

from xop_lerobot.core.errors import DuplicateName, UnknownName


class Registry[T]:
    """Things of one kind by name.

    Args:
        kind: What is registered, as it reads in an error (``"robot"``).
        places: Where the things of this project are, as ``"module:attribute"`` by name. A module
            is imported when its thing is first asked for, so a table costs nothing, and a thing
            can import what has the table.
    """

    def __init__(self, kind: str, places: Mapping[str, str] | None = None) -> None:
        self.kind = kind
        self._places = dict(places or {})
        self._things: dict[str, T] = {}

    @property
    def built_in(self) -> tuple[str, ...]:
        """Names of the things of this project, without those that were added."""
        return tuple(sorted(self._places))

    def add(self, name: str, thing: T) -> T:
        """Register `thing` under `name`.

        Raises:
            DuplicateName: If the name is taken.
        """
        if name in self:
            raise DuplicateName(self.kind, name)
        self._things[name] = thing
        return thing

    def register[Thing](self, name: str) -> Callable[[Thing], Thing]:
        """Return a decorator that registers what it decorates under `name`."""

        def decorate(thing: Thing) -> Thing:
            self.add(name, cast(T, thing))  # that Thing is a T can't be said of a type variable
            return thing

        return decorate

    def remove(self, name: str) -> None:
        """Forget what was added under `name` (tests add toys and take them away again)."""
        self._things.pop(name, None)

    def __getitem__(self, name: str) -> T:
        """Look `name` up.

        Raises:
            UnknownName: Carrying every known name.
        """
        if name not in self:
            raise UnknownName(self.kind, name, self)
        if name not in self._things:
            self._things[name] = resolve_name(self._places[name])
        return self._things[name]

    def __contains__(self, name: object) -> bool:
        return name in self._things or name in self._places

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({*self._places, *self._things}))
