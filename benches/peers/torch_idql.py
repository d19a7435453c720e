"""An act of IDQL as a user would write it in PyTorch: 64 candidates of five evaluations, of which two critics choose, as a plain
function without a server around it.

    python torch_idql.py --model DIR --set candidates=64

Prints one JSON line per mode with the median milliseconds of an act, and the action and the value of an act without noise, which must be
ours (compare.py holds them together). DIR is a checkpoint of ours without latents (`examples/make_random.rs --net idql`).

To the peer's favour: all that depends on the levels alone is computed once and not for each act, and what is seen is embedded once an act.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional
from torch_acts import LEVEL, TOLD_HIDDEN, Mode, loaded, main
from torch_denoisers import sinusoid

TIME, BETAS = 64, (0.1, 10.0)


@dataclass(frozen=True)
class Options:
    """How an act is sampled, by our names."""

    temperature: float = 1.0
    candidates: int = 64


class Actor(nn.Module):
    """Residual blocks over a noisy action and the sinusoid of its level."""

    def __init__(self, action: int, seen: int, width: int, depth: int) -> None:
        super().__init__()
        self.time = nn.Sequential(nn.Linear(TIME, 128), nn.Mish(), nn.Linear(128, width))
        self.input, self.out = nn.Linear(action + LEVEL, width), nn.Linear(width, action)
        block = {"norm": (width,), "0": (width, 4 * width), "2": (4 * width, width)}
        self.blocks = nn.ModuleList(
            nn.ModuleDict({name: nn.LayerNorm(*sizes, eps=1e-6) if name == "norm" else nn.Linear(*sizes) for name, sizes in block.items()})
            for _ in range(depth)
        )
        self.input_skip = nn.Linear(action + LEVEL, action)
        self.observed = nn.Sequential(nn.Linear(seen, TOLD_HIDDEN), nn.SiLU(), nn.Linear(TOLD_HIDDEN, width))

    def forward(self, x: Tensor, channels: Tensor, whole: Tensor) -> Tensor:
        x = torch.cat([x, channels.expand(len(x), -1)], -1)
        h = self.input(x) + whole
        for block in self.blocks:
            h = h + block["2"](functional.mish(block["0"](block["norm"](h))))
        return self.out(functional.mish(h)) + self.input_skip(x)


class Critic(nn.Module):
    """The lesser of two."""

    def __init__(self, state: int, action: int, width: int) -> None:
        super().__init__()

        def net() -> nn.Sequential:
            layers = [nn.Linear(state + action, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 1)]
            return nn.Sequential(*layers)

        self.q1, self.q2 = net(), net()

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        x = torch.cat([state.expand(len(action), -1), action], -1)
        return torch.minimum(self.q1(x), self.q2(x))[:, 0]


class Sampler:
    """Acts in one mode."""

    def __init__(self, model: Path, options: Options, mode: Mode) -> None:
        config, weights = json.loads((model / "config.json").read_text()), load_file(model / "model.safetensors")
        plan, layout, units = config["method"]["plan"], config["layout"], config["units"]
        self.state, self.action, self.count = layout["state_dim"], layout["action_dim"], options.candidates
        backbone = plan["backbone"]
        actor: Any = loaded(Actor(self.action, self.state + self.action + 1, backbone["width"], backbone["depth"]), weights, "denoiser.")
        named = {name: value for name, value in weights.items() if ".v." not in name}
        critic = loaded(Critic(self.state, self.action, config["method"]["guide"]["width"]), named, "critic.")
        self.low, self.high = torch.tensor(units["action_low"]), torch.tensor(units["action_high"])
        self.observed = actor.observed
        levels = plan["level_max"]
        self.rows = [self._row(level, levels, actor) for level in range(levels, 0, -1)]
        example = torch.randn(self.count, self.action)
        self.actor = mode.of(actor, (example, self.rows[0][0], torch.randn(1, backbone["width"])))
        self.critic = mode.of(critic, (torch.randn(1, self.state), example))

    @staticmethod
    def _row(level: int, levels: int, actor: Any) -> tuple[Tensor, Tensor, list[float]]:
        """Of one level: its channels, its embedding, and the jump to the one below as DDPM has it."""

        def alpha_bar(level: int) -> float:
            u = level / levels
            return math.exp(-BETAS[0] * u - (BETAS[1] - BETAS[0]) * u * u / 2)

        now, then = alpha_bar(level), alpha_bar(level - 1)
        noise = math.sqrt((1 - then) / (1 - now) * (1 - now / then))
        jump = [math.sqrt(now), math.sqrt(1 - now), math.sqrt(then), math.sqrt(max(1 - then - noise * noise, 0)), noise]
        at = torch.tensor([float(level)])
        return sinusoid(at, LEVEL), actor.time(sinusoid(at, TIME)), jump

    def act(self, state: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
        """The action, and what it is worth."""
        seen = self.observed(torch.cat([state, torch.zeros(self.action + 1)])[None])
        x = temperature * torch.randn(self.count, self.action)
        for channels, time, (signal, sigma, on_x0, on_eps, noise) in self.rows:
            x0 = torch.clamp((x - sigma * self.actor(x, channels, seen + time)) / signal, self.low, self.high)
            x = on_x0 * x0 + on_eps * (x - signal * x0) / sigma + noise * temperature * torch.randn_like(x)
        x = torch.clamp(x, self.low, self.high)
        values = self.critic(state[None], x)
        best = values.argmax()
        return x[best], values[best]


if __name__ == "__main__":
    main(__doc__, Sampler, Options)
