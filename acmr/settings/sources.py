"""Where Hydra finds the files of settings: ``conf/``, ``sweeps/``, and whatever folders the user brings."""

from __future__ import annotations

import json
import os
import shlex
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_search_path_impl import ConfigSearchPathImpl
from hydra.core.object_type import ObjectType
from hydra.core.utils import setup_globals
from hydra.plugins.config_source import ConfigSource
from hydra.types import RunMode
from omegaconf import DictConfig, open_dict

from acmr.config import ConfigError
from acmr.settings.files import THEIRS, circle_of, read_files_with_care, shown

#: The project's own matrices, found like a user's groups.
SWEEPS = "pkg://sweeps"
_FILE = "file://"
_STORED = "sources.json"


@dataclass(frozen=True)
class Sources:
    """Places of settings files.

    Attributes:
        paths: As Hydra writes them, ``file://FOLDER`` or ``pkg://PACKAGE``. A file in an earlier one hides those of its
            name in later ones; the first has the file that everything begins with.
        name: Name of that file.
        words: What has to be typed so that Hydra looks there, quoted for a shell.
    """

    paths: tuple[str, ...]
    name: str = "config"
    words: tuple[str, ...] = ()

    @property
    def main(self) -> Path | None:
        """The folder that everything begins in; None if it is a package."""
        return Path(self.paths[0].removeprefix(_FILE)) if self.paths[0].startswith(_FILE) else None

    def compose(self, overrides: list[str]) -> tuple[DictConfig, dict[str, object]]:
        """Composes the settings, without those of Hydra; returns them and what was chosen of each group."""
        loader = _loader(self.paths)
        with self.refusing_circles():
            cfg = loader.load_configuration(self.name, overrides, run_mode=RunMode.RUN, from_shell=False)
        chosen = dict(cfg.hydra.runtime.choices)
        with open_dict(cfg):
            del cfg["hydra"]
        return cfg, chosen

    @contextmanager
    def refusing_circles(self) -> Iterator[None]:
        """Tells which files build on each other where Hydra, which follows them without end, has given up.

        Raises:
            ConfigError: If files do so.
        """
        try:
            yield
        except RecursionError as error:
            circle = circle_of(error)
            if not circle:
                raise
            first, *others = [self.file(name)[0] for name in circle]
            raise ConfigError(
                f"{first}: defaults: builds on {', which builds on '.join([*others, first])}; name another file in one"
            ) from None

    def groups(self) -> list[str]:
        """The groups of settings files, such as ``env``."""
        return list(_groups(self.paths))

    def options(self, group: str) -> list[str]:
        """What may be chosen of a group."""
        return sorted({name for source in self._ours() for name in _listed(source, group, ObjectType.CONFIG)})

    def file(self, name: str) -> tuple[str, Path | None]:
        """The file of a choice such as ``env/ant``: what it is called to the user, and itself if it is in a folder."""
        source = next((source for source in self._ours() if source.is_config(name)), None)
        if source is None:
            return f"{name}.yaml", None
        return shown(source, name), Path(source.path) / f"{name}.yaml" if source.scheme() == "file" else None

    def store(self, folder: Path, main: Path) -> None:
        """Copies the user's settings files, so that whoever edits them changes nothing for :func:`stored_sources`.

        Args:
            folder: Where they are copied to.
            main: A copy of the folder that everything begins in.
        """
        paths = [self.paths[0] if self.main is None else f"{_FILE}{main}"]
        for number, path in enumerate(self.paths[1:], start=1):
            copied = folder / f"conf-{number}"
            if path.startswith(_FILE):
                _copy_settings(Path(path.removeprefix(_FILE)), copied)
                path = f"{_FILE}{copied}"
            paths.append(path)
        (folder / _STORED).write_text(json.dumps(asdict(replace(self, paths=tuple(paths)))), encoding="utf-8")

    def _ours(self) -> list[ConfigSource]:
        return [source for source in _loader(self.paths).get_sources() if source.provider not in THEIRS]


def stored_sources(folder: Path, main: Path) -> Sources:
    """What :meth:`Sources.store` wrote; where it did not, the copy of the folder that everything begins in."""
    if not (folder / _STORED).exists():
        return Sources((f"{_FILE}{main}", SWEEPS))
    content = json.loads((folder / _STORED).read_text(encoding="utf-8"))
    return Sources(tuple(content["paths"]), content["name"], tuple(content["words"]))


def sources_of(hydra: DictConfig, usual: Path) -> Sources:
    """Where a running Hydra application finds its settings.

    Args:
        hydra: What Hydra composed for itself.
        usual: The folder that everything begins in where nothing else is typed.

    Raises:
        ConfigError: If one of the places is not there.
    """
    paths, words, added = [], [], []
    for source in hydra.runtime.config_sources:
        place = os.path.abspath(source.path) if source.schema == "file" else source.path
        if source.provider in THEIRS or source.schema not in ("file", "pkg"):
            continue
        paths.append(f"{source.schema}://{place}")
        if source.provider == "main" and place != str(usual):
            words += ["--config-path", place]
        elif source.provider == "command-line":
            words += ["--config-dir", place]
        elif source.provider == "hydra.searchpath in command-line" and paths[-1] != SWEEPS:
            added.append(f'"{paths[-1]}"')
    name = hydra.job.config_name
    words += ["--config-name", name] if name != "config" else []
    words += [f"hydra.searchpath=[{','.join(added)}]"] if added else []
    found = Sources(tuple(dict.fromkeys(paths)), name, tuple(map(shlex.quote, words)))
    missing = [source for source in found._ours() if not source.available()]
    if missing:
        raise ConfigError(f"hydra.searchpath: {missing[0].scheme()}://{missing[0].path}: there is no such place")
    return found


@lru_cache(maxsize=8)
def _loader(paths: tuple[str, ...]) -> ConfigLoaderImpl:
    # Private, read in hydra-core 1.3.8: its public way can be used once in a process, and by nobody else in it.
    # tests/test_hydra.py fails where it is gone.
    version.setbase("1.3")
    setup_globals()
    read_files_with_care()
    search_path = ConfigSearchPathImpl()
    search_path.append("hydra", "pkg://hydra.conf")
    for number, path in enumerate(paths):
        search_path.append("own" if number else "main", path)
    search_path.append("schema", "structured://")
    return ConfigLoaderImpl(search_path)


@lru_cache(maxsize=8)
def _groups(paths: tuple[str, ...]) -> tuple[str, ...]:
    found = Sources(paths)
    names = {name for source in found._ours() for name in _listed(source, "", ObjectType.GROUP)}
    # A package has folders with modules, too.
    return tuple(sorted(name for name in names - {"hydra"} if found.options(name)))


def _listed(source: ConfigSource, group: str, kind: ObjectType) -> list[str]:
    return source.list(group, kind) if source.available() and source.is_group(group) else []


def _copy_settings(folder: Path, copied: Path) -> None:
    for file in _settings_files(folder):
        target = copied / file.relative_to(folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, target)
    copied.mkdir(exist_ok=True)


def _settings_files(folder: Path) -> Iterator[Path]:
    for place, folders, files in os.walk(folder):
        # The folder may be one that holds more, a virtual environment for instance.
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (Path(place) / name for name in files if name.endswith(".yaml"))
