"""From an environment to an expert: several searches, the best iterate of each, the best of them on fresh episodes."""

from __future__ import annotations

import inspect
import multiprocessing
import signal
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import gymnasium as gym
import numpy as np

from .. import environments
from ..environments import ArsSettings, Search
from ..leash import end_with
from .ars import search
from .policy import CalledExpert, LinearPolicy, PlannedExpert, PolicyBank

PROCESSES_MAX = 2
POLL_S = 0.5
JUDGE_EVERY = 5
JUDGE_EPISODES = 9
FRESH_EPISODES = 48


@dataclass(frozen=True)
class ExpertRecipe:
    """Everything an expert is a function of; equal recipes give equal experts.

    Attributes:
        env: Gymnasium id.
        options: keyword arguments of the environment.
        seed: of all searches.
        seeds: independent searches for each policy.
        targets: contexts that get a policy each; empty where one policy reads the context, or is blind.
        judge_noise: standard deviations of the action noise the iterates are judged under, as the data will have.
        ars: constants of the search.
        blind: search one policy that does not see the context, in whatever contexts the environment draws.
    """

    env: str
    options: dict[str, Any]
    seed: int
    seeds: int = 3
    targets: tuple[float, ...] = ()
    judge_noise: tuple[float, ...] = (0.0, 0.05, 0.1)
    ars: ArsSettings = field(default_factory=ArsSettings)
    blind: bool = False

    @property
    def iterations(self) -> int:
        """Of all searches together."""
        return max(1, len(self.targets)) * self.seeds * self.ars.iterations

    @classmethod
    def from_json(cls, plain: Mapping[str, Any]) -> ExpertRecipe:
        """From what `to_json` made."""
        tuples = {name: tuple(plain[name]) for name in ("targets", "judge_noise")}
        return cls(**{**plain, **tuples, "ars": ArsSettings(**plain["ars"])})

    def to_json(self) -> dict[str, Any]:
        """The recipe as plain JSON values."""
        plain = {**asdict(self), "targets": list(self.targets), "judge_noise": list(self.judge_noise)}
        if not self.blind:
            del plain["blind"]  # experts that see are as old as this package, and their files go on being theirs
        return plain


def formula_of(env: gym.Env, *, blind: bool = False) -> CalledExpert | PlannedExpert | None:
    """The expert that the environment's class has as a method, with the options of `env`; None where there is none.

    It is the formula `expert_action`, or the plan `expert_plan`, which is made anew for each episode. A blind one is told the environment's
    `mean_context`, whatever the context is. Raises `ValueError` where it has none.
    """
    act, plan = (getattr(env.unwrapped, name, None) for name in ("expert_action", "expert_plan"))
    if callable(plan):
        if blind:
            raise ValueError(f"{env.spec.id} has an expert that plans, and none that is blind")
        return PlannedExpert(plan, {"kind": "planned", "law": _first_line(plan)})
    if not callable(act):
        return None
    card = {"kind": "analytic", "law": _first_line(act)}
    if not blind:
        return CalledExpert(act, card)
    mean = getattr(env.unwrapped, "mean_context", None)
    if mean is None:
        raise ValueError(f"{env.spec.id} has no mean_context, which its formula could take for the one that a blind expert does not see")
    return CalledExpert(lambda observation, context: act(observation, mean), {**card, "told": mean.tolist()})


def _first_line(method: Callable[..., Any]) -> str:
    """Of its docstring."""
    return inspect.cleandoc(method.__doc__ or "").partition("\n")[0]


