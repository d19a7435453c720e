"""The loop: environments in lockstep, one act or one batch of acts wherever a chunk is used up."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from types import TracebackType
from typing import Any

import gymnasium
import numpy as np

from ada_diffuser import environments
from ada_diffuser.broker import ChunkBroker
from ada_diffuser.client import Client
from ada_diffuser.errors import AdaError
from ada_diffuser.messages import Chunk, Model, Observation, SamplerOptions
from ada_diffuser.rollout.goal import wanted_columns, with_goal
from ada_diffuser.rollout.oracle import true_context
from ada_diffuser.rollout.result import ActLog, Episode, Evaluation, Trial
from ada_diffuser.session import Session

#: Called with the number of environment steps just made.
Progress = Callable[[int], object]


def evaluate(client: Client, trial: Trial, progress: Progress = lambda steps: None) -> Evaluation:
    """Runs the trial's sessions, `trial.vector` of them side by side.

    Rewards are reported with the actions, since a latent may live off them, unless the trial withholds them. An oracle is told the true
    context, and a model that takes goals that of each episode. Raises the `AdaError` of the first act that cannot be had, and ValueError
    where environment and model do not fit.
    """
    started = time.monotonic()
    acts, episodes = ActLog(), []
    with ExitStack() as stack:
        lanes = _open_lanes(client, trial, stack)
        model, options = lanes[0].broker.session.model, lanes[0].options
        for first in range(0, len(trial.sessions), len(lanes)):
            sessions = trial.sessions[first : first + len(lanes)]
            group = lanes[: len(sessions)]
            for lane, (seed, length) in zip(group, sessions, strict=True):
                lane.start(seed, length)
            _run(client, trial, group, acts, progress)
            episodes += [episode for lane in group for episode in lane.episodes]
    return Evaluation(trial, model, options, episodes, acts, time.monotonic() - started)


class _Lane:
    """One environment and its session on the server; an episode whose goal is told, or that begins warm, has a session of its own."""

    def __init__(self, client: Client, trial: Trial, env: gymnasium.Env[Any, Any], seed: int) -> None:
        self.env, self._client, self._trial = env, client, trial
        self._goal_columns = wanted_columns(client, trial, env)
        if self._goal_columns:
            env.reset(seed=seed)
        self.broker = ChunkBroker(self._open(seed))
        #: Whether the last of `_length` episodes is over.
        self.done = True
        self.episodes: list[Episode] = []
        self._length = 0
        self.state = np.zeros(0, np.float32)
        #: What the environment said last.
        self._facts: dict[str, Any] = {}

    def _open(self, seed: int) -> Session:
        options = with_goal(self._trial.options, self.env, self._goal_columns)
        return self._client.open_session(self._trial.model, seed=seed, options=options, history=self._trial.history)

    def __enter__(self) -> _Lane:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.broker.session.__exit__(kind, error, trace)

    @property
    def options(self) -> SamplerOptions:
        """In force in all episodes: without the goal that each of them has."""
        options = self.broker.session.options
        return replace(options, told_goal=None) if self._goal_columns else options

    @property
    def episode(self) -> Episode:
        """The one under way."""
        return self.episodes[-1]

    def start(self, seed: int, length: int) -> None:
        """The first of so many episodes that follow one another."""
        self.episodes, self._length, self.done = [], length, False
        self._begin(seed)

    def _begin(self, seed: int) -> None:
        """The next episode of the session with this seed: the environment goes on drawing where it was, and the model looks back."""
        index = len(self.episodes)
        observation, self._facts = self.env.reset(seed=None if index else seed)
        goes_on = index > 0 and not self._trial.forget
        if self._goal_columns or (self._trial.warm_start and not goes_on):
            self.broker.session.close()
            self.broker = ChunkBroker(self._open(_model_seed(seed, index)))
        else:
            self.broker.reset(_model_seed(seed, index), keep_history=goes_on)
        self.state = np.asarray(observation, np.float32)
        self.episodes.append(Episode(seed, index=index, goal=environments.goal(self.env)))

    def observation(self) -> Observation:
        """What the act that is due has to tell."""
        session = self.broker.session
        return self.broker.observation(self.state, context=true_context(self.env, self._facts, session.model, session.options))

    def accept(self, chunk: Chunk) -> None:
        """The answer of the act that was due."""
        self.broker.accept(chunk)
        self.episode.act_steps.append(len(self.episode.rewards))
        self.episode.latents.append(chunk.latent_mean)
        if chunk.planned_states is not None and len(chunk.planned_states):
            self.episode.plans.append(chunk.planned_states)

    def step(self) -> None:
        """Executes the next action of the chunk and reports what came of it."""
        action = self.broker.take(self.state)
        observation, reward, terminated, truncated, self._facts = self.env.step(action)
        self.broker.report(reward=None if self._trial.withhold_rewards else float(reward))
        self.episode.states.append(self.state)
        self.episode.actions.append(action)
        self.episode.rewards.append(float(reward))
        if "context" in self._facts:
            self.episode.contexts.append(np.atleast_1d(np.asarray(self._facts["context"], np.float32)).copy())
        self.state = np.asarray(observation, np.float32)
        if terminated or truncated:
            self.episode.failed = environments.failed(self.env, self.episode.total)
            self.episode.measures = environments.measures(self.env, self.episode.total)
            self.done = len(self.episodes) == self._length
            if not self.done:
                self._begin(self.episode.seed)


def _model_seed(seed: int, index: int) -> int:
    """Of an episode in the session with this seed: its own noise in each, and the same in each run."""
    return int(np.random.SeedSequence([seed, index]).generate_state(1)[0]) if index else seed


def _open_lanes(client: Client, trial: Trial, stack: ExitStack) -> list[_Lane]:
    lanes = []
    for seed, _ in trial.sessions[: trial.vector]:
        env = environments.make(trial.env, episode_steps=trial.episode_steps, **trial.env_options)
        stack.callback(env.close)
        lane = stack.enter_context(_Lane(client, trial, env, seed))
        _check_fit(trial.env, env, lane.broker.session.model)
        lanes.append(lane)
    return lanes


def check(client: Client, trial: Trial) -> int:
    """What can be known before an episode is run: environment, model and options are there, and fit. Raises as `evaluate` does.

    Returns the steps of an episode at most.
    """
    env = environments.make(trial.env, episode_steps=trial.episode_steps, **trial.env_options)
    with closing(env), _Lane(client, trial, env, trial.seed) as lane:
        session = lane.broker.session
        _check_fit(trial.env, env, session.model)
        true_context(env, env.reset(seed=trial.seed)[1] if session.model.context else {}, session.model, session.options)
        if trial.session_episodes > 1 and not trial.forget:
            session.reset(trial.seed, keep_history=True)  # refused where the model was trained on episodes one by one
        return environments.steps_max(env)


def _check_fit(name: str, env: gymnasium.Env[Any, Any], model: Model) -> None:
    wanted = (model.state_dim, model.action_dim)
    offered = (env.observation_space.shape[0], env.action_space.shape[0])
    if wanted != offered:
        raise ValueError(
            f"{name} has {offered[0]} state and {offered[1]} action values, but model {model.name} has {wanted[0]} and {wanted[1]}"
        )


def _run(client: Client, trial: Trial, lanes: list[_Lane], acts: ActLog, progress: Progress) -> None:
    while running := [lane for lane in lanes if not lane.done]:
        due = [lane for lane in running if lane.broker.due]
        if due:
            _act(client, trial, due, acts)
        for lane in running:
            lane.step()
        progress(len(running))


def _act(client: Client, trial: Trial, due: list[_Lane], acts: ActLog) -> None:
    asked = [(lane.broker.session, lane.observation()) for lane in due]
    started = time.perf_counter()
    if trial.vector > 1:
        answers = client.act_batch(asked, planned_states=trial.planned_states)
    else:
        how = {"planned_states": trial.planned_states}
        answers = [
            session.act(seen.state, seen.executed, nothing_executed=seen.nothing_executed, context=seen.context, **how)
            for session, seen in asked
        ]
    elapsed_s = time.perf_counter() - started
    chunks = []
    for lane, answer in zip(due, answers, strict=True):
        if isinstance(answer, AdaError):
            raise answer
        lane.accept(answer)
        chunks.append(answer)
    acts.add(elapsed_s, chunks)
