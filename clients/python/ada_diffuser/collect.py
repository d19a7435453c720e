"""Let an expert fly an environment: a data set as a function of its job."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np

from . import environments
from .dataset import Episodes, returns_summary
from .experts import Expert, Flight


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
        play: share of the episodes that the expert flies told the context of another world: its actions say nothing of the true one, and
            are nothing to imitate.
        session_episodes: after so many episodes the environment is reset with a seed, and another session begins; the last one has what is
            left. A session is blind, or play, as a whole. None: all episodes are one session, and each is drawn by itself.
    """

    env: str
    options: dict[str, Any]
    episodes: int
    noise: tuple[float, ...]
    seed: int
    episode_steps: int | None = None
    blind: float = 0.0
    play: float = 0.0
    session_episodes: int | None = None

    def sessions(self) -> np.ndarray:
        """The number of each episode's session, (episodes,) int64."""
        return np.arange(self.episodes, dtype=np.int64) // (self.session_episodes or self.episodes)

    def flown_blind(self) -> np.ndarray:
        """Which episodes, (episodes,) bool: their number is the share's, rounded; which ones has its own stream of chance."""
        return self._drawn(self.blind)

    def played(self) -> np.ndarray:
        """Which episodes are play, (episodes,) bool; none of them is flown blind."""
        return ~self.flown_blind() & self._drawn(self.blind + self.play)

    def _drawn(self, share: float) -> np.ndarray:
        """(episodes,) bool; who is drawn for a share is drawn for a larger one too."""
        groups = np.arange(self.episodes) if self.session_episodes is None else self.sessions()
        count = int(groups[-1]) + 1
        return (np.random.default_rng([self.seed, 4]).permutation(np.arange(count)) < round(share * count))[groups]


def collect(
    job: Job,
    expert: Expert,
    progress: Callable[[int], object] = lambda episodes: None,
    *,
    blind: Expert | None = None,
    flights: Sequence[Flight] | None = None,
) -> tuple[Episodes, np.ndarray]:
    """Fly the episodes; returns them and which of them failed, (episodes,) bool. A pure function of its arguments.

    `progress` is called with the number of episodes just flown. `blind` flies the share that the job wants flown blind. `flights` say of
    each episode who flies it, where that is not the expert.
    """
    flown_blind, played = job.flown_blind(), job.played()
    if blind is None and flown_blind.any():
        raise ValueError("a job with a blind share needs a blind expert")
    env = environments.make(job.env, episode_steps=job.episode_steps, **job.options)
    rng = np.random.default_rng(np.random.SeedSequence(job.seed).generate_state(2)[1])
    sessions, seeds = job.sessions(), _seeds(job)
    other = _OtherWorld(job) if played.any() else None
    flown, failed = [], np.zeros(job.episodes, np.bool_)
    for episode, (is_blind, is_play) in enumerate(zip(flown_blind, played, strict=True)):
        flight = Flight(expert) if flights is None else flights[episode]
        std = float(rng.choice(job.noise)) if flight.noise is None else flight.noise
        seed = seeds[episode] if flight.seed is None else flight.seed
        pilot, told = blind if is_blind else flight.expert, other if is_play else None
        flown.append(_fly(env, pilot, std, rng, seed, told))
        failed[episode] = environments.failed(env, float(flown[-1].rewards.sum()))
        if job.blind:
            flown[-1].blind = np.full(len(flown[-1].rewards), is_blind)
        if job.play:
            flown[-1].play = np.full(len(flown[-1].rewards), is_play)
        if job.session_episodes:
            flown[-1].session = np.full(len(flown[-1].rewards), sessions[episode])
        progress(1)
    env.close()
    if other:
        other.close()
    columns = {name: [getattr(e, name) for e in flown] for name in Episodes.__dataclass_fields__}
    return Episodes(**{name: None if parts[0] is None else np.concatenate(parts) for name, parts in columns.items()}), failed


def _seeds(job: Job) -> list[int | None]:
    """What the environment is reset with before each episode: a seed where a session begins, nothing where it goes on."""
    seeds: list[int | None] = [None] * job.episodes
    if job.session_episodes is None:
        seeds[0] = int(np.random.SeedSequence(job.seed).generate_state(2)[0])
        return seeds
    rng = np.random.default_rng([job.seed, 6])
    for first in range(0, job.episodes, job.session_episodes):
        seeds[first] = int(rng.integers(2**31))
    return seeds


def _check_fit(env: gym.Env, expert: Expert) -> None:
    context = _context(env)
    made_for = expert.sizes(0 if context is None else len(context))
    if made_for is None:
        return
    wanted = env.observation_space.shape[0], env.action_space.shape[0]
    if made_for != wanted:
        raise ValueError(f"the expert is made for observations and actions of {made_for} numbers, {env.spec.id} has {wanted}")


def _context(env: gym.Env) -> np.ndarray | None:
    """What acts on the coming step, where the environment tells it ahead."""
    return getattr(env.unwrapped, "context", None)


