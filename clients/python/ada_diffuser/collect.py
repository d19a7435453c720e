"""Let an expert fly an environment: a data set as a function of its job."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np

from . import environments
from .dataset import Episodes
from .experts import Expert


@dataclass(frozen=True)
class Job:
    """What to fly, apart from the expert.

    Attributes:
        env: short name, Gymnasium id, or MODULE:ID.
        options: keyword arguments of the environment.
        episodes: how many.
        noise: standard deviations of action noise; each episode draws one.
        seed: of the environment, the noise and the choice among `noise`.
        episode_steps: where episodes are truncated; None: where the environment is registered to be.
        blind: share of the episodes, 0 to 1, that an expert flies which does not see the context; drawn by the seed.
    """

    env: str
    options: dict[str, Any]
    episodes: int
    noise: tuple[float, ...]
    seed: int
    episode_steps: int | None = None
    blind: float = 0.0

    def flown_blind(self) -> np.ndarray:
        """Which episodes, (episodes,) bool: their number is the share's, rounded; which ones has its own stream of chance."""
        flags = np.arange(self.episodes) < round(self.blind * self.episodes)
        return np.random.default_rng([self.seed, 4]).permutation(flags)


def collect(
    job: Job, expert: Expert, progress: Callable[[int], object] = lambda episodes: None, *, blind: Expert | None = None
) -> tuple[Episodes, np.ndarray]:
    """Fly the episodes of one session; returns them and which of them failed, (episodes,) bool. A pure function of its arguments.

    `progress` is called with the number of episodes just flown. `blind` flies the share that the job wants flown blind.
    """
    flown_blind = job.flown_blind()
    if blind is None and flown_blind.any():
        raise ValueError("a job with a blind share needs a blind expert")
    env = environments.make(job.env, episode_steps=job.episode_steps, **job.options)
    env_seed, noise_seed = np.random.SeedSequence(job.seed).generate_state(2)
    rng = np.random.default_rng(noise_seed)
    flown, failed = [], np.zeros(job.episodes, np.bool_)
    for episode, is_blind in enumerate(flown_blind):
        std = float(rng.choice(job.noise))
        flown.append(_fly(env, blind if is_blind else expert, std, rng, int(env_seed) if episode == 0 else None))
        failed[episode] = environments.failed(env, float(flown[-1].rewards.sum()))
        if job.blind:
            flown[-1].blind = np.full(len(flown[-1].rewards), is_blind)
        progress(1)
    env.close()
    columns = {name: [getattr(e, name) for e in flown] for name in Episodes.__dataclass_fields__}
    return Episodes(**{name: None if parts[0] is None else np.concatenate(parts) for name, parts in columns.items()}), failed


def _check_fit(env: gym.Env, expert: Expert) -> None:
    context = _context(env)
    made_for = expert.sizes(0 if context is None else len(context))
    if made_for is None:
        return
    if context is None:
        raise ValueError(f"{env.spec.id} has no hidden context that an expert could see")
    wanted = env.observation_space.shape[0], env.action_space.shape[0]
    if made_for != wanted:
        raise ValueError(f"the expert is made for observations and actions of {made_for} numbers, the environment has {wanted}")


def _context(env: gym.Env) -> np.ndarray | None:
    """What acts on the coming step, where the environment tells it ahead."""
    return getattr(env.unwrapped, "context", None)


def _fly(env: gym.Env, expert: Expert, std: float, rng: np.random.Generator, seed: int | None) -> Episodes:
    """One episode with action noise `std`."""
    observation, _ = env.reset(seed=seed)
    _check_fit(env, expert)  # not before: what a class draws in `reset` need not be there earlier
    low, high = env.action_space.low, env.action_space.high
    steps: list[tuple[Any, ...]] = []
    ended = False
    while not ended:
        wanted = expert.act(observation, _context(env))
        if wanted.shape != low.shape:
            raise ValueError(f"the expert answered an array of shape {wanted.shape}, an action of {env.spec.id} has {low.shape}")
        action = np.clip(wanted + std * rng.standard_normal(wanted.shape), low, high).astype(np.float32)
        following, reward, terminal, timeout, info = env.step(action)
        steps.append((observation, action, reward, terminal, timeout, std, info.get("context")))
        observation, ended = following, terminal or timeout
    *columns, contexts = zip(*steps, strict=True)
    dtypes = (np.float32, np.float32, np.float32, np.bool_, np.bool_, np.float32)
    arrays = [np.array(column, dtype) for column, dtype in zip(columns, dtypes, strict=True)]
    told = None if contexts[0] is None else np.array(contexts, np.float32).reshape(len(contexts), -1)
    return Episodes(*arrays, context=told)


def data_card(job: Job, expert: Expert, episodes: Episodes, failed: np.ndarray, blind: Expert | None = None) -> dict[str, Any]:
    """What the episodes are and how they came about, without the facts about their file."""
    returns = episodes.returns()
    card = {
        "format": "d4rl-hdf5",
        "environment": {"id": job.env, "options": job.options} | ({"episode_steps": job.episode_steps} if job.episode_steps else {}),
        "episodes": len(returns),
        "steps": len(episodes.rewards),
        "seed": job.seed,
        "action_noise": list(job.noise),
        "returns": returns_summary(returns, failed),
        "expert": expert.card,
    }
    if blind:
        flown_blind = job.flown_blind()
        card["blind"] = {"share": job.blind, "expert": blind.card}
        for name, which in (("flown_blind", flown_blind), ("flown_seeing", ~flown_blind)):
            summary = returns_summary(returns[which], failed[which]) if which.any() else None
            card["blind"][name] = {"episodes": int(which.sum()), "returns": summary}
    return card | {"versions": {name: version(name) for name in ("ada-diffuser", "gymnasium", "h5py", "mujoco", "numpy")}}


def returns_summary(returns: np.ndarray, failed: np.ndarray) -> dict[str, Any]:
    """What a card says of the returns (episodes,) of at least one episode, and of which failed."""
    return {
        "mean": round(float(returns.mean()), 3),
        "standard_error": round(float(returns.std(ddof=1) / np.sqrt(len(returns))), 3) if len(returns) > 1 else None,
        "median": round(float(np.median(returns)), 3),
        "min": round(float(returns.min()), 3),
        "max": round(float(returns.max()), 3),
        "failures": int(failed.sum()),
    }
