"""Golden numbers for whole networks, from PyTorch: temporal U-Net, DiT, value, latent model with its loss, and the diffusion process.

    python -m venv target/torch && target/torch/bin/pip install torch numpy safetensors
    target/torch/bin/python tests/golden/make_networks.py

Writes `networks.safetensors` beside this file. Computed in float64 and rounded once; what is drawn is rounded before, to float16,
which holds it exactly. Activations are channels last; gradients are those of the sum over the results of `sum(y * r)`. Tensor names:
`<case>.in.<input>`, `.y.<result>`, `.r.<result>`, `.p.<parameter>`, `.d.<input>`, `.dp.<parameter>`; parameters have the names of a
checkpoint. The networks are written after the papers, in PyTorch's modules: the U-Net of Janner et al. 2022 with the mean level of a
window as its time, half of it as the value of a window, the transformer of Peebles and Xie 2023 with a level for each token, the encoder
and decoder of Chi et al. 2023 with the same, actor and critics of Hansen-Estruch et al. 2023, and the encoder, prior and decoder of the
paper's appendix A.4.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from make_nn import sinusoid
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torch.nn import functional

LEVEL_MAX = 40
STATE, ACTION = 3, 2
LOG_VAR = (-8.0, 2.0)
SPREAD = {"log_var": 20.0, "prior.4": 6.0, "baseline.surprise": 8.0}

Tensors = dict[str, Tensor]


class ConvBlock(nn.Module):
    """Conv1d, GroupNorm, Mish, channels first."""

    def __init__(self, c_in: int, c_out: int) -> None:
        super().__init__()
        self.conv = nn.Conv1d(c_in, c_out, 5, padding=2)
        self.norm = nn.GroupNorm(min(8, c_out), c_out)

    def forward(self, x: Tensor) -> Tensor:
        return functional.mish(self.norm(self.conv(x)))


class ResidualBlock(nn.Module):
    """ResidualTemporalBlock of Diffuser."""

    def __init__(self, c_in: int, c_out: int, emb: int) -> None:
        super().__init__()
        self.first, self.second = ConvBlock(c_in, c_out), ConvBlock(c_out, c_out)
        self.embed = nn.Linear(emb, c_out)
        self.skip = nn.Conv1d(c_in, c_out, 1) if c_in != c_out else nn.Identity()

    def forward(self, x: Tensor, emb: Tensor) -> Tensor:
        h = self.first(x) + self.embed(functional.mish(emb))[:, :, None]
        return self.second(h) + self.skip(x)


class Unet(nn.Module):
    """TemporalUnet of Diffuser."""

    EMB = 32

    def __init__(self, d_in: int, d_out: int, widths: list[int]) -> None:
        super().__init__()
        emb, pairs = self.EMB, list(zip([d_in, *widths[:-1]], widths, strict=True))
        self.time = nn.Sequential(nn.Linear(emb, 4 * emb), nn.Mish(), nn.Linear(4 * emb, emb))
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        for depth, (a, b) in enumerate(pairs):
            halve = nn.Conv1d(b, b, 3, 2, 1) if depth < len(pairs) - 1 else nn.Identity()
            self.down.append(nn.ModuleList([ResidualBlock(a, b, emb), ResidualBlock(b, b, emb), halve]))
        self.mid1, self.mid2 = ResidualBlock(widths[-1], widths[-1], emb), ResidualBlock(widths[-1], widths[-1], emb)
        for a, b in reversed(pairs[1:]):
            double = nn.ConvTranspose1d(a, a, 4, 2, 1)
            self.up.append(nn.ModuleList([ResidualBlock(2 * b, a, emb), ResidualBlock(a, a, emb), double]))
        self.final1, self.final2 = ConvBlock(widths[0], widths[0]), nn.Conv1d(widths[0], d_out, 1)

    def forward(self, x: Tensor, levels: Tensor, observed: Tensor | None) -> Tensor:
        emb = self.time(sinusoid(levels.mean(1), self.EMB))
        emb = emb if observed is None else emb + observed
        x, held = x.transpose(1, 2), []
        for first, second, halve in self.down:
            x = second(first(x, emb), emb)
            held.append(x)
            x = halve(x)
        x = self.mid2(self.mid1(x, emb), emb)
        for first, second, double in self.up:
            x = torch.cat([x, held.pop()], 1)
            x = double(second(first(x, emb), emb))
        return self.final2(self.final1(x)).transpose(1, 2)


class DitBlock(nn.Module):
    """adaLN-Zero block."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, elementwise_affine=False, eps=1e-6)
        self.attention = nn.MultiheadAttention(width, heads, batch_first=True)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU("tanh"), nn.Linear(4 * width, width))
        self.ada = nn.Linear(width, 6 * width)

    def forward(self, x: Tensor, c: Tensor) -> Tensor:
        shift, scale, gate, shift_mlp, scale_mlp, gate_mlp = self.ada(functional.silu(c)).chunk(6, -1)
        h = self.norm(x) * (1 + scale) + shift
        x = x + gate * self.attention(h, h, h, need_weights=False)[0]
        return x + gate_mlp * self.mlp(self.norm(x) * (1 + scale_mlp) + shift_mlp)


