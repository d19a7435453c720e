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
    """

    env: str
    options: dict[str, Any]
    episodes: int
    noise: tuple[float, ...]
    seed: int
    episode_steps: int | None = None


def collect(job: Job, expert: Expert, progress: Callable[[int], object] = lambda episodes: None) -> tuple[Episodes, int]:
    """Fly the episodes of one session; returns them and how many failed. A pure function of its arguments.

    `progress` is called with the number of episodes just flown.
    """
    env = environments.make(job.env, episode_steps=job.episode_steps, **job.options)
    env_seed, noise_seed = np.random.SeedSequence(job.seed).generate_state(2)
    rng = np.random.default_rng(noise_seed)
    flown, failures = [], 0
    for episode in range(job.episodes):
        std = float(rng.choice(job.noise))
        flown.append(_fly(env, expert, std, rng, int(env_seed) if episode == 0 else None))
        failures += environments.failed(env, float(flown[-1].rewards.sum()))
        progress(1)
    env.close()
    columns = {name: [getattr(e, name) for e in flown] for name in Episodes.__dataclass_fields__}
    return Episodes(**{name: None if parts[0] is None else np.concatenate(parts) for name, parts in columns.items()}), failures


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


def data_card(job: Job, expert: Expert, episodes: Episodes, failures: int) -> dict[str, Any]:
    """What the episodes are and how they came about, without the facts about their file."""
    returns = episodes.returns()
    return {
        "format": "d4rl-hdf5",
        "environment": {"id": job.env, "options": job.options} | ({"episode_steps": job.episode_steps} if job.episode_steps else {}),
        "episodes": len(returns),
        "steps": len(episodes.rewards),
        "seed": job.seed,
        "action_noise": list(job.noise),
        "returns": {
            "mean": round(float(returns.mean()), 3),
            "standard_error": round(float(returns.std(ddof=1) / np.sqrt(len(returns))), 3) if len(returns) > 1 else None,
            "median": round(float(np.median(returns)), 3),
            "min": round(float(returns.min()), 3),
            "max": round(float(returns.max()), 3),
            "failures": failures,
        },
        "expert": expert.card,
        "versions": {name: version(name) for name in ("ada-diffuser", "gymnasium", "h5py", "mujoco", "numpy")},
    }
