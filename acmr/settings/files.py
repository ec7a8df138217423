"""Settings files as people write them: what is wrong with one is one line, with the file and the place in it."""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import Any

import yaml
from hydra._internal.core_plugins import file_config_source, importlib_resources_config_source
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigLoadError, ConfigResult, ConfigSource
from omegaconf import DictConfig, ListConfig
from omegaconf.errors import OmegaConfBaseException

from acmr.config import ConfigError
from acmr.text import message, one_line

#: What Hydra calls places that belong to it.
THEIRS = ("hydra", "schema")
_PLUGINS = "hydra_plugins."


def read_files_with_care() -> None:
    """Lets Hydra refuse a settings file that it cannot read as we do, in place of a traceback."""
    # Hydra makes its own entries first, and tells sources apart by what their addresses begin with.
    load_plugins()
    SourcesRegistry.instance().types |= {"file": FileConfigSource, "pkg": ImportlibResourcesConfigSource}


def load_plugins() -> None:
    """Lets Hydra load what is installed of its plugins; one that cannot be loaded would end every command.

    Raises:
        ConfigError: If there is such a one.
    """
    try:
        Plugins.instance()
    except Exception as error:
        within = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
        name = next((module for module in reversed(within) if module.startswith(_PLUGINS)), "")
        if not name:
            raise
        package = name.removeprefix(_PLUGINS).partition(".")[0]
        raise ConfigError(
            f"Hydra's plugin {package} cannot be loaded ({one_line(error)}); install another version of it, "
            f"or type pip uninstall {package.replace('_', '-')}"
        ) from error


def shown(source: ConfigSource, name: str) -> str:
    """A settings file as it is called to the user: ``conf/env/ant.yaml``; those of another folder in full."""
    folder = source.path.replace(".", "/") if source.scheme() == "pkg" else source.path
    return f"{Path(folder).name if source.provider == 'main' else folder}/{name.removesuffix('.yaml')}.yaml"


class FileConfigSource(file_config_source.FileConfigSource):
    """A folder of settings files, named as Hydra's own: Hydra refuses other names when it starts plugins again."""

    def load_config(self, config_path: str) -> ConfigResult:
        """Reads one of them.

        Raises:
            ConfigError: If it is no settings file.
        """
        return _careful(self, config_path, super().load_config)


class ImportlibResourcesConfigSource(importlib_resources_config_source.ImportlibResourcesConfigSource):
    """A package with settings files; the same holds for its name."""

    def load_config(self, config_path: str) -> ConfigResult:
        """Reads one of them.

        Raises:
            ConfigError: If it is no settings file.
        """
        return _careful(self, config_path, super().load_config)


def _careful(source: ConfigSource, name: str, load: Callable[[str], ConfigResult]) -> ConfigResult:
    try:
        result = load(name)
    except ConfigLoadError:
        # Of a name that is not there: Hydra goes on to look elsewhere.
        raise
    except _WRONG as error:
        raise ConfigError(f"{shown(source, name)}: {_wrong(_file(source, name), error)}") from error
    return _checked(source, name, result)


def _file(source: ConfigSource, name: str) -> Path | None:
    return Path(source.path) / f"{name.removesuffix('.yaml')}.yaml" if source.scheme() == "file" else None


#: What reading a file raises; OmegaConf raises an OSError for a file that holds one number.
_WRONG = (OSError, ValueError, yaml.YAMLError, RecursionError, OmegaConfBaseException)


def _wrong(file: Path | None, error: Exception) -> str:
    if isinstance(error, UnicodeDecodeError):
        return f"not written in UTF-8{_first_foreign(file)}; save it as UTF-8"
    if isinstance(error, RecursionError):
        return "not readable as YAML: a part of it holds itself, or it is nested too deeply"
    if isinstance(error, OmegaConfBaseException):
        key = str(error.full_key or "")
        return f"{key}: {message(error).partition(' full_key')[0]}{place_of_key(file, key)}"
    if isinstance(error, yaml.YAMLError):
        return f"not readable as YAML: {_explained(error)}"
    if isinstance(error, OSError) and error.strerror:
        return f"cannot be read ({error.strerror})"
    if isinstance(error, ValueError):
        # Of a number with too many digits, or a day that is in no calendar.
        return f"not readable as YAML: {message(error)}"
    return "holds no settings; write key: value"


def _explained(error: yaml.YAMLError) -> str:
    if not isinstance(error, yaml.MarkedYAMLError) or error.problem_mark is None:
        return message(error)
    problem = " ".join(filter(None, (error.context, error.problem)))
    if "'\\t'" in problem:
        problem = "a tab; indent with spaces"
    elif match := re.search(r"found duplicate key (.*)", problem):
        problem = f"{match[1]} is there twice; keep one of them"
    elif "python/" in problem:
        problem = "Python objects are not allowed; write plain text"
    return f"{problem}{position(error.problem_mark)}"