def recipe_for(
    env: gym.Env, options: dict[str, Any], seed: int, seeds: int | None = None, iterations: int | None = None, *, blind: bool = False
) -> ExpertRecipe | None:
    """The recipe of an environment's expert as its class wants it searched for, or None where the expert is a formula.

    `seeds` and `iterations` take the place of the class's own. Raises `ValueError` for an environment that has neither.
    """
    if formula_of(env):
        return None
    task = env.unwrapped
    env_id, module = env.spec.id, type(task).__module__
    how, targets = getattr(task, "search", None), getattr(task, "search_targets", ())
    if not isinstance(how, Search):
        flag = "--blind-expert" if blind else "--expert"
        raise ValueError(f"{env_id} has no expert of its own; give one: {flag} MODULE:FUNCTION, {flag} FILE.npz, or {flag} random")
    if targets and not how.holds:
        raise ValueError(f"{env_id} has search_targets, but its search does not say which option holds one of them")
    if not module.startswith(environments.__name__):
        env_id = f"{module}:{env_id}"  # the processes that search must import it, too
    noise = environments.action_noise(env)
    ars = replace(how.ars, iterations=iterations or how.ars.iterations)
    return ExpertRecipe(env_id, options, seed, seeds or how.searches, () if blind else targets, noise, ars, blind)


def make_expert(recipe: ExpertRecipe, progress: Callable[[int], object] = lambda iterations: None) -> PolicyBank:
    """Run the searches of a recipe, two at a time.

    `progress` is called now and then with the number of iterations just made, `recipe.iterations` in all. The result does not
    depend on the number of processes.
    """
    found = _run_searches(recipe, progress)
    slots = [found[i : i + recipe.seeds] for i in range(0, len(found), recipe.seeds)]
    best = [max(slot, key=lambda result: result[1]["fresh"]["mean"]) for slot in slots]
    # The one policy of a blind bank is the nearest to every context, and reads none.
    targets = np.array(recipe.targets or (0.0,)) if recipe.targets or recipe.blind else None
    card = {
        "kind": "ars",
        "recipe": recipe.to_json(),
        "policies": [record for _, record, _ in best],
        "searches": [record for slot in slots for _, record, _ in slot],
    }
    return PolicyBank([policy for policy, *_ in best], targets, card, best[0][2])


Found = tuple[LinearPolicy, dict[str, Any], list[LinearPolicy] | None]
"""What a search brings: its best policy, what the card says of it, and the policy after each iteration where that is kept."""


def _run_searches(recipe: ExpertRecipe, progress: Callable[[int], object]) -> list[Found]:
    """All searches in order: those of the first policy, then those of the next."""
    jobs = [(recipe, slot, number) for slot in range(max(1, len(recipe.targets))) for number in range(recipe.seeds)]
    # Spawned, not forked: a fork would copy whatever threads the caller's libraries run.
    context = multiprocessing.get_context("spawn")
    done, told = context.Value("q", 0), 0
    with ProcessPoolExecutor(min(PROCESSES_MAX, len(jobs)), context, _start_worker, (done,)) as pool:
        futures = [pool.submit(_search_job, *job) for job in jobs]
        try:
            while (state := wait(futures, POLL_S, FIRST_EXCEPTION)).not_done and not any(f.exception() for f in state.done):
                now = done.value
                progress(now - told)
                told = now
            return [future.result() for future in futures]
        finally:
            progress(done.value - told)
            pool.shutdown(cancel_futures=True)


_iterations_done: Any = None
"""In a worker: the counter shared by all searches."""


