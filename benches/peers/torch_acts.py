"""A whole act as a user would write it in PyTorch: the same networks with the same weights, the same way down the ladder of levels, as a
plain function without a server around it. Led by the gradient of a value network, told a return, or the best of many candidates:

    python torch_acts.py --model DIR --set guidance_scale=1.5
    python torch_acts.py --model DIR --set told_return=1 --set free_guidance_scale=1.2
    python torch_acts.py --model DIR --set candidates=64

Prints one JSON line per mode (eager, jit, compile; each with oneDNN and without it) with the median milliseconds of an act, and the action
and the value of an act without noise, which must be ours (compare.py holds them together). DIR is a checkpoint of ours without latents
(examples/make_random.rs).

To the peer's favour: all that depends on the ladder alone is computed once and not for each act (levels, their sinusoids, jumps), and the
value of a guided plan is not computed.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch_denoisers import MODES, ResBlock, TemporalUNet, sinusoid, time_embedding, way_down

EMB, LEVEL, TOLD_HIDDEN = 32, 16, 128


class Denoiser(TemporalUNet):
    """The U-Net over a window and the sinusoids of its levels and their mean, with the linear skip and the embedding of what is told."""

    def __init__(self, columns: int, widths: list[int], told: int) -> None:
        super().__init__(columns + LEVEL, columns, widths)
        self.input_skip = nn.Linear(columns + LEVEL, columns)
        if told:
            self.told = nn.Sequential(nn.Linear(told + 1, TOLD_HIDDEN), nn.SiLU(), nn.Linear(TOLD_HIDDEN, EMB))

    def forward(self, x: Tensor, channels: Tensor, mean: Tensor, told: Tensor | None = None) -> Tensor:
        x, e = torch.cat([x, channels.expand(len(x), -1, -1)], -1), self.time(mean)
        return self.run(x, e if told is None else e + self.told(told)) + self.input_skip(x)


class Value(nn.Module):
    """Half a U-Net; what it finds stands beside the window itself."""

    def __init__(self, columns: int, horizon: int, widths: list[int]) -> None:
        super().__init__()
        self.time, self.down, self.mid = time_embedding(EMB), way_down(columns + LEVEL, widths, EMB), ResBlock(widths[-1], widths[-1], EMB)
        steps = horizon
        for _ in widths[1:]:
            steps = (steps + 1) // 2
        found = steps * widths[-1]
        self.out = nn.Sequential(nn.Linear(found + horizon * columns + EMB, found // 2), nn.Mish(), nn.Linear(found // 2, 1))

    def forward(self, x: Tensor, channels: Tensor, mean: Tensor) -> Tensor:
        e = self.time(mean)
        h = torch.cat([x, channels.expand(len(x), -1, -1)], -1).transpose(1, 2)
        for first, second, halve in self.down:
            h = halve(second(first(h, e), e))
        found = self.mid(h, e).transpose(1, 2).flatten(1)
        return self.out(torch.cat([found, x.flatten(1), e.expand(len(x), -1)], 1))


@dataclass(frozen=True)
class Options:
    """How an act is sampled, by our names."""

    temperature: float = 0.5
    guidance_scale: float = 0.0
    told_return: float | None = None
    free_guidance_scale: float = 1.0
    candidates: int = 1


class Ladder:
    """What each row of the table of levels is, one entry a position: sinusoids of the levels, the jump to the row below (eta 0, as shares
    of the estimate and of the window), and how far a gradient leads."""

    def __init__(self, horizon: int, level_max: int, scale: float) -> None:
        def level(row: int, position: int) -> int:
            fine = min(max(horizon + position - row, 0), horizon)
            return (2 * fine * level_max + horizon) // (2 * horizon)

        alpha_bar = alphas(level_max)
        levels = torch.tensor([[level(row, position) for position in range(horizon)] for row in range(horizon + 1)])
        now, then = alpha_bar[levels[:-1]][..., None], alpha_bar[levels[1:]][..., None]
        on_x, stays = ((1 - then) / (1 - now)).sqrt(), now == then
        on_x0 = torch.where(stays, 0.0, then.sqrt() - on_x * now.sqrt()).float()
        on_x, lead = torch.where(stays, 1.0, on_x).float(), (scale * (1 - now)).float()
        channels, mean = sinusoid(levels[:-1], LEVEL), sinusoid(levels[:-1].float().mean(1), EMB)
        self.rows = [tuple(part[row : row + 1] for part in (channels, mean, on_x0, on_x, lead)) for row in range(horizon)]
        self.clean = sinusoid(levels[-1:] * 0, LEVEL), sinusoid(torch.zeros(1), EMB)


def alphas(level_max: int) -> Tensor:
    """Cumulative alphas of the cosine schedule (Nichol and Dhariwal 2021), from clean to noise."""
    f = [math.cos((k / level_max + 0.008) / 1.008 * math.pi / 2) ** 2 for k in range(level_max + 1)]
    kept = [1.0, *(max(b / a, 0.001) for a, b in pairwise(f))]
    return torch.cumprod(torch.tensor(kept, dtype=torch.float64), 0)


class Step(nn.Module):
    """One row down: the window and its clean estimate."""

    def __init__(self, config: dict[str, Any], weights: dict[str, Tensor], options: Options) -> None:
        super().__init__()
        method, layout, units = config["method"], config["layout"], config["units"]
        plan, told = method["plan"], [options.told_return] if options.told_return is not None else []
        self.state, columns = layout["state_dim"], layout["state_dim"] + layout["action_dim"]
        self.denoiser = loaded(Denoiser(columns, plan["backbone"]["widths"], len(told)), weights, "denoiser.")
        if guide := method.get("guide"):
            self.value = loaded(Value(columns, plan["horizon"], guide["widths"]), weights, "guide.")
        high = torch.tensor([plan["clip"]] * self.state + units["action_high"])
        low = torch.tensor([-plan["clip"]] * self.state + units["action_low"])
        known = torch.zeros(plan["horizon"], columns, dtype=torch.bool)
        known[0, : self.state] = True
        both = torch.tensor([[*told, 1.0], [0.0] * (len(told) + 1)])
        for name, tensor in (("high", high), ("low", low), ("known", known), ("told", both)):
            self.register_buffer(name, tensor)
        self.is_led, self.beyond = options.guidance_scale > 0, options.free_guidance_scale if told else None

    def gradient(self, x: Tensor, channels: Tensor, mean: Tensor) -> Tensor:
        """Of the value to the window."""
        if torch.compiler.is_compiling():
            return torch.func.grad(lambda x: self.value(x, channels, mean).sum())(x)
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            return torch.autograd.grad(self.value(x, channels, mean).sum(), x)[0]

    def forward(self, x: Tensor, seen: Tensor, *row: Tensor) -> tuple[Tensor, Tensor]:
        channels, mean, on_x0, on_x, lead = row
        if self.beyond is None:
            x0 = self.denoiser(x, channels, mean)
        else:
            with_it, without = self.denoiser(torch.cat([x, x]), channels, mean, self.told).chunk(2)
            x0 = torch.lerp(without, with_it, self.beyond)
        if self.is_led:
            gradient = self.gradient(x, channels, mean).masked_fill(self.known, 0.0)
            x0 = x0 + lead * gradient / gradient.norm(dim=-1, keepdim=True).clamp(min=1.0)
        x0 = torch.clamp(x0, self.low, self.high)
        return torch.where(self.known, seen, on_x0 * x0 + on_x * x), x0


def loaded(net: nn.Module, weights: dict[str, Tensor], scope: str) -> Any:
    """The network with its part of a checkpoint, whose names are PyTorch's."""
    net.load_state_dict({name.removeprefix(scope): value for name, value in weights.items() if name.startswith(scope)})
    return net.eval().requires_grad_(False)


