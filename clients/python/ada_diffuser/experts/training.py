"""From an environment to an expert: several searches, the best iterate of each, the best of them on fresh episodes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from .. import environments
from .ars import ArsSettings, search
from .policy import AnalyticPilot, Expert, LinearPolicy, PolicyBank

PROCESSES_MAX = 2
GAIN_SPREAD = 0.2
JUDGE_EVERY = 5
JUDGE_EPISODES = 9
FRESH_EPISODES = 48
GRID_SPEEDS = (0.5, 1.0, 1.5, 2.0, 2.5)
"""Speeds that get a policy of their own where the environment draws from a continuum."""


@dataclass(frozen=True)
class ExpertRecipe:
    """Everything an expert is a function of; equal recipes give equal experts.

    Attributes:
        env: Gymnasium id.
        options: keyword arguments of the environment.
        seed: of all searches.
        seeds: independent searches for each policy.
        targets: wanted speeds that get a policy each; empty where one policy reads the context.
        judge_noise: standard deviations of the action noise the iterates are judged under, as the data will have.
        ars: constants of the search.
    """

    env: str
    options: dict[str, Any]
    seed: int
    seeds: int = 3
    targets: tuple[float, ...] = ()
    judge_noise: tuple[float, ...] = (0.0, 0.05, 0.1)
    ars: ArsSettings = field(default_factory=ArsSettings)

    def to_json(self) -> dict[str, Any]:
        """The recipe as plain JSON values."""
        return {**asdict(self), "targets": list(self.targets), "judge_noise": list(self.judge_noise)}


def recipe_for(env: gym.Env, options: dict[str, Any], seed: int, seeds: int, ars: ArsSettings) -> ExpertRecipe | None:
    """The recipe of an environment's expert, or None where the expert is a formula.

    Raises `ValueError` for an environment that has neither.
    """
    task = env.unwrapped
    if isinstance(task, environments.PointWindS):
        return None
    env_id = env.spec.id if env.spec else type(task).__name__
    if isinstance(task, environments.CheetahVelE):
        targets = GRID_SPEEDS if isinstance(task.targets, str) else tuple(sorted(set(task.targets)))
        return ExpertRecipe(env_id, options, seed, seeds, targets, ars=ars)
    if isinstance(task, environments.CheetahWindS | environments.CheetahWindE):
        return ExpertRecipe(env_id, options, seed, seeds, ars=ars)
    raise ValueError(f"{env_id} has no expert of its own; give one with --expert")


def make_expert(recipe: ExpertRecipe | None, progress: Callable[[int, int], None] = lambda done, total: None) -> Expert:
    """Run the searches of a recipe, two at a time; without a recipe, the analytic pilot.

    `progress(done, total)` is called as searches end. The result does not depend on the number of processes.
    """
    if recipe is None:
        return AnalyticPilot()
    jobs = [(recipe, slot, number) for slot in range(max(1, len(recipe.targets))) for number in range(recipe.seeds)]
    progress(0, len(jobs))
    found = []
    # Spawned, not forked: a fork would copy whatever threads the caller's libraries run.
    with multiprocessing.get_context("spawn").Pool(min(PROCESSES_MAX, len(jobs))) as pool:
        for result in pool.imap(_search_job, jobs):
            found.append(result)
            progress(len(found), len(jobs))
    slots = [found[i : i + recipe.seeds] for i in range(0, len(found), recipe.seeds)]
    best = [max(slot, key=lambda result: result[1]["fresh"]["mean"]) for slot in slots]
    targets = np.array(recipe.targets) if recipe.targets else None
    card = {
        "kind": "ars",
        "recipe": recipe.to_json(),
        "policies": [record for _, record in best],
        "searches": [record for slot in slots for _, record in slot],
    }
    return PolicyBank([policy for policy, _ in best], targets, card)


def play(env: gym.Env, policy: LinearPolicy, seed: int, noise: float = 0.0, sees_context: bool = True) -> tuple[float, np.ndarray]:
    """One episode on the bare environment; returns its return and the features visited (200, features)."""
    rng = np.random.default_rng([seed, 1])
    observation, _ = env.reset(seed=seed)
    visited, total = [], 0.0
    for _ in range(environments.EPISODE_STEPS):
        features = np.concatenate([observation, env.context]) if sees_context else observation
        action = policy.act(features)
        if noise:
            action = action + noise * rng.standard_normal(action.shape)
        observation, reward, *_ = env.step(action)
        visited.append(features)
        total += reward
    return total, np.array(visited, np.float64)


def _search_job(job: tuple[ExpertRecipe, int, int]) -> tuple[LinearPolicy, dict[str, Any]]:
    """One search: the best iterate on evaluation episodes, and what it reaches on fresh ones."""
    recipe, slot, number = job
    env, sees_context = _bare_env(recipe, slot)
    train_rng, judge_rng, fresh_rng = (np.random.default_rng([recipe.seed, slot, number, part]) for part in range(3))
    gain = getattr(env, "gain", None)

    def rollout(policy: LinearPolicy, seed: int) -> tuple[float, np.ndarray]:
        if gain is not None:
            # A gait that only knows one strength of wind is a fragile one.
            env.gain = gain * (1.0 + GAIN_SPREAD * (2.0 * (seed % 1024) / 1023.0 - 1.0))
        return play(env, policy, seed, sees_context=sees_context)

    def judge(policy: LinearPolicy, seeds: np.ndarray, noises: tuple[float, ...]) -> np.ndarray:
        if gain is not None:
            env.gain = gain
        return np.array([play(env, policy, int(s), noises[i % len(noises)], sees_context)[0] for i, s in enumerate(seeds)])

    judge_seeds = judge_rng.integers(2**31, size=JUDGE_EPISODES)
    shape = (env.action_space.shape[0], env.observation_space.shape[0] + (1 if sees_context else 0))
    best, best_score, best_iteration = None, -np.inf, 0
    for iteration, policy in enumerate(search(rollout, shape, recipe.ars, train_rng), start=1):
        if iteration % JUDGE_EVERY and iteration != recipe.ars.iterations:
            continue
        score = float(judge(policy, judge_seeds, recipe.judge_noise).mean())
        if score > best_score:
            best, best_score, best_iteration = policy, score, iteration
    if best is None:
        raise ValueError("ars.iterations must be at least 1")
    fresh_seeds = fresh_rng.integers(2**31, size=FRESH_EPISODES)
    record = {
        "target": recipe.targets[slot] if recipe.targets else None,
        "search": number,
        "iteration": best_iteration,
        "judged": round(best_score, 3),
        "fresh": _summary(env, judge(best, fresh_seeds, recipe.judge_noise)),
        "fresh_without_noise": _summary(env, judge(best, fresh_seeds, (0.0,))),
    }
    return best, record


def _bare_env(recipe: ExpertRecipe, slot: int) -> tuple[gym.Env, bool]:
    """The unwrapped environment of a policy, held at one target where it is trained for one."""
    options = {**recipe.options, "targets": (recipe.targets[slot],)} if recipe.targets else recipe.options
    return environments.make(recipe.env, **options).unwrapped, not recipe.targets


def _summary(env: gym.Env, returns: np.ndarray) -> dict[str, Any]:
    return {
        "episodes": len(returns),
        "mean": round(float(returns.mean()), 3),
        "median": round(float(np.median(returns)), 3),
        "failures": int(sum(env.failed(r) for r in returns)),
    }
