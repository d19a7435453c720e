"""The peer that a user would pick instead: the same denoisers in PyTorch, timed on this machine.

    python torch_denoisers.py time   --net unet --widths 32,64,64,64 --batch 1 --threads 1
    python torch_denoisers.py train  --net unet --widths 32,64,128,256 --batch 64 --threads 2
    python torch_denoisers.py golden --net unet --widths 16,32,32,32 --out golden.safetensors

`time` prints one JSON line per mode (eager, jit, compile) with the median milliseconds of a forward; hold our figure against the
smallest of them, taken in the same run on the same cores (compare.py does). `golden` writes weights, inputs and outputs for a parity
test. The networks have the sizes of src/model/denoiser: a noise level for each position, the latents as extra channels.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

MODES = ("eager", "jit", "compile")
# Of HalfCheetah: an action, a latent, the embedding of a level; a real step as a policy reads it.
ACTION, LATENT, LEVEL, READ = 6, 20, 16, 24


def sinusoid(k: Tensor, dim: int) -> Tensor:
    """Sinusoidal embedding of levels, `(...)` to `(..., dim)`."""
    half = dim // 2
    frequencies = torch.exp(torch.arange(half) * (-math.log(10000.0) / (half - 1)))
    angle = k[..., None].float() * frequencies
    return torch.cat([angle.sin(), angle.cos()], -1)


class ConvBlock(nn.Module):
    def __init__(self, c_in: int, c_out: int, kernel: int = 5, groups: int = 8) -> None:
        super().__init__()
        self.conv = nn.Conv1d(c_in, c_out, kernel, padding=kernel // 2)
        self.norm = nn.GroupNorm(min(groups, c_out), c_out)

    def forward(self, x: Tensor) -> Tensor:
        return functional.mish(self.norm(self.conv(x)))


class ResBlock(nn.Module):
    def __init__(self, c_in: int, c_out: int, emb: int) -> None:
        super().__init__()
        self.first, self.second = ConvBlock(c_in, c_out), ConvBlock(c_out, c_out)
        self.embed = nn.Linear(emb, c_out)
        self.skip = nn.Conv1d(c_in, c_out, 1) if c_in != c_out else nn.Identity()

    def forward(self, x: Tensor, e: Tensor) -> Tensor:
        h = self.first(x) + self.embed(functional.mish(e))[:, :, None]
        return self.second(h) + self.skip(x)


def way_down(d_in: int, widths: Sequence[int], emb: int) -> nn.ModuleList:
    """Two blocks a depth, then every other step, but for the deepest."""
    down = nn.ModuleList()
    for j, (a, b) in enumerate(pairwise([d_in, *widths])):
        halve = nn.Identity() if j == len(widths) - 1 else nn.Conv1d(b, b, 3, 2, 1)
        down.append(nn.ModuleList([ResBlock(a, b, emb), ResBlock(b, b, emb), halve]))
    return down


def time_embedding(emb: int) -> nn.Sequential:
    """Of a level's sinusoid."""
    return nn.Sequential(nn.Linear(emb, 4 * emb), nn.Mish(), nn.Linear(4 * emb, emb))


class TemporalUNet(nn.Module):
    """(B, T, d_in) -> (B, T, d_out); widths e.g. 32,64,64,64 (the paper's text) or 32,64,128,256 (the reference code's reading)."""

    def __init__(self, d_in: int, d_out: int, widths: Sequence[int], emb: int = 32) -> None:
        super().__init__()
        self.emb = emb
        self.time, self.down, self.up = time_embedding(emb), way_down(d_in, widths, emb), nn.ModuleList()
        dims = [d_in, *widths]
        self.mid1, self.mid2 = ResBlock(dims[-1], dims[-1], emb), ResBlock(dims[-1], dims[-1], emb)
        for a, b in reversed(list(pairwise(widths))):
            self.up.append(nn.ModuleList([ResBlock(2 * b, a, emb), ResBlock(a, a, emb), nn.ConvTranspose1d(a, a, 4, 2, 1)]))
        self.final1, self.final2 = ConvBlock(dims[1], dims[1]), nn.Conv1d(dims[1], d_out, 1)

    def forward(self, x: Tensor, levels: Tensor) -> Tensor:
        return self.run(x, self.time(sinusoid(levels.float().mean(1), self.emb)))

    def run(self, x: Tensor, e: Tensor) -> Tensor:
        """With the embedding of the mean level."""
        x, skips = x.transpose(1, 2), []
        for r1, r2, down in self.down:
            x = r2(r1(x, e), e)
            skips.append(x)
            x = down(x)
        x = self.mid2(self.mid1(x, e), e)
        for r1, r2, up in self.up:
            x = up(r2(r1(torch.cat([x, skips.pop()], 1), e), e))
        return self.final2(self.final1(x)).transpose(1, 2)


