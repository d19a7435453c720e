"""Does the latent know what the agent cannot see? A linear map from latent to true context, judged on other episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ada_diffuser.rollout.result import Episode

#: Weights of the penalty to choose from, for standardised latents, per sample.
PENALTIES = (1e-3, 1e-2, 1e-1, 1.0, 10.0)


@dataclass(frozen=True, eq=False)
class Readout:
    """A ridge regression, fitted on the first half of the episodes."""

    #: `(latent_dim + 1, context_dim)`, the last row is the offset.
    weights: NDArray[np.float64]
    #: Episodes from this one on were not used for the fit.
    first_shown: int
    #: Share of the context's variance on the shown episodes, all its dimensions together; 1 is all, below 0 is none.
    r2: float

    def of(self, episode: Episode) -> NDArray[np.float64]:
        """The context as the latent has it, at each act of an episode, `(acts, context_dim)`."""
        latents, _ = _pairs([episode])
        return _with_one(latents) @ self.weights


def fit(episodes: Sequence[Episode]) -> Readout | str:
    """Fits on the first half, judges on the rest; a sentence that says why not, where it cannot."""
    first_shown = (len(episodes) + 1) // 2
    if len(episodes) < 2:
        return "a readout needs at least two episodes: one to fit, one to show"
    if not episodes[0].latents or episodes[0].latents[0].size == 0:
        return "this model has no latent to read out"
    if not episodes[0].contexts:
        return "this environment does not tell its context"
    fitted = episodes[:first_shown]
    weights = _ridge(*_pairs(fitted), min(PENALTIES, key=lambda penalty: _left_out_error(fitted, penalty)))
    shown_latents, shown = _pairs(episodes[first_shown:])
    error = np.sum((shown - _with_one(shown_latents) @ weights) ** 2)
    spread = np.sum((shown - shown.mean(axis=0)) ** 2)
    if spread == 0:
        return "the context was the same in all shown episodes: there is nothing to tell apart (try more episodes)"
    return Readout(weights, first_shown, float(1 - error / spread))


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
