"""Registry of objects by name, which rejects duplicates and lists the choices for unknown names."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pkgutil import resolve_name
from typing import cast

from xop_lerobot.core.errors import DuplicateName, UnknownName


class Registry[T]:
    """Objects of one kind by name.

    Args:
        kind: Kind of the objects in messages (``"robot"``).
        places: Locations of the built-in objects, ``"module:attribute"`` by name. A module is
            imported at the first access to its object, which keeps imports fast and avoids import
            cycles.
    """

    def __init__(self, kind: str, places: Mapping[str, str] | None = None) -> None:
        self.kind = kind
        self._places = dict(places or {})
        self._things: dict[str, T] = {}

    @property
    def built_in(self) -> tuple[str, ...]:
        """Names of the built-in objects, without those that were added."""
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
        """Return a decorator that registers the decorated object under `name`."""

        def decorate(thing: Thing) -> Thing:
            self.add(name, cast(T, thing))  # a type variable can't be bounded by T
            return thing

        return decorate

    def remove(self, name: str) -> None:
        """Remove the object added under `name`, if any; tests remove their toys."""
        self._things.pop(name, None)

    def __getitem__(self, name: str) -> T:
        """Look up `name`.

        Raises:
            UnknownName: If it is not registered; lists all names.
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
