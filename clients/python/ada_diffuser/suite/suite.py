"""SUITE.toml: methods, environments and seeds, as data. clients/python/README.md has an example with every key."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ada_diffuser.suite.toml import Table, loads

#: Whether every act starts from noise, or goes on with the window of the act before.
Mode = Literal["cold", "streaming"]
MODES: tuple[Mode, ...] = ("cold", "streaming")

#: Names become names of files.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.,=+-]{0,99}")
#: Keys of a recipe that say how a finished checkpoint is sampled: to change them trains nothing anew.
_AFTERWARDS = re.compile(
    r"restart\.\w+|sampler\.(streaming|action_horizon|eta|temperature|kappa|latent|guidance_\w+|free_guidance_scale|told_\w+"
    r"|candidates|pick_temperature|picard_\w+)"
)


@dataclass(frozen=True)
class Environment:
    """What is played, and what was seen of it before."""

    name: str
    #: As `ada-collect --env` takes it.
    env: str
    #: Its keyword arguments.
    options: Mapping[str, Any]
    episode_steps: int | None
    #: Flags of `ada-collect`, without their dashes; None: `data` is there already.
    collect: Mapping[str, Any] | None
    data: Path | None
    #: What methods change that name no recipe of their own.
    recipe: Path | None = None
    #: `KEY=VALUE`, what all methods have there; a method's own come after them.
    keys: tuple[str, ...] = ()


@dataclass(frozen=True)
class Method:
    """A recipe with other values for some of its keys."""

    name: str
    #: By environment; one that is not named is none of this method's.
    recipes: Mapping[str, Path]
    #: Files of methods, as `ada-trainer run --with` takes them.
    changes: tuple[Path, ...]
    #: `KEY=VALUE`, as `ada-trainer run --set` takes them.
    keys: tuple[str, ...]
    modes: tuple[Mode, ...]
    #: The method that this is a variant of, and which key has which value in it.
    family: str
    varied: tuple[str, Any] | None = None


@dataclass(frozen=True)
class Suite:
    """A file."""

    #: The file's name without `.toml`.
    name: str
    title: str
    #: Of the trainings.
    seeds: tuple[int, ...]
    #: The method that the others are held against; None: they are not.
    reference: str | None
    #: Episodes of each cell in each mode, and the seed of the first; all methods see the same.
    episodes: int
    first_seed: int
    environments: Mapping[str, Environment]
    methods: Mapping[str, Method]
    #: The paper's numbers as they are printed, by environment and method.
    paper: Mapping[str, Mapping[str, Any]]

    @classmethod
    def load(cls, path: Path) -> Suite:
        """ValueError names the file and the key that is wrong."""
        try:
            return _suite(path.stem, Table(loads(path.read_text(encoding="utf-8"))))
        except FileNotFoundError:
            raise ValueError(f"there is no suite {path}") from None
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None


def _suite(name: str, top: Table) -> Suite:
    title: str = top.take("title", str, name)
    seeds = tuple(top.take("seeds", list[int], [0, 1, 2]))
    reference: str | None = top.take("reference", str, None)
    evaluation = Table(top.take("evaluation", dict, {}), "evaluation")
    episodes, first_seed = evaluation.take("episodes", int, 64), evaluation.take("seed", int, 1000)
    modes = _modes(evaluation, MODES)
    evaluation.end()
    environments = {name: _environment(name, table) for name, table in top.tables("environments").items()}
    methods = {one.name: one for name, table in top.tables("methods").items() for one in _methods(name, table, environments, modes)}
    paper = {name: table.rest() for name, table in top.tables("paper", needed=False).items()}
    top.end()
    return _checked(Suite(name, title, seeds, reference, episodes, first_seed, environments, methods, paper))


def _checked(suite: Suite) -> Suite:
    """With what one key alone does not tell."""
    seeds = suite.seeds
    if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < 0:
        raise ValueError(f"seeds must be training seeds, each once, not {list(seeds)}")
    if suite.episodes < 2:
        raise ValueError(f"evaluation.episodes must be at least 2, not {suite.episodes}: one says nothing of the spread")
    if not suite.environments or not suite.methods:
        raise ValueError("a suite needs at least one of environments and of methods")
    if suite.reference is not None and suite.reference not in suite.methods:
        raise ValueError(f"reference {suite.reference!r} is no method; there are {', '.join(suite.methods)}")
    for environment, numbers in suite.paper.items():
        _known(f"paper.{environment}", environment, "environment", suite.environments)
        for method, number in numbers.items():
            _known(f"paper.{environment}.{method}", method, "method", suite.methods)
            if isinstance(number, bool) or not isinstance(number, (int, float, str)):
                raise ValueError(f"paper.{environment}.{method} must be a number, or text as it is printed, not {number!r}")
    return suite


def _known(path: str, name: str, what: str, known: Mapping[str, Any]) -> None:
    if name not in known:
        raise ValueError(f"{path} is of no {what} of this suite; there are {', '.join(known)}")


def _environment(name: str, table: Table) -> Environment:
    _check_name(name)
    env, options = table.take("env", str, name), table.take("options", dict, {})
    steps: int | None = table.take("episode_steps", int, None)
    collect: dict[str, Any] | None = table.take("collect", dict, None)
    data: str | None = table.take("data", str, None)
    recipe: str | None = table.take("recipe", str, None)
    keys = _keys(table)
    table.end()
    if (collect is None) == (data is None):
        raise table.wrong(
            "collect", 'or data must be given, and not both: how data are made ({ episodes = 400 }), or where they are ("data/x.h5")'
        )
    for flag, value in (collect or {}).items():
        if flag in ("env", "option", "episode-steps", "out", "json", "quiet"):
            raise table.wrong(f"collect.{flag}", "is said by the suite itself; env, options and episode_steps stand beside collect")
        if not isinstance(value, (str, int, float)):
            raise table.wrong(f"collect.{flag}", f"must be what stands behind ada-collect --{flag}, not {value!r}")
    return Environment(name, env, options, steps, collect, _path(data), _path(recipe), keys)


def _keys(table: Table) -> tuple[str, ...]:
    keys = tuple(table.take("set", list[str], []))
    for key in keys:
        if not key.partition("=")[1]:
            raise table.wrong("set", f"has {key!r}, which is not KEY=VALUE")
    return keys


def _path(text: str | None) -> Path | None:
    return None if text is None else Path(text)


def _methods(name: str, table: Table, environments: Mapping[str, Environment], modes: tuple[Mode, ...]) -> list[Method]:
    """The method, or with `vary` one for each value of each key."""
    _check_name(name)
    recipes = _recipes(table, environments)
    changes = tuple(Path(path) for path in table.take("with", list[str], []))
    keys = _keys(table)
    modes = _modes(table, modes)
    vary: dict[str, Any] = table.take("vary", dict, {})
    table.end()
    for key, values in vary.items():
        if not isinstance(values, list) or not values:
            raise table.wrong(f"vary.{key}", f"must be a list of values, not {values!r}")
    if not vary:
        return [Method(name, recipes, changes, keys, modes, name)]
    variants = [(key, value, f"{key}={_word(value)}") for key, values in vary.items() for value in values]
    for _, _, text in variants:
        _check_name(f"{name},{text}")
    return [Method(f"{name},{text}", recipes, changes, (*keys, text), modes, name, (key, value)) for key, value, text in variants]


def _word(value: Any) -> str:
    """As `ada-trainer --set` takes it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _recipes(table: Table, environments: Mapping[str, Environment]) -> dict[str, Path]:
    """`"models/{environment}/recipe.toml"`, or a table with a path for each environment of the method; else the environments' own."""
    given: Any = table.take("recipe", object, None)
    if given is None:
        own = {name: one.recipe for name, one in environments.items() if one.recipe is not None}
        if not own:
            raise table.wrong("recipe", "must be given: no environment has one of its own")
        return own
    if isinstance(given, str):
        given = {name: given.replace("{environment}", name) for name in environments}
    if not isinstance(given, dict) or not all(isinstance(path, str) for path in given.values()):
        raise table.wrong("recipe", f"must be a path, or a table of paths by environment, not {given!r}")
    for name in given:
        _known(f"{table.path}.recipe.{name}", name, "environment", environments)
    return {name: Path(path) for name, path in given.items()}


def _modes(table: Table, default: tuple[Mode, ...]) -> tuple[Mode, ...]:
    given = table.take("modes", list[str], list(default))
    if not given or not set(given) <= set(MODES):
        raise table.wrong("modes", f"must be some of {', '.join(MODES)}, not {given!r}")
    return tuple(mode for mode in MODES if mode in given)


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name!r} cannot be the name of a file: letters, digits and _.,=+- will do, 100 at most")


def is_trained(key: str) -> bool:
    """Whether a training depends on this `KEY=VALUE`; else it changes the defaults of a finished checkpoint."""
    return not _AFTERWARDS.fullmatch(key.partition("=")[0].strip())
