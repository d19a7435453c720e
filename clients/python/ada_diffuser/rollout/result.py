"""What a rollout is asked for, and what it brings back."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ada_diffuser.messages import Chunk, Model, SamplerOptions, Timings


@dataclass(frozen=True)
class Trial:
    """Which episodes, and how they are sampled. The same trial gives the same returns."""

    #: Short name, Gymnasium id, or `MODULE:ID`.
    env: str
    #: `name` or `name@digest`; empty: the server's default model.
    model: str = ""
    episodes: int = 10
    #: Episode `e` runs with seed `seed + e`, of the environment and of the model: all models see the same episodes.
    seed: int = 0
    #: Episodes that step side by side with one ActBatch a step; 1: one after the other, by Act.
    vector: int = 1
    #: Overrides of the model's sampling defaults.
    options: SamplerOptions = field(default_factory=SamplerOptions)
    #: Where episodes are truncated; None: where the environment is registered to be.
    episode_steps: int | None = None
    #: Whether the agent is told no reward, as where nobody measures it.
    withhold_rewards: bool = False

    def __post_init__(self) -> None:
        if self.episodes < 1 or self.vector < 1 or self.seed < 0:
            raise ValueError("episodes and vector must be at least 1, and the seed at least 0")


@dataclass(eq=False)
class Episode:
    """One episode; lists grow step by step, with the states that the agent saw and the actions it took."""

    seed: int
    states: list[NDArray[np.float32]] = field(default_factory=list)
    actions: list[NDArray[np.float32]] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    #: True hidden context while the action was executed; empty where the environment tells none.
    contexts: list[NDArray[np.float32]] = field(default_factory=list)
    #: Environment steps at which the server acted, and the latent mean that it answered there.
    act_steps: list[int] = field(default_factory=list)
    latents: list[NDArray[np.float32]] = field(default_factory=list)
    failed: bool = False

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

    def add(self, elapsed_s: float, chunks: list[Chunk]) -> None:
        """One call and its answers. A replay spends nothing: its evaluations were those of the call that was lost."""
        self.call_ms.append(elapsed_s * 1000)
        self.acts += len(chunks)
        self.replayed += sum(chunk.replayed for chunk in chunks)
        self.evaluations += sum(chunk.evaluations for chunk in chunks)
        self.timings.extend(chunk.timings for chunk in chunks)

    def joined(self, more: ActLog) -> ActLog:
        """Both together, as a new one."""
        return ActLog(
            self.call_ms + more.call_ms,
            self.acts + more.acts,
            self.replayed + more.replayed,
            self.evaluations + more.evaluations,
            self.timings + more.timings,
        )


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
        if more.trial.seed != self.trial.seed + len(self.episodes) or more.options != self.options:
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
        """Of the mean; 0 for a single episode, which says nothing about the spread."""
        return float(self.returns.std(ddof=1) / np.sqrt(len(self.returns))) if len(self.returns) > 1 else 0.0

    @property
    def median_return(self) -> float:
        return float(np.median(self.returns))

    @property
    def failures(self) -> int:
        """Episodes that the environment calls failed."""
        return sum(episode.failed for episode in self.episodes)

    @property
    def evaluations_per_act(self) -> float:
        return self.acts.evaluations / max(1, self.acts.acts)

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
            "model": self.model.name,
            "model_digest": self.model.digest,
            "seed": self.trial.seed,
            "vector": self.trial.vector,
            "withhold_rewards": self.trial.withhold_rewards,
            "options": plain_options(asdict(self.options)),
            "returns": [round(value, 6) for value in self.returns.tolist()],
            "failed_seeds": [episode.seed for episode in self.episodes if episode.failed],
            "mean_return": round(self.mean_return, 6),
            "standard_error": round(self.standard_error, 6),
            "median_return": round(self.median_return, 6),
            "failures": self.failures,
            "acts": self.acts.acts,
            "replayed": self.acts.replayed,
            "evaluations_per_act": self.evaluations_per_act,
            "latency_ms": {"p50": self.latency_ms(50), "p99": self.latency_ms(99)},
            "server_ms": {
                part: {"p50": self.server_ms(part, 50), "p99": self.server_ms(part, 99)} for part in ("queue", "compute", "commit", "total")
            },
            "wall_s": self.wall_s,
        }


def plain_options(options: dict[str, Any]) -> dict[str, Any]:
    """Sampling options for JSON, which has no infinity; the REST face spells it as a word too."""
    return {name: "infinity" if value == float("inf") else value for name, value in options.items()}