class Dit(nn.Module):
    """Diffusion transformer whose condition is that of each token: its level, its own channels, and the real steps."""

    def __init__(self, d_in: int, d_out: int, width: int, depth: int, heads: int) -> None:
        super().__init__()
        self.EMB = width
        self.inp, self.context = nn.Linear(d_in, width), nn.Linear(d_in, width)
        self.time = nn.Sequential(nn.Linear(width, width), nn.Mish(), nn.Linear(width, width))
        self.blocks = nn.ModuleList(DitBlock(width, heads) for _ in range(depth))
        self.norm = nn.LayerNorm(width, elementwise_affine=False, eps=1e-6)
        self.ada, self.out = nn.Linear(width, 2 * width), nn.Linear(width, d_out)

    def forward(self, x: Tensor, levels: Tensor, observed: Tensor | None) -> Tensor:
        c = self.time(sinusoid(levels, self.EMB)) + self.context(x)
        c = c if observed is None else c + observed[:, None]
        x = self.inp(x) + sinusoid(torch.arange(x.shape[1]), self.EMB)
        for block in self.blocks:
            x = block(x, c)
        shift, scale = self.ada(functional.silu(c)).chunk(2, -1)
        return self.out(self.norm(x) * (1 + scale) + shift)


class DitOfTokens(Dit):
    """The same with the real steps as clean tokens in front of the window."""

    def __init__(self, d_in: int, d_out: int, width: int, depth: int, heads: int) -> None:
        super().__init__(d_in, d_out, width, depth, heads)
        self.past = nn.ModuleDict({name: nn.Linear(STATE + ACTION, width) for name in ("inp", "context")})

    def forward(self, x: Tensor, levels: Tensor, told: Tensor | None, steps: Tensor) -> Tensor:
        levels = torch.cat([torch.zeros(steps.shape[:2]), levels], 1)
        c = self.time(sinusoid(levels, self.EMB)) + torch.cat([self.past["context"](steps), self.context(x)], 1)
        c = c if told is None else c + told[:, None]
        h = torch.cat([self.past["inp"](steps), self.inp(x)], 1) + sinusoid(torch.arange(levels.shape[1]), self.EMB)
        for block in self.blocks:
            h = block(h, c)
        c, h = c[:, steps.shape[1] :], h[:, steps.shape[1] :]
        shift, scale = self.ada(functional.silu(c)).chunk(2, -1)
        return self.out(self.norm(h) * (1 + scale) + shift)


class ToldDenoiser(nn.Module):
    """A transformer over window, latents and level embedding that is told what is wanted, and the real steps as tokens."""

    def __init__(self, latent: int, told: int) -> None:
        super().__init__()
        d_out = STATE + ACTION
        d_in = d_out + latent + Denoiser.LEVEL
        self.backbone, self.input_skip = DitOfTokens(d_in, d_out, 12, 2, 3), nn.Linear(d_in, d_out)
        self.told = nn.Sequential(nn.Linear(told + 1, 128), nn.SiLU(), nn.Linear(128, 12))

    def forward(self, given: Tensors) -> Tensors:
        x = torch.cat([given["x"], given["latents"], sinusoid(given["levels"], Denoiser.LEVEL)], -1)
        steps = given["observed"].unflatten(2, (-1, STATE + ACTION))[:, 0]
        return {"x0": self.backbone(x, given["levels"], self.told(given["told"][:, 0]), steps) + self.input_skip(x)}


class Selves(nn.Module):
    """Pre-norm self-attention, with the residual."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm, self.attention = nn.LayerNorm(width), nn.MultiheadAttention(width, heads, batch_first=True)

    def forward(self, x: Tensor, causal: bool) -> Tensor:
        h, mask = self.norm(x), nn.Transformer.generate_square_subsequent_mask(x.shape[1]) if causal else None
        return x + self.attention(h, h, h, need_weights=False, attn_mask=mask, is_causal=causal)[0]


class Cross(nn.Module):
    """Pre-norm attention on other tokens, with the residual."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm, self.heads = nn.LayerNorm(width), heads
        self.q, self.kv, self.out = nn.Linear(width, width), nn.Linear(width, 2 * width), nn.Linear(width, width)

    def forward(self, x: Tensor, others: Tensor) -> Tensor:
        q, k, v = (t.unflatten(-1, (self.heads, -1)).transpose(1, 2) for t in (self.q(self.norm(x)), *self.kv(others).chunk(2, -1)))
        return x + self.out(functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))


class TransformerBlock(nn.Module):
    """Of an encoder, or with `cross` of a decoder."""

    def __init__(self, width: int, heads: int, cross: bool) -> None:
        super().__init__()
        self.add_module("self", Selves(width, heads))
        self.cross = Cross(width, heads) if cross else None
        self.norm = nn.LayerNorm(width)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU("tanh"), nn.Linear(4 * width, width))

    def forward(self, x: Tensor, others: Tensor | None, causal: bool) -> Tensor:
        x = self.get_submodule("self")(x, causal)
        x = x if self.cross is None else self.cross(x, others)
        return x + self.mlp(self.norm(x))


