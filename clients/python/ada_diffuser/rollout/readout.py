"""Does the latent know what the agent cannot see? A linear map from latent to true context, judged on other episodes.

The latents are those that the agent acted with, on its own episodes: nothing that an expert saw or did is in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ada_diffuser.rollout.clusters import Clusters, cluster
from ada_diffuser.rollout.result import Episode, Evaluation
from ada_diffuser.rollout.seeds import training_seed

#: Weights of the penalty to choose from, for standardised latents, per sample.
PENALTIES = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
#: Steps of the episode at which an act is judged, from the first up to the second or the end: all, in bands, and when it has seen much.
AGES: tuple[tuple[int, int | None], ...] = ((0, None), (0, 10), (10, 30), (30, 80), (80, None), (50, None))
#: A context that varies less counts as constant.
VARIANCE_MIN = 1e-12


@dataclass(frozen=True)
class AgeError:
    """How far the read-out context is off, at some ages of the shown episodes."""

    #: Steps of the episode, the second not included.
    age: tuple[int, int]
    #: Squared error over the context's variance on all shown acts, the mean of its dimensions: 0 knows all, 1 nothing but the mean.
    mse: float
    #: Of `mse`, over episodes.
    standard_error: float
    #: Shown episodes that have an act of that age.
    episodes: int


@dataclass(frozen=True, eq=False)
class Readout:
    """A ridge regression, fitted on the first half of the episodes and shown on the others."""

    #: `(latent_dim + 1, context_dim)`, the last row is the offset.
    weights: NDArray[np.float64]
    #: Episodes from this one on were not used for the fit.
    first_shown: int
    shown: list[Episode]

    @property
    def r2(self) -> float:
        """Share of the context's variance on the shown episodes, the mean of its dimensions; 1 is all, below 0 is none."""
        return 1 - self.by_age(((0, None),))[0].mse

    def of(self, episode: Episode) -> NDArray[np.float64]:
        """The context as the latent has it, at each act of an episode, `(acts, context_dim)`."""
        latents, _ = _pairs([episode])
        return _with_one(latents) @ self.weights

    def by_age(self, ages: Sequence[tuple[int, int | None]] = AGES) -> list[AgeError]:
        """The error at each range of ages that some act of the shown episodes has."""
        end = max(len(episode.rewards) for episode in self.shown)
        ranges = [(first, end if last is None else min(last, end)) for first, last in ages if first < end]
        return [error for age in ranges if (error := self._at(age))]

    def _at(self, age: tuple[int, int]) -> AgeError | None:
        kept = [errors[(age[0] <= steps) & (steps < age[1])] for steps, errors in self._errors]
        counts = np.array([len(errors) for errors in kept if len(errors)])
        sums = np.array([errors.sum() for errors in kept if len(errors)])
        if not len(counts):
            return None
        mse, n = float(sums.sum() / counts.sum()), len(counts)
        # Of a ratio: episodes may have different numbers of acts.
        spread = np.sqrt(n / (n - 1) * np.sum((sums - mse * counts) ** 2)) / counts.sum() if n > 1 else 0.0
        return AgeError(age, mse, float(spread), n)

    @cached_property
    def _errors(self) -> list[tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Of each shown episode: the steps of its acts, and the standardised squared error of each."""
        variance = _pairs(self.shown)[1].var(axis=0)
        varies = variance > VARIANCE_MIN
        errors = [((_pairs([one])[1] - self.of(one)) ** 2)[:, varies] / variance[varies] for one in self.shown]
        return [(np.array(one.act_steps), error.mean(axis=1)) for one, error in zip(self.shown, errors, strict=True)]


def fit(episodes: Sequence[Episode]) -> Readout | str:
    """Fits on the first half, to be judged on the rest; a sentence that says why not, where it cannot."""
    first_shown = (len(episodes) + 1) // 2
    if len(episodes) < 2:
        return "a readout needs at least two episodes: one to fit, one to show"
    if not episodes[0].latents or episodes[0].latents[0].size == 0:
        return "this model has no latent to read out"
    if not episodes[0].contexts:
        return "this environment does not tell its context"
    fitted, shown = list(episodes[:first_shown]), list(episodes[first_shown:])
    if not np.any(_pairs(shown)[1].var(axis=0) > VARIANCE_MIN):
        return "the context was the same in all shown episodes: there is nothing to tell apart (try more episodes)"
    penalty = min(PENALTIES, key=lambda penalty: _left_out_error(fitted, penalty))
    return Readout(_ridge(*_pairs(fitted), penalty), first_shown, shown)


@dataclass(frozen=True, eq=False)
class Reading:
    """What the latent of one evaluation says of the context."""

    result: Evaluation
    #: A sentence where there is none.
    readout: Readout | str
    #: How far groups of latents are groups of contexts, over all episodes.
    clusters: Clusters | None

    @property
    def evidence(self) -> str:
        """What the latent was inferred from: what really happened (`filter`), or also the window itself (`refined`: kappa above 0)."""
        return "refined" if self.result.options.kappa else "filter"

    def rows(self) -> list[dict[str, Any]]:
        """For JSON, one a range of ages; none where nothing can be read."""
        if isinstance(self.readout, str):
            return []
        result = self.result
        return [
            {
                "environment": result.trial.env,
                "model": result.model.name,
                "seed": training_seed(result.model.name),
                "where": "own_rollouts",
                "evidence": self.evidence,
                "age": list(error.age),
                "mse": round(error.mse, 6),
                "r2": round(1 - error.mse, 6),
                "episodes": error.episodes,
                "standard_error": round(error.standard_error, 6),
            }
            for error in self.readout.by_age()
        ]

    def as_json(self) -> dict[str, Any]:
        """What is added to an evaluation's entry."""
        return {
            "readout": self.rows(),
            "no_readout": self.readout if isinstance(self.readout, str) else None,
            "clusters": self.clusters and self.clusters.as_json(),
        }


def read(result: Evaluation) -> Reading:
    """Fits and groups."""
    readout = fit(result.episodes)
    return Reading(result, readout, None if isinstance(readout, str) else cluster(*_pairs(result.episodes)))


def _left_out_error(episodes: Sequence[Episode], penalty: float) -> float:
    """Squared error on each episode in turn, fitted on the others (0 if there are none): a weak latent needs a strong penalty."""
    error = 0.0
    for index in range(len(episodes) if len(episodes) > 1 else 0):
        others = [*episodes[:index], *episodes[index + 1 :]]
        latents, contexts = _pairs(episodes[index : index + 1])
        error += float(np.sum((contexts - _with_one(latents) @ _ridge(*_pairs(others), penalty)) ** 2))
    return error


def _ridge(latents: NDArray[np.float64], contexts: NDArray[np.float64], penalty: float) -> NDArray[np.float64]:
    """Weights in the latents' own units; the penalty is on standardised latents, and not on the offset."""
    mean, scale = latents.mean(axis=0), latents.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    z = (latents - mean) / scale
    centred = contexts - contexts.mean(axis=0)
    slopes = np.linalg.solve(z.T @ z + penalty * len(z) * np.eye(z.shape[1]), z.T @ centred) / scale[:, None]
    return np.vstack([slopes, contexts.mean(axis=0) - mean @ slopes])


def _with_one(latents: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.hstack([latents, np.ones((len(latents), 1))])


def _pairs(episodes: Sequence[Episode]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Latent of each act, and the context that acted on that very step."""
    latents = [latent for episode in episodes for latent in episode.latents]
    contexts = [episode.contexts[step] for episode in episodes for step in episode.act_steps]
    return np.array(latents, np.float64), np.array(contexts, np.float64)
