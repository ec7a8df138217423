"""Names in the settings and what they stand for: a learner, a transfer method, something in a module of the user's."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Generic, TypeVar, cast

from acmr.config import ConfigError
from acmr.text import one_line

_Kind = TypeVar("_Kind")
_Entry = TypeVar("_Entry")


def named_in(key: str, place: str) -> Any:
    """What ``module:name`` stands for; the module is imported.

    Args:
        key: The setting that holds it, for the message.
        place: Such as ``my_methods:values``: in a file of the current folder, or installed.

    Raises:
        ConfigError: If there is nothing there.
    """
    module, _, name = place.partition(":")
    if not all(part.isidentifier() for part in [*module.split("."), name]):
        raise ConfigError(f"{key}={place}: MODULE:NAME is needed, as in {key}=my_methods:values")
    try:
        found = import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{module}.".startswith(f"{error.name}."):
            raise ConfigError(
                f"{key}={place}: there is no module {error.name}; it is looked for in the current folder, "
                "and among what is installed"
            ) from error
        raise ConfigError(f"{key}={place}: {module} cannot be imported ({one_line(error)})") from error
    except Exception as error:
        # The user's own code, whatever it does.
        raise ConfigError(f"{key}={place}: {module} cannot be imported ({one_line(error)})") from error
    if not hasattr(found, name):
        own = [known for known, value in vars(found).items() if getattr(value, "__module__", None) == module]
        hint = f"; there are {', '.join(own)}" if own else ""
        raise ConfigError(f"{key}={place}: {module} has no {name}{hint}")
    return getattr(found, name)


class Registry(Generic[_Kind]):
    """What is registered by name; for a name that is not, the module of that name is imported, if there is one.

    So a learner or a method of one's own is a file of its own, and no file of the project needs to be edited.

    Args:
        key: The setting that holds the name, for the message.
        package: Where modules are looked for.
    """

    def __init__(self, key: str, package: str) -> None:
        self._key, self._package = key, package
        self._entries: dict[str, _Kind] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """What has been registered so far."""
        return tuple(self._entries)

    def add(self, name: str) -> Callable[[_Entry], _Entry]:
        """A decorator that registers a function or a class."""

        def register(entry: _Entry) -> _Entry:
            self._entries[name] = cast(Any, entry)
            return entry

        return register

    def find(self, name: str) -> _Kind:
        """What a name stands for.

        Raises:
            ConfigError: If nothing of that name is registered.
        """
        module = f"{self._package}.{name}"
        # Names come from the command line; only a plain one can be that of a module in the package.
        if name not in self._entries and name.isidentifier() and find_spec(module) is not None:
            import_module(module)
        if name not in self._entries:
            known = ", ".join(self._entries)
            raise ConfigError(f"{self._key}={name}: must be one of {known}, or registered in a module {module}")
        return self._entries[name]