def _start_worker(done: Any) -> None:
    global _iterations_done
    _iterations_done = done
    parent = multiprocessing.parent_process()
    if parent and parent.pid:
        end_with(parent.pid)
    # An interrupt at the terminal reaches workers too: end at once and in silence, the parent says what there is to say.
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class _Course:
    """The bare environment of one policy, held at one target where the policy is trained for one."""

    def __init__(self, recipe: ExpertRecipe, slot: int) -> None:
        env = environments.make(recipe.env, **recipe.options)
        how = env.unwrapped.search
        if recipe.targets:
            env = environments.make(recipe.env, **{**recipe.options, how.holds: (recipe.targets[slot],)})
        self.env, self.steps = env.unwrapped, environments.steps_max(env)
        self.varied = {name: (getattr(self.env, name), share) for name, share in how.varies.items()}
        self.practice = {name: (getattr(self.env, name), value) for name, value in how.practice.items()}
        self.env.reset(seed=0)  # what a class draws there need not be there earlier
        context = getattr(self.env, "context", None)
        self.sees_context = context is not None and not (recipe.targets or recipe.blind)
        context_size = len(context) if self.sees_context else 0
        self.shape = (self.env.action_space.shape[0], self.env.observation_space.shape[0] + context_size)

    def practise(self, policy: LinearPolicy, seed: int) -> tuple[float, np.ndarray]:
        """An episode to learn from, with the options varied as the environment wants it."""
        rng = np.random.default_rng([seed, 2])
        for name, (value, share) in self.varied.items():
            setattr(self.env, name, value * rng.uniform(1.0 - share, 1.0 + share))
        for name, (_, value) in self.practice.items():
            setattr(self.env, name, value)
        return self._play(policy, seed, 0.0)

    def judge(self, policy: LinearPolicy, seeds: np.ndarray, noises: tuple[float, ...]) -> tuple[np.ndarray, int]:
        """Returns (episodes,) in the environment as it is, under each action noise in turn; and how many failed."""
        for name, (value, _) in (self.varied | self.practice).items():
            setattr(self.env, name, value)
        returns, failures = np.empty(len(seeds)), 0
        for i, seed in enumerate(seeds):
            returns[i], _ = self._play(policy, int(seed), noises[i % len(noises)])
            failures += environments.failed(self.env, float(returns[i]))
        return returns, failures

    def summary(self, policy: LinearPolicy, seeds: np.ndarray, noises: tuple[float, ...]) -> dict[str, Any]:
        """What a card says of episodes that are judged."""
        returns, failures = self.judge(policy, seeds, noises)
        return {
            "episodes": len(returns),
            "mean": round(float(returns.mean()), 3),
            "median": round(float(np.median(returns)), 3),
            "failures": failures,
        }

    def _play(self, policy: LinearPolicy, seed: int, noise: float) -> tuple[float, np.ndarray]:
        """One episode: its return and the features visited (steps, features)."""
        rng = np.random.default_rng([seed, 1])
        observation, _ = self.env.reset(seed=seed)
        visited, total = [], 0.0
        for _ in range(self.steps):
            features = np.concatenate([observation, self.env.context]) if self.sees_context else observation
            action = policy.act(features)
            if noise:
                action = action + noise * rng.standard_normal(action.shape)
            observation, reward, terminated, *_ = self.env.step(action)
            visited.append(features)
            total += reward
            if terminated:
                break
        return total, np.array(visited, np.float64)


def search_rngs(seed: int, slot: int, number: int) -> list[np.random.Generator]:
    """Of one search: what draws its perturbations, the episodes that its iterates are judged by, and the fresh ones."""
    return [np.random.default_rng([seed, slot, number, part]) for part in range(3)]


def _search_job(recipe: ExpertRecipe, slot: int, number: int) -> Found:
    """One search: the best iterate on evaluation episodes, and what it reaches on fresh ones."""
    course = _Course(recipe, slot)
    search_rng, judge_rng, fresh_rng = search_rngs(recipe.seed, slot, number)
    judge_seeds = judge_rng.integers(2**31, size=JUDGE_EPISODES)
    best, best_score, best_iteration = None, -np.inf, 0
    run: list[LinearPolicy] = []
    judged: list[tuple[int, float]] = []
    for iteration, policy in enumerate(search(course.practise, course.shape, recipe.ars, search_rng), start=1):
        with _iterations_done.get_lock():
            _iterations_done.value += 1
        run.append(policy)
        if iteration % JUDGE_EVERY and iteration != recipe.ars.iterations:
            continue
        score = float(course.judge(policy, judge_seeds, recipe.judge_noise)[0].mean())
        judged.append((iteration, round(score, 3)))
        if score > best_score:
            best, best_score, best_iteration = policy, score, iteration
    if best is None:
        raise ValueError("a search needs at least one iteration and finite returns")
    fresh_seeds = fresh_rng.integers(2**31, size=FRESH_EPISODES)
    record = {
        "target": recipe.targets[slot] if recipe.targets else None,
        "search": number,
        "iteration": best_iteration,
        "judged": round(best_score, 3),
        "fresh": course.summary(best, fresh_seeds, recipe.judge_noise),
        "fresh_without_noise": course.summary(best, fresh_seeds, (0.0,)),
    }
    if not course.env.search.keeps_run or recipe.targets:
        return best, record, None
    return best, record | {"run": judged}, run