class Sampler:
    """Acts in one mode."""

    def __init__(self, model: Path, options: Options, mode: Mode) -> None:
        config = json.loads((model / "config.json").read_text())
        plan, self.options = config["method"]["plan"], options
        self.step = Step(config, load_file(model / "model.safetensors"), options).eval()
        self.state, self.shape = self.step.state, (options.candidates, plan["horizon"], len(self.step.high))
        self.ladder = Ladder(plan["horizon"], plan["level_max"], options.guidance_scale)
        self.judge = mode.of(self.step.value, (torch.randn(self.shape), *self.ladder.clean)) if options.candidates > 1 else None
        self.run = self.in_mode(mode)

    def in_mode(self, mode: Mode) -> Callable[..., tuple[Tensor, Tensor]]:
        """A row down as PyTorch runs it fastest in this mode."""
        step, x = self.step, torch.randn(self.shape)
        if not step.is_led or mode.way == mode.back == "compile":
            return mode.of(step, (x, x[0], *self.ladder.rows[0]))
        # No trace knows of gradients, and nothing frozen has a way back: each network by itself.
        example = (x, *self.ladder.rows[0][:2])
        step.denoiser = mode.of(step.denoiser, example)
        if mode.back == "jit":
            step.value = torch.jit.trace(step.value, example)
        if mode.back == "compile":
            step.gradient = torch.compile(step.gradient, mode="max-autotune")
        return step

    def act(self, state: Tensor, temperature: float) -> tuple[Tensor, Tensor | None]:
        """The action, and what its plan is worth if it was chosen among several."""
        x = temperature * torch.randn(self.shape)
        seen = torch.zeros(self.shape[1:])
        seen[0, : self.state] = state
        x[:, 0, : self.state] = state
        x0 = x
        for row in self.ladder.rows:
            x, x0 = self.run(x, seen, *row)
        if self.judge is None:
            return x[0, 0, self.state :], None
        plans = torch.cat([x[:, :1], x0[:, 1:]], 1)
        values = self.judge(plans, *self.ladder.clean)[:, 0]
        best = values.argmax()
        return x[best, 0, self.state :], values[best]