def position(mark: Any) -> str:
    """A place in a file, for the end of a line."""
    return f" (line {mark.line + 1}, column {mark.column + 1})"


def _first_foreign(file: Path | None) -> str:
    if file is None:
        return ""
    raw = file.read_bytes()
    try:
        raw.decode()
    except UnicodeDecodeError as error:
        lines = raw[: error.start].split(b"\n")
        return f" (line {len(lines)}, column {len(lines[-1]) + 1})"
    return ""


def _checked(source: ConfigSource, name: str, result: ConfigResult) -> ConfigResult:
    if source.provider in THEIRS:
        return result
    file = _file(source, name)
    config, place, own = result.config, shown(source, name), name.removesuffix(".yaml").rpartition("/")[2]
    if isinstance(config, DictConfig) and not config:
        raise ConfigError(f"{place}: is empty; write its settings, as in name: {own}, or remove the file")
    defaults = config._get_node("defaults") if isinstance(config, DictConfig) else None
    if defaults is None:
        return result
    if not isinstance(defaults, ListConfig):
        raise ConfigError(f"{place}: defaults: must be a list, as in defaults: [NAME]{place_of_key(file, 'defaults')}")
    for entry in defaults._iter_ex(resolve=False):
        if not isinstance(entry, str) and not (isinstance(entry, DictConfig) and len(entry) == 1):
            where = place_of_key(file, "defaults")
            raise ConfigError(f"{place}: defaults: {entry}: must be a name, or GROUP: NAME, one in each entry{where}")
        if entry in (own, f"/{name}"):
            raise ConfigError(
                f"{place}: defaults: {entry}: the file builds on itself; name another one{place_of_text(file, own)}"
            )
    return result


def circle_of(error: RecursionError) -> list[str]:
    """The files that Hydra was following when it gave up, as ``env/ant``; none if something else had no end.

    Each builds on the next one, and the last on the first.
    """
    # Private, read in hydra-core 1.3.8: its function for one file calls itself for those that the file builds on.
    frames = (frame for frame, _ in traceback.walk_tb(error.__traceback__))
    paths = (frame.f_locals.get("path") for frame in frames if frame.f_code.co_name == "_create_defaults_tree_impl")
    names = [str(path) for path in paths if path is not None]
    for end, name in enumerate(names):
        if (start := names.index(name)) < end:
            return names[start:end]
    return []


def wrong_kind(file: Path | None, schema: Any, key: str) -> str | None:
    """What part of a file is a value where a list or a mapping is needed, or one of these in the place of the other.

    Args:
        file: The file, if it is one.
        schema: The settings as nested dictionaries, lists and values.
        key: Where in the settings the file belongs; empty: it holds all of them.
    """
    part = reduce(lambda inner, name: inner.get(name, {}), filter(None, key.split(".")), schema)
    return _wrong_kind(_nodes(file), part, key)


_KINDS: dict[type, tuple[type[yaml.Node], str]] = {
    dict: (yaml.MappingNode, "holds settings: write each on a line of its own below it, as key: value"),
    list: (yaml.SequenceNode, "must be a list, as in [a, b]"),
}


def _wrong_kind(node: yaml.Node | None, part: Any, key: str) -> str | None:
    kind, needed = _KINDS.get(type(part), (yaml.Node, ""))
    if node is None or getattr(node, "tag", "").endswith(":null"):
        return None
    if not isinstance(node, kind):
        return f"{f'{key}: ' if key else ''}{needed}{position(node.start_mark)}"
    if not isinstance(node, yaml.MappingNode) or not isinstance(part, dict):
        return None
    entries = ((name.value, value) for name, value in node.value if name.value in part)
    found = (_wrong_kind(value, part[name], f"{key}.{name}".lstrip(".")) for name, value in entries)
    return next(filter(None, found), None)


def place_of_key(file: Path | None, key: str) -> str:
    """Where a setting stands in a file, for the end of a line; empty if it is not found.

    Args:
        file: The file, if it is one.
        key: As ``env.kwargs.a``; the file may lie in a group and leave out the beginning.
    """
    root = _nodes(file)
    parts = key.split(".")
    for start in range(len(parts)):
        node, mark = root, None
        for part in parts[start:]:
            pairs = node.value if isinstance(node, yaml.MappingNode) else []
            found = next((pair for pair in pairs if pair[0].value == part), None)
            if found is None:
                break
            mark, node = found[0].start_mark, found[1]
        else:
            return position(mark)
    return ""


def place_of_text(file: Path | None, text: str) -> str:
    """Where a text stands in a file, for the end of a line; empty if it is not found."""
    if file is None:
        return ""
    for number, line in enumerate(file.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        if text in line and not line.lstrip().startswith("#"):
            return f" (line {number}, column {line.index(text) + 1})"
    return ""


def _nodes(file: Path | None) -> yaml.Node | None:
    try:
        return None if file is None else yaml.compose(file.read_text(encoding="utf-8"), yaml.SafeLoader)
    except (OSError, ValueError, yaml.YAMLError):
        return None
