"""Let an expert fly an environment: a data set as a function of its job."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np

from . import environments
from .dataset import Episodes
from .experts import Expert

NOISE_POINT = (0.1, 0.2, 0.3)
NOISE_CHEETAH = (0.0, 0.05, 0.1)


@dataclass(frozen=True)
class Job:
    """What to fly, apart from the expert.

    Attributes:
        env: short name or Gymnasium id.
        options: keyword arguments of the environment.
        episodes: how many.
        noise: standard deviations of action noise; each episode draws one.
        seed: of the environment, the noise and the choice among `noise`.
    """

    env: str
    options: dict[str, Any]
    episodes: int
    noise: tuple[float, ...]
    seed: int


def collect(job: Job, expert: Expert, progress: Callable[[range], Iterator[int]] = iter) -> tuple[Episodes, int]:
    """Fly the episodes of one session; returns them and how many failed. A pure function of its arguments."""
    env = environments.make(job.env, **job.options)
    _check_fit(env, expert)
    env_seed, noise_seed = np.random.SeedSequence(job.seed).generate_state(2)
    rng = np.random.default_rng(noise_seed)
    flown, failures = [], 0
    for episode in progress(range(job.episodes)):
        std = float(rng.choice(job.noise))
        flown.append(_fly(env, expert, std, rng, int(env_seed) if episode == 0 else None))
        failures += env.unwrapped.failed(float(flown[-1].rewards.sum()))
    env.close()
    columns = {name: np.concatenate([getattr(e, name) for e in flown]) for name in Episodes.__dataclass_fields__}
    return Episodes(**columns), failures


def _check_fit(env: gym.Env, expert: Expert) -> None:
    if not hasattr(env.unwrapped, "context"):
        raise ValueError(f"{env.spec.id} has no hidden context that an expert could see")
    wanted = env.observation_space.shape[0], env.action_space.shape[0]
    made_for = expert.sizes(len(env.unwrapped.context))
    if made_for != wanted:
        raise ValueError(f"the expert is made for observations and actions of {made_for} numbers, the environment has {wanted}")


def _fly(env: gym.Env, expert: Expert, std: float, rng: np.random.Generator, seed: int | None) -> Episodes:
    """One episode with action noise `std`."""
    observation, _ = env.reset(seed=seed)
    low, high = env.action_space.low, env.action_space.high
    steps: list[tuple[Any, ...]] = []
    ended = False
    while not ended:
        wanted = expert.act(observation, env.unwrapped.context)
        action = np.clip(wanted + std * rng.standard_normal(wanted.shape), low, high).astype(np.float32)
        following, reward, terminal, timeout, info = env.step(action)
        steps.append((observation, action, reward, terminal, timeout, info["context"], std))
        observation, ended = following, terminal or timeout
    dtypes = (np.float32, np.float32, np.float32, np.bool_, np.bool_, np.float32, np.float32)
    return Episodes(*(np.array(column, dtype) for column, dtype in zip(zip(*steps, strict=True), dtypes, strict=True)))


def default_noise(env: gym.Env) -> tuple[float, ...]:
    """Action noise that shows states off the expert's path; more of it stops the cheetah's gait."""
    return NOISE_POINT if isinstance(env.unwrapped, environments.PointWindS) else NOISE_CHEETAH


def data_card(job: Job, expert: Expert, episodes: Episodes, failures: int) -> dict[str, Any]:
    """What the episodes are and how they came about, without the facts about their file."""
    returns = episodes.returns()
    return {
        "format": "d4rl-hdf5",
        "environment": {"id": job.env, "options": job.options},
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