def placed(x: Tensor) -> Tensor:
    """Each step beside its place, as one of so many."""
    return torch.cat([x, torch.eye(x.shape[1]).expand(x.shape[0], -1, -1)], -1)


class EncoderDecoder(nn.Module):
    """The policy of Chi et al. 2023 with a level and a latent for each position, and the mean level as the time."""

    def __init__(self, d_in: int, d_out: int, steps: tuple[int, int], sizes: tuple[int, int, int, int]) -> None:
        super().__init__()
        width, heads, encoder_depth, depth = sizes
        horizon, observed = steps
        self.level, self.input, self.reads = nn.Linear(width, width), nn.Linear(d_in + horizon, width), observed > 0
        if self.reads:
            self.step = nn.Linear(STATE + ACTION + 1 + observed, width)
            blocks = [TransformerBlock(width, heads, False) for _ in range(encoder_depth)]
            each = [nn.Linear(width, 4 * width), nn.Mish(), nn.Linear(4 * width, width)]
            self.encoder = nn.ModuleList(blocks or each)
        self.blocks = nn.ModuleList(TransformerBlock(width, heads, self.reads) for _ in range(depth))
        self.norm, self.out = nn.LayerNorm(width), nn.Linear(width, d_out)

    def forward(self, x: Tensor, levels: Tensor, observed: Tensor | None, told: Tensor | None) -> Tensor:
        time, h = self.level(sinusoid(levels.mean(1), self.norm.normalized_shape[0]))[:, None], self.input(placed(x))
        if not self.reads:
            h = torch.cat([time, h], 1)
            for block in self.blocks:
                h = block(h, None, True)
            return self.out(self.norm(h[:, 1:]))
        read = torch.cat([time, self.step(placed(observed)), *([] if told is None else [told[:, None]])], 1)
        for layer in self.encoder:
            read = layer(read, None, False) if isinstance(layer, TransformerBlock) else layer(read)
        for block in self.blocks:
            h = block(h, read, True)
        return self.out(self.norm(h))


class Policy(nn.Module):
    """That network over window, latents and level embedding, with the linear skip; of actions alone where it is given real steps."""

    def __init__(self, latent: int, told: int, steps: tuple[int, int], sizes: tuple[int, int, int, int]) -> None:
        super().__init__()
        d_out = ACTION if steps[1] else STATE + ACTION
        d_in = d_out + latent + Denoiser.LEVEL
        self.backbone, self.input_skip = EncoderDecoder(d_in, d_out, steps, sizes), nn.Linear(d_in, d_out)
        self.told = nn.Sequential(nn.Linear(told + 1, 128), nn.SiLU(), nn.Linear(128, sizes[0])) if told else None

    def forward(self, given: Tensors) -> Tensors:
        parts = [given["x"], given.get("latents"), sinusoid(given["levels"], Denoiser.LEVEL)]
        x = torch.cat([part for part in parts if part is not None], -1)
        observed = given["observed"].unflatten(2, (-1, STATE + ACTION + 1))[:, 0] if "observed" in given else None
        told = None if self.told is None else self.told(given["told"][:, 0])
        return {"x0": self.backbone(x, given["levels"], observed, told) + self.input_skip(x)}


class ResidualMlp(nn.Module):
    """MLPResNet of IDQL over a window as one vector."""

    def __init__(self, d_in: int, d_out: int, horizon: int, width: int, depth: int) -> None:
        super().__init__()
        self.time = nn.Sequential(nn.Linear(64, 128), nn.Mish(), nn.Linear(128, width))
        self.input, self.out = nn.Linear(horizon * d_in, width), nn.Linear(width, horizon * d_out)
        self.blocks = nn.ModuleList(
            nn.ModuleDict({"norm": nn.LayerNorm(width, eps=1e-6), "0": nn.Linear(width, 4 * width), "2": nn.Linear(4 * width, width)})
            for _ in range(depth)
        )

    def forward(self, x: Tensor, levels: Tensor, whole: Tensor | None) -> Tensor:
        h = self.input(x.flatten(1)) + self.time(sinusoid(levels.mean(1), 64))
        h = h if whole is None else h + whole
        for block in self.blocks:
            h = h + block["2"](functional.mish(block["0"](block["norm"](h))))
        return self.out(functional.mish(h)).unflatten(1, (x.shape[1], -1))


class Actor(nn.Module):
    """That network over actions, latents and level embedding, with the linear skip and the embedding of the real steps."""

    def __init__(self, latent: int, horizon: int, steps: int, width: int) -> None:
        super().__init__()
        d_in = ACTION + latent + Denoiser.LEVEL
        self.backbone, self.input_skip = ResidualMlp(d_in, ACTION, horizon, width, 2), nn.Linear(d_in, ACTION)
        self.observed = nn.Sequential(nn.Linear(steps * (STATE + ACTION + 1), 128), nn.SiLU(), nn.Linear(128, width))

    def forward(self, given: Tensors) -> Tensors:
        parts = [given["x"], given.get("latents"), sinusoid(given["levels"], Denoiser.LEVEL)]
        x = torch.cat([part for part in parts if part is not None], -1)
        return {"x0": self.backbone(x, given["levels"], self.observed(given["observed"][:, 0])) + self.input_skip(x)}


