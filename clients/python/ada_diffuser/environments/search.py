"""How an environment wants its expert searched for, where no formula is one: data of its class."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class ArsSettings:
    """The constants of the search.

    Attributes:
        iterations: updates of the policy; each costs `2 * directions` episodes.
        directions: perturbations tried in an iteration, N in the paper.
        top: of these, how many best ones the update uses, b.
        step: step size, alpha.
        noise: standard deviation of a perturbation, nu.
    """

    iterations: int = 300
    directions: int = 8
    top: int = 4
    step: float = 0.02
    noise: float = 0.03


@dataclass(frozen=True)
class Search:
    """Augmented Random Search (`ada_diffuser.experts.ars`) over linear policies; its iterates are judged under the `action_noise`.

    Attributes:
        searches: independent searches for each policy; the one that is best on fresh episodes is kept.
        ars: constants of a search.
        holds: option of the environment that takes a tuple of contexts to draw from: each of the `search_targets` is searched
            for with that one alone. Empty where one policy reads the context.
        varies: option that is also an attribute -> share by which an episode of practice changes it at most, up or down.
        practice: attribute -> its value in practice, where that is another than the one the policies are judged by.
        keeps_run: whether an expert of one policy keeps all of its search, for data of a learner (`ada-collect --quality`).
    """

    searches: int = 3
    ars: ArsSettings = field(default_factory=ArsSettings)
    holds: str = ""
    varies: Mapping[str, float] = field(default_factory=dict)
    practice: Mapping[str, float] = field(default_factory=dict)
    keeps_run: bool = False