@dataclass(frozen=True)
class Mode:
    """One way to run networks."""

    way: str
    # The same of a gradient.
    back: str
    # Whether with oneDNN's convolutions, PyTorch's default: the best for many windows, and the worst for two.
    onednn: bool

    def name(self) -> str:
        """In words."""
        return self.way + (f", gradient {self.back}" if self.back != self.way else "") + ("" if self.onednn else ", no oneDNN")

    def of(self, net: nn.Module, example: tuple[Tensor, ...]) -> Any:
        """The network as PyTorch runs it fastest, without a way back."""
        if self.way == "compile":
            return torch.compile(net, mode="max-autotune")
        if self.way == "jit":
            net = torch.jit.freeze(torch.jit.trace(net, example))
            return torch.jit.optimize_for_inference(net) if self.onednn else net
        return net


def modes(ways: list[str], is_led: bool) -> list[Mode]:
    """Each of them, and of an act with gradients jit and compile together."""
    pairs = [(way, way) for way in ways]
    if is_led and {"jit", "compile"} <= set(ways):
        pairs.append(("jit", "compile"))
    return [Mode(way, back, onednn) for way, back in pairs for onednn in (True, False)]


def median_ms(run: Callable[[], object], seconds: float) -> float:
    """Median time of one call in so many seconds, after a few that do not count; of five at least."""
    for _ in range(3):
        run()
    times: list[float] = []
    begin = time.perf_counter()
    while time.perf_counter() - begin < seconds or len(times) < 5:
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return round(sorted(times)[len(times) // 2] * 1e3, 4)


def time_acts(make: Callable[[Mode], Any], mode: Mode, temperature: float, is_led: bool, seconds: float) -> dict[str, object]:
    """What one mode takes, or why it cannot run (no C++ compiler, say)."""
    torch.compiler.reset()
    # Inference mode lets nobody have gradients, inside of it neither.
    without_gradients = torch.no_grad() if is_led else torch.inference_mode()
    try:
        with torch.backends.mkldnn.flags(enabled=mode.onednn), without_gradients:
            sampler = make(mode)
            state = torch.arange(sampler.state).float().sin()
            action, value = sampler.act(state, 0.0)
            line = {"action": action.tolist(), "value": None if value is None else value.item()}
            return {"mode": mode.name(), "ms": median_ms(lambda: sampler.act(state, temperature), seconds), **line}
    except Exception as error:
        return {"mode": mode.name(), "error": str(error)[:200]}


def main(about: str | None, sampler: Callable[[Path, Any, Mode], Any], options_of: Callable[..., Any]) -> None:
    """Entry point of each program that times acts: `sampler` makes one that acts in a mode, of a checkpoint and its options."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, required=True, metavar="DIR")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--modes", default=",".join(MODES), help="which modes run (default %(default)s)")
    a = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(a.threads)
    options = options_of(**{key: json.loads(value) for key, value in (setting.split("=") for setting in a.settings)})
    is_led = getattr(options, "guidance_scale", 0.0) > 0
    for mode in modes(a.modes.split(","), is_led):
        line = time_acts(lambda mode: sampler(a.model, options, mode), mode, options.temperature, is_led, a.seconds)
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main(__doc__, Sampler, Options)