class _OtherWorld:
    """Another episode of the same environment, under the same actions: its context is drawn as the true one is, and has nothing to do with
    it. Where the job has sessions it goes through one of its own meanwhile, so that the false context lasts as the true one does."""

    def __init__(self, job: Job) -> None:
        self._env = environments.make(job.env, episode_steps=job.episode_steps, **job.options)
        self._rng, self._ended = np.random.default_rng([job.seed, 5]), True
        self._lasts = job.session_episodes is not None

    def begin(self, *, session: bool) -> None:
        """An episode, and a session where the true one begins; without sessions each time, so that all of the context is drawn anew."""
        self._env.reset(seed=int(self._rng.integers(2**31)) if session or not self._lasts else None)
        self._ended = False

    @property
    def context(self) -> np.ndarray | None:
        return _context(self._env)

    def follow(self, action: np.ndarray) -> None:
        if not self._ended:  # what it was at the end holds
            _, _, terminal, timeout, _ = self._env.step(action)
            self._ended = terminal or timeout

    def close(self) -> None:
        self._env.close()


def _fly(
    env: gym.Env, expert: Expert, std: float, rng: np.random.Generator, seed: int | None, other: _OtherWorld | None = None
) -> Episodes:
    """One episode with action noise `std`; the expert is told the context of the `other` world, if there is one, and the goal where an
    environment has one and no context.
    """
    observation, _ = env.reset(seed=seed)
    if other:
        other.begin(session=seed is not None)
        if other.context is None:
            raise ValueError(f"--play: {env.spec.id} has no hidden context that an expert could be told falsely")
    _check_fit(env, expert)  # not before: what a class draws in `reset` need not be there earlier
    expert.begin(rng)
    low, high = env.action_space.low, env.action_space.high
    steps: list[tuple[Any, ...]] = []
    ended = False
    while not ended:
        goal = environments.goal(env)
        context = other.context if other else _context(env)
        wanted = expert.act(observation, goal if context is None else context)
        if wanted.shape != low.shape:
            raise ValueError(f"the expert answered an array of shape {wanted.shape}, an action of {env.spec.id} has {low.shape}")
        action = np.clip(wanted + std * rng.standard_normal(wanted.shape), low, high).astype(np.float32)
        following, reward, terminal, timeout, info = env.step(action)
        if other:
            other.follow(action)
        steps.append((observation, action, reward, terminal, timeout, std, goal, info.get("context")))
        observation, ended = following, terminal or timeout
    *columns, goals, contexts = zip(*steps, strict=True)
    dtypes = (np.float32, np.float32, np.float32, np.bool_, np.bool_, np.float32)
    arrays = [np.array(column, dtype) for column, dtype in zip(columns, dtypes, strict=True)]
    told, wanted = (None if rows[0] is None else np.array(rows, np.float32).reshape(len(rows), -1) for rows in (contexts, goals))
    return Episodes(*arrays, context=told, goal=wanted)


def data_card(
    job: Job,
    expert: Expert,
    episodes: Episodes,
    failed: np.ndarray,
    blind: Expert | None = None,
    quality: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """What the episodes are and how they came about, without the facts about their file."""
    returns = episodes.returns()
    card = {
        "format": "d4rl-hdf5",
        "environment": {"id": job.env, "options": job.options} | ({"episode_steps": job.episode_steps} if job.episode_steps else {}),
        "episodes": len(returns),
        **({"session_episodes": job.session_episodes} if job.session_episodes else {}),
        "steps": len(episodes.rewards),
        "seed": job.seed,
        "action_noise": list(job.noise),
        "returns": returns_summary(returns, failed),
        **_measures(job, returns),
        "expert": expert.card,
        **({"quality": quality} if quality else {}),
    }
    flown_blind, played = job.flown_blind(), job.played()

    def summary(which: np.ndarray) -> dict[str, Any]:
        return {"episodes": int(which.sum()), "returns": returns_summary(returns[which], failed[which]) if which.any() else None}

    if blind:
        card["blind"] = {"share": job.blind, "expert": blind.card, "flown_blind": summary(flown_blind)}
        card["blind"]["flown_seeing"] = summary(~flown_blind & ~played)
    if job.play:
        card["play"] = {"share": job.play, "played": summary(played), "demonstrated": summary(~played)}
    return card | {"versions": {name: version(name) for name in ("ada-diffuser", "gymnasium", "h5py", "mujoco", "numpy")}}


def _measures(job: Job, returns: np.ndarray) -> dict[str, Any]:
    """The means of what the environment says of its episodes beside their returns; nothing where it says nothing."""
    env = environments.make(job.env, episode_steps=job.episode_steps, **job.options)
    said = [environments.measures(env, float(value)) for value in returns]
    env.close()
    return {"measures": {name: round(float(np.mean([one[name] for one in said])), 3) for name in said[0]}} if said[0] else {}