class Critic(nn.Module):
    """Critics of implicit Q-learning with its loss, equations 5 and 6 of Kostrikov et al. 2022; they are their own slow copy."""

    DISCOUNT, EXPECTILE, END_WORTH = 0.9, 0.7, -0.4

    def __init__(self, latent: int, width: int) -> None:
        super().__init__()
        self.q1, self.q2 = mlp(STATE + ACTION + latent, width, 1), mlp(STATE + ACTION + latent, width, 1)
        self.v = mlp(STATE + latent, width, 1)

    def forward(self, given: Tensors) -> Tensors:
        now = torch.cat([given["state"], given["action"], given["latents"]], -1)
        q1, q2, v = self.q1(now), self.q2(now), self.v(torch.cat([given["state"], given["latents"]], -1))
        later = self.v(torch.cat([given["next_state"], given["next_latents"]], -1)).detach()
        later = torch.where(given["ended"] > 0.5, self.END_WORTH, later)
        aim = given["gain"] + self.DISCOUNT * later
        u = torch.minimum(q1, q2).detach() - v
        assert (u < 0).any() and (u > 0).any() and (q1 < q2).any() and (q1 > q2).any()
        of_v = (torch.where(u < 0, 1 - self.EXPECTILE, self.EXPECTILE) * u**2).mean()
        of_q = functional.mse_loss(q1, aim) + functional.mse_loss(q2, aim)
        return {"q1": q1, "q2": q2, "v": v, "loss": of_q + of_v, "loss_q": of_q, "loss_v": of_v}


class Inverse(nn.Sequential):
    """Inverse dynamics of Decision Diffuser: the action between two states, side by side, given the latent of the step."""

    def __init__(self, latent: int, width: int) -> None:
        d_in = 2 * STATE + latent
        super().__init__(nn.Linear(d_in, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, ACTION))

    def forward(self, given: Tensors) -> Tensors:
        return {"action": super().forward(torch.cat([given["state"], given["latents"]], -1))}


