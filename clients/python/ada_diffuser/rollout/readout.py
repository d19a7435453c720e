"""Does the latent know what the agent cannot see? A linear map from latent to true context, judged on other episodes.

The latents are those that the agent acted with, on its own episodes: nothing that an expert saw or did is in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ada_diffuser.rollout.clusters import Clusters, cluster
from ada_diffuser.rollout.result import Episode, Evaluation, by_session, mean_and_error
from ada_diffuser.rollout.seeds import training_seed

#: Weights of the penalty to choose from, for standardised latents, per sample.
PENALTIES = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
#: Steps of the episode at which an act is judged, from the first up to the second or the end: all, in bands, and when it has seen much.
AGES: tuple[tuple[int, int | None], ...] = ((0, None), (0, 10), (10, 30), (30, 80), (80, None), (50, None))
#: Which episodes of their sessions are judged: in later ones the latent may look back on those before.
Place = Literal["all", "first", "later"]
#: A context that varies less counts as constant.
VARIANCE_MIN = 1e-12


@dataclass(frozen=True)
class AgeError:
    """How far the read-out context is off, at some ages of the shown episodes."""

    #: Steps of the episode, the second not included.
    age: tuple[int, int]
    #: Squared error over the context's variance on all shown acts, the mean of its dimensions: 0 knows all, 1 nothing but the mean.
    mse: float
    #: Of `mse`, over sessions.
    standard_error: float
    #: Shown episodes that have an act of that age.
    episodes: int


@dataclass(frozen=True, eq=False)
class Readout:
    """A ridge regression, fitted on the first half of the sessions and shown on the others."""

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
        latents, _ = pairs([episode])
        return _with_one(latents) @ self.weights

    def by_age(self, ages: Sequence[tuple[int, int | None]] = AGES, place: Place = "all") -> list[AgeError]:
        """The error at each range of ages, within its episode, that some act of the shown episodes in that place of their sessions has."""
        end = max(len(episode.rewards) for episode in self.shown)
        ranges = [(first, end if last is None else min(last, end)) for first, last in ages if first < end]
        return [error for age in ranges if (error := self._at(age, place))]

    def _at(self, age: tuple[int, int], place: Place) -> AgeError | None:
        sessions = [[_aged(one, errors, age) for one, errors in session if _stands(one, place)] for session in self._errors]
        kept = [[errors for errors in session if len(errors)] for session in sessions]
        kept = [session for session in kept if session]
        if not kept:
            return None
        return AgeError(age, *mean_and_error([np.concatenate(session) for session in kept]), sum(map(len, kept)))

    @cached_property
    def _errors(self) -> list[list[tuple[Episode, NDArray[np.float64]]]]:
        """Of each shown session: its episodes, and the standardised squared error at each of their acts."""
        variance = pairs(self.shown)[1].var(axis=0)
        varies = variance > VARIANCE_MIN

        def errors(one: Episode) -> NDArray[np.float64]:
            squared: NDArray[np.float64] = ((pairs([one])[1] - self.of(one)) ** 2)[:, varies] / variance[varies]
            return squared.mean(axis=1)

        return [[(one, errors(one)) for one in session] for session in by_session(self.shown)]


def fit(episodes: Sequence[Episode]) -> Readout | str:
    """Fits on the first half of the sessions, to be judged on the rest; a sentence that says why not, where it cannot."""
    sessions = by_session(episodes)
    fitted = sessions[: (len(sessions) + 1) // 2]
    if len(sessions) < 2:
        what = "sessions" if len(episodes) > 1 else "episodes"
        return f"a readout needs at least two {what}: one to fit, one to show"
    if not episodes[0].latents or episodes[0].latents[0].size == 0:
        return "this model has no latent to read out"
    if not episodes[0].contexts:
        return "this environment does not tell its context"
    first_shown = sum(map(len, fitted))
    shown = list(episodes[first_shown:])
    if not np.any(pairs(shown)[1].var(axis=0) > VARIANCE_MIN):
        return "the context was the same in all shown episodes: there is nothing to tell apart (try more episodes)"
    penalty = min(PENALTIES, key=lambda penalty: _left_out_error(fitted, penalty))
    return Readout(_ridge(*pairs(episodes[:first_shown]), penalty), first_shown, shown)


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

    @property
    def places(self) -> tuple[Place, ...]:
        """Of which episodes there are errors: where sessions are longer than one, the first and the later ones by themselves."""
        return ("first", "later") if self.result.trial.session_episodes > 1 else ("all",)

    def errors(self, place: Place) -> list[AgeError]:
        """By age; none where nothing can be read."""
        return [] if isinstance(self.readout, str) else self.readout.by_age(place=place)

    def rows(self) -> list[dict[str, Any]]:
        """For JSON, one a range of ages and place in the session; none where nothing can be read."""
        result = self.result
        return [
            {
                "environment": result.trial.env,
                "model": result.model.name,
                "seed": training_seed(result.model.name),
                "where": "own_rollouts",
                "evidence": self.evidence,
                **({} if place == "all" else {"episode": place}),
                "age": list(error.age),
                "mse": round(error.mse, 6),
                "r2": round(1 - error.mse, 6),
                "episodes": error.episodes,
                "standard_error": round(error.standard_error, 6),
            }
            for place in self.places
            for error in self.errors(place)
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
    return Reading(result, readout, None if isinstance(readout, str) else cluster(*pairs(result.episodes)))


def _aged(episode: Episode, errors: NDArray[np.float64], age: tuple[int, int]) -> NDArray[np.float64]:
    """The errors at the acts of that age."""
    steps = np.array(episode.act_steps)
    return errors[(age[0] <= steps) & (steps < age[1])]


def _stands(episode: Episode, place: Place) -> bool:
    return place == "all" or (episode.index > 0) == (place == "later")


def _left_out_error(sessions: Sequence[list[Episode]], penalty: float) -> float:
    """Squared error on each session in turn, fitted on the others (0 if there are none): a weak latent needs a strong penalty."""
    error = 0.0
    for index in range(len(sessions) if len(sessions) > 1 else 0):
        others = [episode for session in [*sessions[:index], *sessions[index + 1 :]] for episode in session]
        latents, contexts = pairs(sessions[index])
        error += float(np.sum((contexts - _with_one(latents) @ _ridge(*pairs(others), penalty)) ** 2))
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


def pairs(episodes: Sequence[Episode]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Latent of each act, and the context that acted on that very step."""
    latents = [latent for episode in episodes for latent in episode.latents]
    contexts = [episode.contexts[step] for episode in episodes for step in episode.act_steps]
    return np.array(latents, np.float64), np.array(contexts, np.float64)
