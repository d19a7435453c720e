"""What a user asks of a source."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Request:
    """Where the data are, and what is to be made of them.

    Attributes:
        source: a file, a folder, or the id of a Minari data set.
        format: `d4rl`, `minari` or `robomimic`; None: as the source shows.
        observation: names of the parts that the agent is to see, in this order; empty: the source's observations, if they are one vector.
        context: names of the parts that it is not to see, and that are the hidden truth; empty: `infos/context`, where there is one.
        filter: mask of a robomimic file, whose demonstrations alone are taken.
        episode_steps: where the clock ended episodes, for a D4RL file that does not say it.
        zero_rewards: write zeros for rewards, whatever the source has.
    """

    source: str
    format: str | None = None
    observation: tuple[str, ...] = ()
    context: tuple[str, ...] = ()
    filter: str | None = None
    episode_steps: int | None = None
    zero_rewards: bool = False
