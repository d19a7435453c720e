"""The sampling options of a session: each is one line here, with what it is, and both faces and every command line read it from there."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Annotated, Any, Literal, get_type_hints

from ada_diffuser.values import flag, invalid, number, text, vector, whole

LatentMode = Literal["mean", "sample"]


@dataclass(frozen=True, eq=False)
class Kind:
    """What an option is. Faces that spell one in their own way say so by kind."""

    #: From a word of a command line; ValueError says what is wrong with it.
    parse: Callable[[str], Any]
    #: From a caller's value and its field, as it travels; InvalidInput says what is wrong with it.
    check: Callable[[Any, str], Any]


def _flag(word: str) -> bool:
    if word.lower() not in ("true", "false"):
        raise ValueError(f"{word!r} is neither true nor false")
    return word.lower() == "true"


def _latent_mode(word: str) -> str:
    if word not in ("mean", "sample"):
        raise ValueError(f"{word!r} is neither mean nor sample")
    return word


def _checked_mode(value: Any, field: str) -> str:
    if text(value, field) not in ("mean", "sample"):
        raise invalid(field, f"{value!r} is neither mean nor sample")
    return str(value)


def _numbers(word: str) -> tuple[float, ...]:
    try:
        return tuple(float(value) for value in _listed(json.loads(word)))
    except (TypeError, ValueError):
        raise ValueError(f"{word!r} is no list of numbers, such as [0.5,0.1]") from None


def _listed(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise TypeError
    return value


def _checked_numbers(values: Any, field: str) -> tuple[float, ...]:
    return tuple(vector(values, field).tolist())


FLAG = Kind(_flag, flag)
COUNT = Kind(int, partial(whole, bits=32))
NUMBER = Kind(float, number)
#: Infinity is one of its values.
BOUND = Kind(float, partial(number, infinity=True))
MODE = Kind(_latent_mode, _checked_mode)
NUMBERS = Kind(_numbers, _checked_numbers)


@dataclass(frozen=True)
class SamplerOptions:
    """How a chunk is sampled. In a request None means the model's default; in an answer every field is set, but for what is not told."""

    #: Keep the partly denoised window between acts.
    streaming: Annotated[bool | None, FLAG] = None
    #: Actions that one act returns.
    action_horizon: Annotated[int | None, COUNT] = None
    #: Sub-steps per rung of the ladder.
    sub_steps: Annotated[int | None, COUNT] = None
    #: 0 is DDIM, 1 is DDPM.
    eta: Annotated[float | None, NUMBER] = None
    #: Factor on the standard deviation of all noise.
    temperature: Annotated[float | None, NUMBER] = None
    #: Trust region of the zig-zag refinement in nats: 0 is off, infinity is as in the paper.
    kappa: Annotated[float | None, BOUND] = None
    #: Whether latents are drawn or their means are used.
    latent: Annotated[LatentMode | None, MODE] = None
    #: How far the guide's gradient leads the window, in standard deviations of a position at pure noise; 0 is off.
    guidance_scale: Annotated[float | None, NUMBER] = None
    #: Futures over which that gradient is averaged; 0: the gradient at the window itself.
    guidance_samples: Annotated[int | None, COUNT] = None
    #: How far beyond the unconditioned estimate the one with what is told goes; 1 is the condition alone.
    free_guidance_scale: Annotated[float | None, NUMBER] = None
    #: The return that is wanted, the discounted mean of the rewards to come, in the units of the data set; see `Model.returns`.
    told_return: Annotated[float | None, NUMBER] = None
    #: The state that is wanted at the end of the window: its columns that the model takes (`Model.told`), in the units of the data set.
    told_goal: Annotated[tuple[float, ...] | None, NUMBERS] = None
    #: Windows that are sampled for one act; the guide chooses among them.
    candidates: Annotated[int | None, COUNT] = None
    #: 0: the best candidate is chosen; above: each with probability `exp(value / pick_temperature)`.
    pick_temperature: Annotated[float | None, NUMBER] = None
    #: Rows of the sampler's table that are evaluated at once; 1 is one after the other.
    picard_window: Annotated[int | None, COUNT] = None
    #: A row is accepted that has moved by less than this since the pass before, in standard deviations of its step's noise.
    picard_tolerance: Annotated[float | None, NUMBER] = None

    @classmethod
    def parse(cls, words: Mapping[str, str]) -> SamplerOptions:
        """From text, as a command line has it: `{"streaming": "false", "kappa": "inf", "told_goal": "[0.5,0.1]"}`.

        ValueError names the wrong one.
        """
        unknown = set(words) - set(KINDS)
        if unknown:
            raise ValueError(f"no such option: {', '.join(sorted(unknown))}; there are {', '.join(KINDS)}")
        values: dict[str, Any] = {}
        for name, word in words.items():
            try:
                values[name] = KINDS[name].parse(word)
            except ValueError as error:
                raise ValueError(f"option {name}: {error}") from None
        return cls(**values)

    def given(self) -> dict[str, Any]:
        """The fields that are set."""
        pairs = ((item.name, getattr(self, item.name)) for item in fields(self))
        return {name: value for name, value in pairs if value is not None}

    def checked(self) -> SamplerOptions:
        """With plain numbers and flags, as they travel; InvalidInput names the wrong one."""
        return replace(self, **{name: KINDS[name].check(value, f"options.{name}") for name, value in self.given().items()})

    def sent(self, spell: Mapping[Kind, Callable[[Any], Any]]) -> dict[str, Any]:
        """The fields that are set, as a face spells them; kinds that it does not name stay as they are."""
        return {name: spell.get(KINDS[name], _same)(value) for name, value in self.given().items()}

    @classmethod
    def received(cls, values: Mapping[str, Any], read: Mapping[Kind, Callable[[Any], Any]]) -> SamplerOptions:
        """From what a face was answered. What is None is unset, and what a later server tells beside is left out."""
        known = {name: value for name, value in values.items() if name in KINDS and value is not None}
        return cls(**{name: read.get(KINDS[name], _same)(value) for name, value in known.items()})


#: Of each option, by its name.
KINDS: dict[str, Kind] = {name: hint.__metadata__[0] for name, hint in get_type_hints(SamplerOptions, include_extras=True).items()}


def _same(value: Any) -> Any:
    return value


def several(values: str) -> list[str]:
    """`"0,0.1"` as its words: a comma parts them, but for one within the brackets of a list, as in `"[0.5,0.1],[1,0]"`."""
    return [value.strip() for value in re.split(r",(?![^\[]*\])", values)]


def word(value: object) -> str:
    """A value as a command line has it; float32 in as many digits as tell it."""
    if isinstance(value, tuple | list):
        return f"[{','.join(map(word, value))}]"
    return f"{value:.7g}" if isinstance(value, float) else str(value).lower()