class NoisyInverse(nn.Module):
    """The same as a diffusion of the action (DVInvMlp of CleanDiffuser), without a latent."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.time = nn.Sequential(nn.Linear(64, 128), nn.Mish(), nn.Linear(128, 64))
        sizes = [ACTION + 64 + 2 * STATE, width, width, width, ACTION]
        for i in range(4):
            self.add_module(str(2 * i), nn.Linear(sizes[i], sizes[i + 1]))

    def forward(self, given: Tensors) -> Tensors:
        h = torch.cat([given["noise"], self.time(sinusoid(given["levels"], 64)), given["state"]], -1)
        for i in range(3):
            h = functional.mish(self.get_submodule(str(2 * i))(h))
        return {"action": self.get_submodule("6")(h)}


class Denoiser(nn.Module):
    """A backbone over window, latents and level embedding, with the linear skip and the embedding of the real steps."""

    LEVEL = 16

    def __init__(self, backbone: Callable[[int, int], nn.Module], latent: int, obs_horizon: int) -> None:
        super().__init__()
        d_out = STATE + ACTION
        d_in = d_out + latent + self.LEVEL
        self.backbone, self.input_skip = backbone(d_in, d_out), nn.Linear(d_in, d_out)
        self.observed = None
        if obs_horizon > 1:
            steps = nn.Linear((obs_horizon - 1) * d_out, 128)
            self.observed = nn.Sequential(steps, nn.SiLU(), nn.Linear(128, self.backbone.EMB))

    def forward(self, given: Tensors) -> Tensors:
        parts = [given["x"], given.get("latents"), sinusoid(given["levels"], self.LEVEL)]
        x = torch.cat([part for part in parts if part is not None], -1)
        observed = None if self.observed is None else self.observed(given["observed"][:, 0])
        return {"x0": self.backbone(x, given["levels"], observed) + self.input_skip(x)}


class Value(nn.Module):
    """ValueFunction of Diffuser, with the window itself beside what the way down has found of it."""

    EMB = Unet.EMB

    def __init__(self, latent: int, steps: int, widths: list[int]) -> None:
        super().__init__()
        emb, d_in = self.EMB, STATE + ACTION + latent + Denoiser.LEVEL
        pairs = list(zip([d_in, *widths[:-1]], widths, strict=True))
        self.time = nn.Sequential(nn.Linear(emb, 4 * emb), nn.Mish(), nn.Linear(4 * emb, emb))
        self.down, left = nn.ModuleList(), steps
        for depth, (a, b) in enumerate(pairs):
            deepest = depth == len(pairs) - 1
            halve = nn.Identity() if deepest else nn.Conv1d(b, b, 3, 2, 1)
            self.down.append(nn.ModuleList([ResidualBlock(a, b, emb), ResidualBlock(b, b, emb), halve]))
            left = left if deepest else (left + 1) // 2
        self.mid = ResidualBlock(widths[-1], widths[-1], emb)
        found = left * widths[-1]
        hidden = max(found // 2, 1)
        self.out = nn.Sequential(nn.Linear(found + steps * (STATE + ACTION) + emb, hidden), nn.Mish(), nn.Linear(hidden, 1))

    def forward(self, given: Tensors) -> Tensors:
        emb = self.time(sinusoid(given["levels"].mean(1), self.EMB))
        parts = [given["x"], given.get("latents"), sinusoid(given["levels"], Denoiser.LEVEL)]
        x = torch.cat([part for part in parts if part is not None], -1).transpose(1, 2)
        for first, second, halve in self.down:
            x = halve(second(first(x, emb), emb))
        found = self.mid(x, emb).transpose(1, 2).flatten(1)
        return {"value": self.out(torch.cat([found, given["x"].flatten(1), emb], 1))[:, None]}


class Part(nn.Linear):
    """One part of a token, or the learned vector of its absence."""

    def __init__(self, d_in: int, width: int) -> None:
        super().__init__(d_in, width)
        self.absent = nn.Parameter(0.1 * torch.randn(width))

    def forward(self, value: Tensor, present: Tensor) -> Tensor:
        return torch.where(present[..., None] > 0.5, functional.relu(super().forward(value)), self.absent)


class Encoder(nn.Module):
    """Tokens to the Gaussian of the latent after each of them."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.state, self.action, self.reward = Part(STATE, 32), Part(ACTION, 16), Part(1, 16)
        self.mlp = nn.Sequential(nn.Linear(65, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU())
        self.gru = nn.GRU(64, hidden, batch_first=True)
        self.mean, self.log_var = nn.Linear(hidden, dim), nn.Linear(hidden, dim)

    def embed(self, tokens: Tensors) -> Tensor:
        parts = [self.state, self.action, self.reward]
        named = zip(("state", "action", "reward"), parts, tokens["present"].unbind(-1), strict=True)
        return self.mlp(torch.cat([*(part(tokens[name], seen) for name, part, seen in named), tokens["noise"]], -1))

    def head(self, states: Tensor) -> tuple[Tensor, Tensor]:
        return self.mean(states), self.log_var(states).clamp(*LOG_VAR)


def mlp(d_in: int, hidden: int, d_out: int) -> nn.Module:
    """Two hidden layers."""
    layers = [nn.Linear(d_in, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, d_out)]
    return nn.Sequential(*layers)


class Latent(nn.Module):
    """Encoder, prior, decoder."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.encoder, self.prior = Encoder(dim, hidden), mlp(2 * dim, 32, 2 * dim)
        self.decoder = nn.ModuleDict({"state": mlp(STATE + ACTION + dim, 64, STATE), "reward": mlp(STATE + ACTION + dim, 64, 1)})

    def next(self, mean: Tensor, log_var: Tensor) -> tuple[Tensor, Tensor]:
        change, log_var = self.prior(torch.cat([mean, log_var], -1)).chunk(2, -1)
        return mean + change, log_var.clamp(*LOG_VAR)

    def decode(self, tokens: Tensors, latent: Tensor) -> tuple[Tensor, Tensor]:
        x = torch.cat([tokens["state"], tokens["action"], latent], -1)
        return self.decoder["state"](x), self.decoder["reward"](x)


class Chain(Latent):
    """What is asked of it: posteriors, the prior after the last of them, and what the decoder makes of their means."""

    def forward(self, tokens: Tensors) -> Tensors:
        mean, log_var = self.encoder.head(self.encoder.gru(self.encoder.embed(tokens))[0])
        change, reward = self.decode(tokens, mean)
        out, last_one = {"mean": mean, "log_var": log_var, "change": change, "reward": reward}, (mean[:, -1:], log_var[:, -1:])
        for step in range(1, 4):
            last_one = self.next(*last_one)
            out |= {f"mean{step}": last_one[0], f"log_var{step}": last_one[1]}
        return out


class Elbo(Latent):
    """The loss of stage 1, written position by position."""

    KL_WEIGHT, REWARD_WEIGHT, CHANGE_STD = 0.3, 0.7, (0.5, 1.0, 2.0)

    def posterior(self, given: Tensors, t: int) -> tuple[Tensor, Tensor]:
        """q(c_t): after tokens 0..t as history, one step on what is shown of token t + 1."""
        seen = given["present"][:, : t + 1] * given["history_shown"][:, : t + 1]
        following = given["present"][:, t + 1 : t + 2] * given["successor_shown"][:, t : t + 1]
        block = {name: value[:, : t + 2] for name, value in given.items()} | {"present": torch.cat([seen, following], 1)}
        return self.encoder.head(self.encoder.gru(self.encoder.embed(block))[0][:, -1:])

    def forward(self, given: Tensors) -> Tensors:
        steps, valid = given["state"].shape[1] - 1, given["valid"]
        q = [self.posterior(given, t) for t in range(steps)]
        mean, log_var = torch.cat([m for m, _ in q], 1), torch.cat([v for _, v in q], 1)
        latent = mean + (log_var / 2).exp() * given["eps"]
        change, reward = self.decode({name: given[name][:, :-1] for name in ("state", "action")}, latent)
        target = given["state"].diff(dim=1) / torch.tensor(self.CHANGE_STD)
        state_error = functional.mse_loss(change[valid > 0.5], target[valid > 0.5])
        reward_error = functional.mse_loss(reward[valid > 0.5], given["reward"][:, :-1][valid > 0.5])
        posterior = Normal(mean[:, 1:], (log_var[:, 1:] / 2).exp())
        prior_mean, prior_log_var = self.next(mean[:, :-1], log_var[:, :-1])
        kls = kl_divergence(posterior, Normal(prior_mean, (prior_log_var / 2).exp()))
        kl = kls.sum(-1)[valid[:, 1:] > 0.5].mean()
        loss = state_error + self.REWARD_WEIGHT * reward_error + self.KL_WEIGHT * kl
        return {"loss": loss, "state_error": state_error, "reward_error": reward_error, "kl": kl}


class Skills(nn.Module):
    """The autoencoder of skills of Venkatraman et al. 2024: a bidirectional GRU over steps, a prior that sees the first state, and a
    decoder of each action, column after column or all of them at once."""

    BETA = 0.3

    def __init__(self, dim: int, width: int, layers: int, autoregressive: bool) -> None:
        super().__init__()
        self.embed, self.posterior = nn.Linear(STATE + ACTION, width), nn.Linear(2 * width, 2 * dim)
        sizes = [width] + [2 * width] * (layers - 1)
        both = ("forwards", "backwards")
        self.encoder = nn.ModuleList(nn.ModuleDict({way: nn.GRU(size, width, batch_first=True) for way in both}) for size in sizes)
        self.prior, given = mlp(STATE, width, 2 * dim), STATE + dim
        columns = range(ACTION) if autoregressive else [0]
        self.decoder = nn.ModuleList(mlp(given + column, width, 2 if autoregressive else 2 * ACTION) for column in columns)

    def forward(self, given: Tensors) -> Tensors:
        steps, (state, action) = given["x"].shape[1], given["x"].split([STATE, ACTION], -1)
        x = functional.relu(self.embed(given["x"]))
        for layer in self.encoder:
            x = torch.cat([layer["forwards"](x)[0], layer["backwards"](x.flip(1))[0].flip(1)], -1)
        half = x.shape[2] // 2
        mean, log_var = self.posterior(torch.cat([x[:, -1:, :half], x[:, :1, half:]], -1)).chunk(2, -1)
        log_var = log_var.clamp(*LOG_VAR)
        code = (mean + (log_var / 2).exp() * given["eps"]).expand(-1, steps, -1)
        told = [net(torch.cat([state, code, action[..., :column]], -1)).chunk(2, -1) for column, net in enumerate(self.decoder)]
        means, log_vars = (torch.cat([pair[part] for pair in told], -1) for part in (0, 1))
        log_vars = log_vars.clamp(*LOG_VAR)
        constant = ACTION * torch.log(torch.tensor(2 * torch.pi)) / 2
        nll = -Normal(means, (log_vars / 2).exp()).log_prob(action).sum(-1).mean() - constant
        prior_mean, prior_log_var = self.prior(state[:, :1]).chunk(2, -1)
        prior = Normal(prior_mean, (prior_log_var.clamp(*LOG_VAR) / 2).exp())
        kl = kl_divergence(Normal(mean, (log_var / 2).exp()), prior).sum(-1).mean() / steps
        return {"loss": nll + self.BETA * kl, "nll": nll, "kl": kl}


def window(batch: int, steps: int, latent: int, obs_horizon: int) -> Tensors:
    """What a denoiser is given."""
    given = {"x": torch.randn(batch, steps, STATE + ACTION)}
    if latent:
        given["latents"] = torch.randn(batch, steps, latent)
    if obs_horizon > 1:
        given["observed"] = torch.randn(batch, 1, (obs_horizon - 1) * (STATE + ACTION))
    # Whole levels, and one between.
    given["levels"] = torch.randint(0, LEVEL_MAX + 1, (batch, steps)).double()
    given["levels"][1, 2] += 0.5
    return given


def actor(batch: int, steps: int, latent: int, observed: int) -> Tensors:
    """What a denoiser of actions is given."""
    given = {"x": torch.randn(batch, steps, ACTION), "observed": torch.randn(batch, 1, observed * (STATE + ACTION + 1))}
    if latent:
        given["latents"] = torch.randn(batch, steps, latent)
    return given | {"levels": torch.randint(0, LEVEL_MAX + 1, (batch, steps)).double()}


def block(batch: int, steps: int) -> Tensors:
    """Tokens of which this and that is absent; what stands in an absent part must not matter."""
    return {
        "state": torch.randn(batch, steps, STATE),
        "action": torch.randn(batch, steps, ACTION),
        "reward": torch.randn(batch, steps, 1),
        "noise": torch.rand(batch, steps, 1),
        "present": torch.randint(0, 2, (batch, steps, 3)).double(),
    }


def elbo_block(batch: int, steps: int, dim: int) -> Tensors:
    """Blocks of which the second begins before its episode."""
    given = block(batch, steps) | {"present": torch.ones(batch, steps, 3)}
    given["present"][1, :2] = 0.0
    real = given["present"][..., 0]
    return given | {
        "valid": real[:, :-1] * real[:, 1:],
        "history_shown": torch.randint(0, 2, (batch, steps, 3)).double(),
        "successor_shown": torch.cat([torch.ones(batch, steps - 1, 1), torch.randint(0, 2, (batch, steps - 1, 2)).double()], -1),
        "eps": torch.randn(batch, steps - 1, dim),
    }


def unet(*widths: int) -> Callable[[int, int], nn.Module]:
    return lambda d_in, d_out: Unet(d_in, d_out, list(widths))


def dit(width: int, depth: int, heads: int) -> Callable[[int, int], nn.Module]:
    return lambda d_in, d_out: Dit(d_in, d_out, width, depth, heads)


def cases() -> dict[str, tuple[nn.Module, Tensors]]:
    """Name -> (network, what it is given)."""

    def denoiser(
        backbone: Callable[[int, int], nn.Module], batch: int, steps: int, latent: int, obs_horizon: int
    ) -> tuple[nn.Module, Tensors]:
        return Denoiser(backbone, latent, obs_horizon), window(batch, steps, latent, obs_horizon)

    return {
        "unet": denoiser(unet(5, 16, 3), 3, 12, 4, 3),
        "unet_observed": denoiser(unet(4, 4), 2, 6, 0, 2),
        "unet_latents": denoiser(unet(3, 7), 5, 10, 3, 1),
        "unet_plain": denoiser(unet(6), 2, 7, 0, 1),
        "dit": denoiser(dit(12, 2, 3), 3, 7, 4, 3),
        "dit_observed": denoiser(dit(10, 1, 1), 2, 5, 0, 2),
        "dit_latents": denoiser(dit(6, 3, 3), 5, 3, 3, 1),
        "dit_plain": denoiser(dit(4, 0, 2), 2, 9, 0, 1),
        "latent": (Chain(3, 9), block(4, 5)),
        "elbo": (Elbo(2, 7), elbo_block(3, 5, 2)),
    }


def later_cases() -> dict[str, tuple[nn.Module, Tensors]]:
    """The same, drawn once those are done, so that their numbers stay."""
    return {
        "value": (Value(4, 7, [5, 16, 3]), window(3, 7, 4, 1)),
        "value_plain": (Value(0, 5, [6]), window(2, 5, 0, 1)),
    }


def last_cases() -> dict[str, tuple[nn.Module, Tensors]]:
    """And once those are."""
    return {
        "dit_told": (ToldDenoiser(4, 2), window(3, 7, 4, 3) | {"told": torch.randn(3, 1, 3)}),
        "inverse": (Inverse(4, 7), {"state": torch.randn(3, 5, 2 * STATE), "latents": torch.randn(3, 5, 4)}),
        "noisy_inverse": (
            NoisyInverse(7),
            {"state": torch.randn(3, 5, 2 * STATE), "noise": torch.randn(3, 5, ACTION), "levels": torch.randint(1, 11, (3, 5))},
        ),
    }


def policy_cases() -> dict[str, tuple[nn.Module, Tensors]]:
    """And once those are."""

    def given(batch: int, steps: int, latent: int, observed: int) -> Tensors:
        given = window(batch, steps, latent, 1)
        if observed:
            given |= {"x": torch.randn(batch, steps, ACTION), "observed": torch.randn(batch, 1, observed * (STATE + ACTION + 1))}
        return given

    transitions = {name: torch.randn(40, 1, width) for name, width in (("state", STATE), ("action", ACTION), ("latents", 4))}
    transitions |= {"next_state": torch.randn(40, 1, STATE), "next_latents": torch.randn(40, 1, 4), "gain": torch.randn(40, 1, 1)}
    transitions |= {"ended": torch.randint(0, 2, (40, 1, 1)).double()}
    return {
        "policy": (Policy(4, 2, (7, 3), (12, 3, 2, 2)), given(3, 7, 4, 3) | {"told": torch.randn(3, 1, 3)}),
        "policy_each": (Policy(0, 0, (5, 1), (10, 1, 0, 1)), given(2, 5, 0, 1)),
        "policy_alone": (Policy(3, 0, (3, 0), (6, 3, 0, 2)), given(5, 3, 3, 0)),
        "actor": (Actor(4, 1, 2, 12), actor(5, 1, 4, 2)),
        "actor_plain": (Actor(0, 3, 1, 7), actor(2, 3, 0, 1)),
        "critic": (Critic(4, 9), transitions),
    }


def skill_cases() -> dict[str, tuple[nn.Module, Tensors]]:
    """And once those are."""

    def given(batch: int, steps: int, dim: int) -> Tensors:
        return {"x": torch.randn(batch, steps, STATE + ACTION), "eps": torch.randn(batch, 1, dim)}

    return {
        "skill": (Skills(3, 6, 2, autoregressive=True), given(4, 5, 3)),
        "skill_normal": (Skills(2, 5, 1, autoregressive=False), given(3, 7, 2)),
    }


def our_name(name: str) -> str:
    """The name of a PyTorch parameter in a checkpoint."""
    name = name.removeprefix("backbone.")
    return name.replace("attention.in_proj_", "qkv.").replace("attention.out_proj.", "out.")


def run(network: nn.Module, given: Tensors) -> Tensors:
    """Results and gradients of one case."""
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            parameter += 0.1 * torch.randn_like(parameter)
            # So that some log-variances and surprises reach their bounds, and others do not.
            parameter *= next((factor for part, factor in SPREAD.items() if part in name), 1.0)
            parameter.copy_(parameter.half())
    given = {name: value.half().double() for name, value in given.items()}
    varied = [name for name in given if name in {"x", "latents", "observed", "state", "action", "reward", "noise", "eps", "told"}]
    for name in varied:
        given[name].requires_grad_()
    results = network(given)
    assert "log_var" not in results or all((results["log_var"] == bound).any() for bound in LOG_VAR)
    weights = {name: torch.randn(y.shape).half().double() for name, y in results.items()}
    total = torch.stack([(y * weights[name]).sum() for name, y in results.items()]).sum()
    if total.requires_grad:
        total.backward()
    out = {f"in.{name}": value for name, value in given.items()}
    out |= {f"d.{name}": gradient(given[name]) for name in varied}
    out |= {f"y.{name}": value for name, value in results.items()} | {f"r.{name}": value for name, value in weights.items()}
    for name, parameter in network.named_parameters():
        out |= {f"p.{our_name(name)}": parameter, f"dp.{our_name(name)}": gradient(parameter)}
    return out


def gradient(leaf: Tensor) -> Tensor:
    """Zero where no result depends on it."""
    return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad


def process() -> Tensors:
    """Cumulative alphas of Nichol and Dhariwal 2021, and jumps as (from, to, eta, on x0, on eps, on fresh noise)."""

    def alphas(count: int) -> Tensor:
        f = torch.cos((torch.arange(count + 1) / count + 0.008) / 1.008 * torch.pi / 2) ** 2
        betas = (1 - f[1:] / f[:-1]).clamp(max=0.999)
        return torch.cat([torch.ones(1), torch.cumprod(1 - betas, 0)])

    def ddim(a: Tensor, b: Tensor, eta: float) -> list[Tensor]:
        """Song et al. 2021, equations 12 and 16."""
        sigma = eta * ((1 - b) / (1 - a)).sqrt() * (1 - a / b).sqrt()
        return [b.sqrt(), (1 - b - sigma**2).clamp(min=0).sqrt(), sigma]

    def ddpm(a: Tensor, b: Tensor) -> list[Tensor]:
        """The posterior of Ho et al. 2020, equations 6 and 7, over the step from b to a; told in x0 and eps rather than x0 and x."""
        beta = 1 - a / b
        on_x0, on_x = b.sqrt() * beta / (1 - a), (1 - beta).sqrt() * (1 - b) / (1 - a)
        return [on_x0 + on_x * a.sqrt(), on_x * (1 - a).sqrt(), ((1 - b) / (1 - a) * beta).sqrt()]

    alpha = alphas(LEVEL_MAX)
    rows = []
    for start, end in ((40, 39), (40, 12), (39, 20), (20, 19), (7, 3), (2, 1), (1, 0), (40, 0)):
        for eta in (0.0, 0.3, 1.0):
            found = ddpm(alpha[start], alpha[end]) if eta == 1.0 else ddim(alpha[start], alpha[end], eta)
            rows.append(torch.stack([torch.tensor(float(start)), torch.tensor(float(end)), torch.tensor(eta), *found]))
    return {"process.alphas40": alpha, "process.alphas150": alphas(150), "process.jumps": torch.stack(rows)}


def results(cases: dict[str, tuple[nn.Module, Tensors]]) -> Tensors:
    """What came of all cases."""
    ran = {case: run(network, given) for case, (network, given) in cases.items()}
    return {f"{case}.{name}": value for case, out in ran.items() for name, value in out.items()}


def save(path: Path, cases: dict[str, tuple[nn.Module, Tensors]], beside: Tensors | None = None) -> None:
    """Runs all cases and writes what came of them, and what stands beside them."""
    out = dict(beside or {}) | results(cases)
    exact = {name for name in out if name.split(".")[1] in {"in", "r", "p"}}
    held = {name: (value.half() if name in exact else value.float()).detach().contiguous() for name, value in out.items()}
    save_file(held, path)


def main() -> None:
    torch.manual_seed(0)
    torch.set_default_dtype(torch.float64)
    done = results(cases())
    done |= results(later_cases())
    done |= results(last_cases())
    done |= results(policy_cases())
    save(Path(__file__).with_name("networks.safetensors"), skill_cases(), process() | done)


if __name__ == "__main__":
    main()
