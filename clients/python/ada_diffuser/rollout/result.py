"""What a rollout is asked for, and what it brings back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ada_diffuser.messages import Chunk, Executed, Model, SamplerOptions, Timings
from ada_diffuser.rollout.warm_start import WarmStart


@dataclass(frozen=True)
class Trial:
    """Which episodes, and how they are sampled. The same trial gives the same returns."""

    #: Short name, Gymnasium id, or `MODULE:ID`.
    env: str
    #: `name` or `name@digest`; empty: the server's default model.
    model: str = ""
    episodes: int = 10
    #: Session `k` runs with seed `seed + k`, of the environment and of the model: all models see the same episodes.
    seed: int = 0
    #: Sessions that step side by side with one ActBatch a step; 1: one after the other, by Act.
    vector: int = 1
    #: Overrides of the model's sampling defaults.
    options: SamplerOptions = field(default_factory=SamplerOptions)
    #: Where episodes are truncated; None: where the environment is registered to be.
    episode_steps: int | None = None
    #: Whether the agent is told no reward, as where nobody measures it.
    withhold_rewards: bool = False
    #: Episodes of a session, over which what is hidden may last: the environment is given no seed between them, and the model keeps its
    #: history. The last session has what is left.
    session_episodes: int = 1
    #: Whether the model forgets its history between them all the same.
    forget: bool = False
    #: Keyword arguments of the environment.
    env_options: Mapping[str, Any] = field(default_factory=dict, hash=False)
    #: Whether each act tells the states that it plans.
    planned_states: bool = False
    #: What each session is opened with; where the model forgets, each episode.
    warm_start: WarmStart | None = None

    def __post_init__(self) -> None:
        if self.episodes < 1 or self.vector < 1 or self.session_episodes < 1 or self.seed < 0:
            raise ValueError("episodes, vector and session_episodes must be at least 1, and the seed at least 0")

    def env_options_as_json(self) -> dict[str, Any]:
        """Nothing where there are none."""
        return {"env_options": dict(self.env_options)} if self.env_options else {}

    @property
    def history(self) -> tuple[Executed, ...]:
        """The warm start as a session is told it."""
        steps = self.warm_start.steps if self.warm_start else ()
        return tuple(replace(step, reward=None) for step in steps) if self.withhold_rewards else steps

    @property
    def sessions(self) -> list[tuple[int, int]]:
        """Seed and number of episodes of each."""
        firsts = range(0, self.episodes, self.session_episodes)
        return [(self.seed + k, min(self.session_episodes, self.episodes - first)) for k, first in enumerate(firsts)]


@dataclass(eq=False)
class Episode:
    """One episode; lists grow step by step, with the states that the agent saw and the actions it took."""

    #: Of its session.
    seed: int
    states: list[NDArray[np.float32]] = field(default_factory=list)
    actions: list[NDArray[np.float32]] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    #: True hidden context while the action was executed; empty where the environment tells none.
    contexts: list[NDArray[np.float32]] = field(default_factory=list)
    #: Environment steps at which the server acted, and the latent mean that it answered there.
    act_steps: list[int] = field(default_factory=list)
    latents: list[NDArray[np.float32]] = field(default_factory=list)
    #: States that each act planned, from the one after its chunk on, `(plan_horizon - 1, state_dim)`; where the trial asks for them.
    plans: list[NDArray[np.float32]] = field(default_factory=list)
    failed: bool = False
    #: What the environment says of it beside its return, by name.
    measures: dict[str, float] = field(default_factory=dict)
    #: What was wanted, where the environment has a goal.
    goal: NDArray[np.float32] | None = None
    #: Its place in the session, from 0.
    index: int = 0

    @property
    def total(self) -> float:
        """Sum of the rewards."""
        return float(np.sum(self.rewards))


@dataclass(eq=False)
class ActLog:
    """What the acts cost. A batch counts as one call, and each of its acts waits for all of it."""

    call_ms: list[float] = field(default_factory=list)
    #: Acts answered, replays among them.
    acts: int = 0
    replayed: int = 0
    evaluations: int = 0
    timings: list[Timings] = field(default_factory=list)
    #: Forwards that acts waited for, one after the other.
    passes: int = 0
    #: What the guide held each plan to be worth that it led or chose.
    values: list[float] = field(default_factory=list)

    def add(self, elapsed_s: float, chunks: list[Chunk]) -> None:
        """One call and its answers. A replay spends nothing: its evaluations were those of the call that was lost."""
        self.call_ms.append(elapsed_s * 1000)
        self.acts += len(chunks)
        self.replayed += sum(chunk.replayed for chunk in chunks)
        self.evaluations += sum(chunk.evaluations for chunk in chunks)
        self.timings.extend(chunk.timings for chunk in chunks)
        self.passes += sum(chunk.passes for chunk in chunks)
        self.values.extend(chunk.value for chunk in chunks if chunk.value is not None)

    def joined(self, more: ActLog) -> ActLog:
        """Both together, as a new one."""
        return ActLog(
            self.call_ms + more.call_ms,
            self.acts + more.acts,
            self.replayed + more.replayed,
            self.evaluations + more.evaluations,
            self.timings + more.timings,
            self.passes + more.passes,
            self.values + more.values,
        )


@dataclass(frozen=True)
class IndexReturn:
    """What the episodes with one place in their sessions earned."""

    index: int
    #: How many, each of another session.
    sessions: int
    mean_return: float
    #: Of the mean, over sessions.
    standard_error: float
    failures: int


@dataclass(frozen=True)
class Measure:
    """Something that the environment says of each episode beside its return: a score, whether it got where it should."""

    mean: float
    #: Of the mean, over sessions.
    standard_error: float
    #: Of each episode.
    values: list[float]

    @classmethod
    def of(cls, sessions: Sequence[Sequence[float]]) -> Measure:
        """From the numbers of the episodes of each session."""
        mean, error = mean_and_error([np.array(session) for session in sessions])
        return cls(mean, error, [value for session in sessions for value in session])

    def as_json(self) -> dict[str, Any]:
        return {
            "mean": round(self.mean, 6),
            "standard_error": round(self.standard_error, 6),
            "values": [round(value, 6) for value in self.values],
        }


def mean_and_error(groups: Sequence[NDArray[np.float64]]) -> tuple[float, float]:
    """The mean of all numbers, and its standard error over the groups (sessions), which need not have equally many.

    0 for a single group, which says nothing of the spread.
    """
    counts, sums = np.array([len(group) for group in groups]), np.array([group.sum() for group in groups])
    mean, n = float(sums.sum() / counts.sum()), len(groups)
    return mean, float(np.sqrt(n / (n - 1) * np.sum((sums - mean * counts) ** 2)) / counts.sum()) if n > 1 else 0.0


def by_session(episodes: Sequence[Episode]) -> list[list[Episode]]:
    """Those that follow one another together, in order."""
    sessions: list[list[Episode]] = []
    for episode in episodes:
        if episode.index == 0 or not sessions:
            sessions.append([])
        sessions[-1].append(episode)
    return sessions


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A finished trial."""

    trial: Trial
    #: The model that acted, by its full identity.
    model: Model
    #: Sampling options that were in force.
    options: SamplerOptions
    episodes: list[Episode]
    acts: ActLog
    wall_s: float

    def joined(self, more: Evaluation) -> Evaluation:
        """These episodes and those of `more`, which go on where these end: what one trial of all of them would have brought."""
        if more.trial.seed != self.trial.seed + len(self.trial.sessions) or more.options != self.options:
            raise ValueError("only episodes with the next seeds and the same options can be joined")
        episodes = self.episodes + more.episodes
        trial = replace(self.trial, episodes=len(episodes))
        return replace(self, trial=trial, episodes=episodes, acts=self.acts.joined(more.acts), wall_s=self.wall_s + more.wall_s)

    @property
    def returns(self) -> NDArray[np.float64]:
        """Return of each episode, `(episodes,)`."""
        return np.array([episode.total for episode in self.episodes])

    @property
    def mean_return(self) -> float:
        return float(self.returns.mean())

    @property
    def standard_error(self) -> float:
        """Of the mean, over sessions, since the episodes of one are alike; 0 for a single one, which says nothing about the spread."""
        return mean_and_error([np.array([episode.total for episode in session]) for session in by_session(self.episodes)])[1]

    @property
    def median_return(self) -> float:
        return float(np.median(self.returns))

    @property
    def failures(self) -> int:
        """Episodes that the environment calls failed."""
        return sum(episode.failed for episode in self.episodes)

    @property
    def measures(self) -> dict[str, Measure]:
        """What the environment says beside the returns, by name; empty where it says nothing."""
        names = self.episodes[0].measures
        return {name: Measure.of([[one.measures[name] for one in session] for session in by_session(self.episodes)]) for name in names}

    @property
    def by_index(self) -> list[IndexReturn]:
        """Returns by the episode's place in its session."""
        found = []
        for index in sorted({episode.index for episode in self.episodes}):
            placed = [episode for episode in self.episodes if episode.index == index]
            mean, error = mean_and_error([np.array([episode.total]) for episode in placed])
            found.append(IndexReturn(index, len(placed), mean, error, sum(episode.failed for episode in placed)))
        return found

    @property
    def evaluations_per_act(self) -> float:
        return self.acts.evaluations / max(1, self.acts.acts)

    @property
    def passes_per_act(self) -> float:
        return self.acts.passes / max(1, self.acts.acts)

    @property
    def mean_value(self) -> float | None:
        """What the guide held the plans to be worth; None where it was not asked."""
        return float(np.mean(self.acts.values)) if self.acts.values else None

    def latency_ms(self, percentile: float) -> float:
        """Of a call (an act, or a batch of them), as the client saw it."""
        return float(np.percentile(self.acts.call_ms, percentile))

    def server_ms(self, part: str, percentile: float) -> float:
        """Of one part of the server's own timings (`queue`, `compute`, `commit`, `total`)."""
        return float(np.percentile([getattr(timing, f"{part}_us") / 1000 for timing in self.acts.timings], percentile))

    def as_json(self) -> dict[str, Any]:
        """Everything that a report needs, per-episode returns included."""
        return {
            "env": self.trial.env,
            **self.trial.env_options_as_json(),
            "model": self.model.name,
            "model_digest": self.model.digest,
            "seed": self.trial.seed,
            "vector": self.trial.vector,
            "withhold_rewards": self.trial.withhold_rewards,
            **({"warm_start": self.trial.warm_start.as_json()} if self.trial.warm_start else {}),
            "options": plain_options(self.options.given()),
            "returns": [round(value, 6) for value in self.returns.tolist()],
            "failed_seeds": [episode.seed for episode in self.episodes if episode.failed],
            "mean_return": round(self.mean_return, 6),
            "standard_error": round(self.standard_error, 6),
            "median_return": round(self.median_return, 6),
            "failures": self.failures,
            **measures_as_json(self.measures),
            "acts": self.acts.acts,
            "replayed": self.acts.replayed,
            "evaluations_per_act": self.evaluations_per_act,
            "passes_per_act": self.passes_per_act,
            **({} if self.mean_value is None else {"mean_value": round(self.mean_value, 6)}),
            "latency_ms": {"p50": self.latency_ms(50), "p99": self.latency_ms(99)},
            "server_ms": {
                part: {"p50": self.server_ms(part, 50), "p99": self.server_ms(part, 99)} for part in ("queue", "compute", "commit", "total")
            },
            "wall_s": self.wall_s,
            **(self._sessions_as_json() if self.trial.session_episodes > 1 else {}),
        }

    def _sessions_as_json(self) -> dict[str, Any]:
        return {
            "session_episodes": self.trial.session_episodes,
            "keep_history": not self.trial.forget,
            "by_episode": [
                {
                    "episode": one.index,
                    "sessions": one.sessions,
                    "mean_return": round(one.mean_return, 6),
                    "standard_error": round(one.standard_error, 6),
                    "failures": one.failures,
                }
                for one in self.by_index
            ],
        }


def measures_as_json(measures: Mapping[str, Measure]) -> dict[str, Any]:
    """Nothing where there are none."""
    return {"measures": {name: one.as_json() for name, one in measures.items()}} if measures else {}


def plain_options(options: dict[str, Any]) -> dict[str, Any]:
    """Sampling options for JSON, which has no infinity; the REST face spells it as a word too."""
    return {name: "infinity" if value == float("inf") else value for name, value in options.items()}