class DiTBlock(nn.Module):
    def __init__(self, d: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = (nn.LayerNorm(d, elementwise_affine=False, eps=1e-6) for _ in range(2))
        self.qkv, self.out, self.heads = nn.Linear(d, 3 * d), nn.Linear(d, d), heads
        self.mlp = nn.Sequential(nn.Linear(d, 4 * d), nn.GELU(approximate="tanh"), nn.Linear(4 * d, d))
        self.ada = nn.Linear(d, 6 * d)

    def forward(self, x: Tensor, c: Tensor) -> Tensor:
        s1, g1, o1, s2, g2, o2 = self.ada(functional.silu(c)).chunk(6, -1)
        b, t, d = x.shape
        q, k, v = self.qkv(self.norm1(x) * (1 + g1) + s1).view(b, t, 3, self.heads, d // self.heads).permute(2, 0, 3, 1, 4)
        x = x + o1 * self.out(functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(b, t, d))
        return x + o2 * self.mlp(self.norm2(x) * (1 + g2) + s2)


class DiT(nn.Module):
    """(B, T, d_in) -> (B, T, d_out), conditioning per token."""

    def __init__(self, d_in: int, d_out: int, d: int = 256, depth: int = 2) -> None:
        super().__init__()
        self.d, self.inp = d, nn.Linear(d_in, d)
        self.time = nn.Sequential(nn.Linear(d, d), nn.Mish(), nn.Linear(d, d))
        self.blocks = nn.ModuleList([DiTBlock(d, d // 32) for _ in range(depth)])
        self.norm, self.ada, self.out = nn.LayerNorm(d, elementwise_affine=False, eps=1e-6), nn.Linear(d, 2 * d), nn.Linear(d, d_out)

    def forward(self, x: Tensor, levels: Tensor) -> Tensor:
        c, x = self.time(sinusoid(levels, self.d)), self.inp(x)
        for block in self.blocks:
            x = block(x, c)
        shift, scale = self.ada(functional.silu(c)).chunk(2, -1)
        return self.out(self.norm(x) * (1 + scale) + shift)


class Policy(nn.Module):
    """The transformer of diffusion policy (Chi et al. 2023), (B, T, d_in) -> (B, T, d_out), that reads the mean level and one real step."""

    def __init__(self, d_in: int, d_out: int, horizon: int, batch: int, d: int = 256, depth: int = 2) -> None:
        super().__init__()
        self.d, self.inp, self.read = d, nn.Linear(d_in, d), nn.Linear(READ, d)
        self.places, self.read_places = nn.Parameter(torch.randn(1, horizon, d)), nn.Parameter(torch.randn(1, 2, d))
        self.encoder = nn.Sequential(nn.Linear(d, 4 * d), nn.Mish(), nn.Linear(4 * d, d))
        layer = nn.TransformerDecoderLayer(d, d // 32, 4 * d, 0.0, "gelu", batch_first=True, norm_first=True)
        self.decoder = nn.TransformerDecoder(layer, depth)
        self.norm, self.out = nn.LayerNorm(d), nn.Linear(d, d_out)
        self.register_buffer("seen", torch.randn(batch, 1, READ))
        self.register_buffer("mask", nn.Transformer.generate_square_subsequent_mask(horizon))

    def forward(self, x: Tensor, levels: Tensor) -> Tensor:
        read = torch.cat([sinusoid(levels.float().mean(1), self.d)[:, None], self.read(self.seen)], 1) + self.read_places
        h = self.decoder(self.inp(x) + self.places, self.encoder(read), tgt_mask=self.mask, tgt_is_causal=True)
        return self.out(self.norm(h))


def network(a: argparse.Namespace) -> tuple[nn.Module, int, int]:
    """That which is asked for, and what goes in and out."""
    if a.net == "dp":
        d_in = ACTION + LATENT + LEVEL
        return Policy(d_in, ACTION, a.len, a.batch), d_in, ACTION
    if a.net == "dit":
        return DiT(a.d_in, a.d_out), a.d_in, a.d_out
    return TemporalUNet(a.d_in, a.d_out, [int(width) for width in a.widths.split(",")]), a.d_in, a.d_out


def median_ms(run: Callable[[], object], runs: int, warm: int) -> float:
    """Median time of one call after `warm` calls."""
    for _ in range(warm):
        run()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return round(sorted(times)[len(times) // 2] * 1e3, 4)


def train_step(net: nn.Module, x: Tensor, levels: Tensor, d_out: int) -> Callable[[], None]:
    """Forward, backward and Adam on a fixed batch."""
    target, optimizer = torch.randn(*x.shape[:2], d_out), torch.optim.Adam(net.parameters(), 3e-4)

    def step() -> None:
        optimizer.zero_grad()
        (net(x, levels) - target).pow(2).mean().backward()
        optimizer.step()

    return step


def in_mode(net: nn.Module, x: Tensor, levels: Tensor, mode: str) -> Callable[..., Tensor]:
    """The network as PyTorch runs it fastest in this mode."""
    if mode == "jit":
        return torch.jit.optimize_for_inference(torch.jit.freeze(torch.jit.trace(net, (x, levels))))
    if mode == "compile":
        return torch.compile(net, mode="max-autotune")
    return net


def time_forward(net: nn.Module, x: Tensor, levels: Tensor, mode: str, runs: int) -> dict[str, object]:
    """What one mode takes, or why it cannot run (no C++ compiler, say)."""
    try:
        with torch.inference_mode():
            forward = in_mode(net, x, levels, mode)
            return {"mode": mode, "ms": median_ms(lambda: forward(x, levels), runs, 10)}
    except Exception as error:
        return {"mode": mode, "error": str(error)[:200]}


def write_golden(net: nn.Module, x: Tensor, levels: Tensor, path: str) -> None:
    """Weights, inputs and outputs."""
    from safetensors.torch import save_file

    with torch.inference_mode():
        y = net.eval()(x, levels)
    weights = {f"weights.{name}": value.contiguous() for name, value in net.state_dict().items()}
    save_file({**weights, "x": x, "levels": levels.to(torch.int32), "y": y.contiguous()}, path)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["time", "train", "golden"])
    parser.add_argument("--net", choices=["unet", "dit", "dp"], default="unet")
    parser.add_argument("--widths", default="32,64,64,64")
    parser.add_argument("--d-in", type=int, default=59, help="x 23 + latent 20 + level embedding 16 (HalfCheetah)")
    parser.add_argument("--d-out", type=int, default=23)
    parser.add_argument("--len", type=int, default=16)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--modes", default=",".join(MODES), help="which modes `time` runs (default %(default)s)")
    parser.add_argument("--out", default="golden.safetensors")
    return parser


def main() -> None:
    """Entry point."""
    a = _parser().parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(a.threads)
    net, d_in, d_out = network(a)
    x, levels = torch.randn(a.batch, a.len, d_in), torch.randint(0, 150, (a.batch, a.len))
    facts = {"net": a.net, "widths": a.widths, "len": a.len, "batch": a.batch, "threads": a.threads}
    facts["params"] = sum(parameter.numel() for parameter in net.parameters())
    if a.what == "golden":
        write_golden(net, x, levels, a.out)
    elif a.what == "train":
        step = train_step(net, x, levels, d_out)
        print(json.dumps({**facts, "mode": "eager, Adam", "ms": median_ms(step, max(10, a.runs // 5), 3)}))
    else:
        net.eval()
        for mode in a.modes.split(","):
            print(json.dumps({**facts, **time_forward(net, x, levels, mode, a.runs)}), flush=True)


if __name__ == "__main__":
    main()
