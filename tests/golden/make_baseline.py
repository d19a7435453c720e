"""Golden numbers for a latent beside a baseline, from PyTorch: surprises, the loss without a context, and the ELBO of what surprises.

    python -m venv target/torch && target/torch/bin/pip install torch numpy safetensors
    target/torch/bin/python tests/golden/make_baseline.py

Writes `baseline.safetensors` beside this file, in the form of `networks.safetensors` (make_networks.py). What nothing depends on, a
baseline of its surprises among it, has gradients of zero. Written from the formulas, one position after the other:

    surprise of x_t:   W_s (s_t - s_{t-1} - f0(s_{t-1}, a_{t-1})),  W_a (a_t - g0(s_t)),  W_r (r_t - r0(s_t, a_t)),  each within +-10
    context-free loss: mean ((s_{t+1} - s_t - f0) / std)^2 + mean (a_t - g0)^2 + mean (r_t - r0)^2
    ELBO:              sum over parts of weight * 1/2 * sum over columns of (told by c - surprise)^2, and weight * KL

A latent with a prior explains step t by q(c_t), which waits for what is shown of x_{t+1}; one that is held explains step t + 1 by what is
believed when s_{t+1} has been seen. Columns that stay are those of one belief for the whole row, and pay for their KL once.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from make_networks import ACTION, LOG_VAR, STATE, Encoder, Part, Tensors, block, elbo_block, mlp, save
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torch.nn import functional

PARTS = {"state": STATE, "action": ACTION, "reward": 1}
WEIGHTS = {"state": 0.8, "reward": 0.7, "action": 0.6}
CHANGE_STD = (0.5, 1.0, 2.0)
SURPRISE_MAX = 10.0
WIDTH = 5

Gaussian = tuple[Tensor, Tensor]


class Skip(nn.ModuleDict):
    """Two hidden layers beside a linear map."""

    def __init__(self, d_in: int, d_out: int) -> None:
        layers = {"0": (d_in, WIDTH), "2": (WIDTH, WIDTH), "4": (WIDTH, d_out), "skip": (d_in, d_out)}
        super().__init__({name: nn.Linear(*sizes) for name, sizes in layers.items()})

    def forward(self, *x: Tensor) -> Tensor:
        given = torch.cat(x, -1)
        hidden = functional.relu(self["2"](functional.relu(self["0"](given))))
        return self["4"](hidden) + self["skip"](given)


class Baseline(nn.Module):
    """f0 of the state change and the reward, g0 of the action, and what makes surprises of residuals."""

    def __init__(self) -> None:
        super().__init__()
        self.change, self.action, self.reward = Skip(STATE + ACTION, STATE), Skip(STATE, ACTION), Skip(STATE + ACTION, 1)
        self.surprise = nn.ModuleDict({name: nn.Linear(width, width) for name, width in PARTS.items()})

    def off(self, before: Tensors, now: Tensors) -> Tensors:
        """How far the arrival at a state, the action and the reward there are from what was expected."""
        return {
            "state": now["state"] - before["state"] - self.change(before["state"], before["action"]),
            "action": now["action"] - self.action(now["state"]),
            "reward": now["reward"] - self.reward(now["state"], now["action"]),
        }

    def surprises(self, given: Tensors) -> Tensors:
        """Of every token; before the first one stand zeros. They are facts, and move no network."""
        steps = []
        for t in range(given["state"].shape[1]):
            now = {name: given[name][:, t] for name in PARTS}
            before = {name: given[name][:, t - 1] if t else torch.zeros_like(now[name]) for name in PARTS}
            steps.append({name: self.surprise[name](residual) for name, residual in self.off(before, now).items()})
        held = {name: torch.stack([step[name] for step in steps], 1).clamp(-SURPRISE_MAX, SURPRISE_MAX).detach() for name in PARTS}
        reached = torch.cat([value.abs().flatten() for value in held.values()]) == SURPRISE_MAX
        assert reached.any() and not reached.all(), "some reach their bounds, and others do not"
        return held


def told(seen: Tensor) -> Tensor:
    """Which surprises can be told of tokens whose parts are seen or not, `(B, L, 3)`."""
    out = torch.zeros_like(seen)
    for t in range(seen.shape[1]):
        state, action, reward = seen[:, t].unbind(-1)
        left = seen[:, t - 1, 0] * seen[:, t - 1, 1] if t else torch.zeros_like(state)
        out[:, t] = torch.stack([left * state, state * action, state * action * reward], -1)
    return out


class Surprises(nn.Module):
    """What is surprising of tokens, and where that means something."""

    def __init__(self) -> None:
        super().__init__()
        self.baseline = Baseline()

    def forward(self, given: Tensors) -> Tensors:
        return self.baseline.surprises(given) | {"told": told(given["present"])}


class ContextFree(Surprises):
    """The loss of the baseline, over transitions of two tokens."""

    def forward(self, given: Tensors) -> Tensors:
        now, then = ({name: given[name][:, t] for name in PARTS} for t in (0, 1))
        change = self.baseline.off(now, then)["state"] / torch.tensor(CHANGE_STD)
        # Of the first token's action and reward; what came before it says nothing of these.
        off = self.baseline.off(now, now)
        errors = {"state_error": change.square().mean(), "action_error": off["action"].square().mean()}
        errors["reward_error"] = off["reward"].square().mean()
        return {"loss": sum(errors.values()), **errors}


class SurprisedEncoder(Encoder):
    """Reads surprises beside the tokens."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__(dim, hidden)
        self.surprise = nn.ModuleDict({"state": Part(STATE, 32), "action": Part(ACTION, 16), "reward": Part(1, 16)})
        self.mlp[0] = nn.Linear(2 * 64 + 1, 64)

    def after(self, tokens: Tensors, surprises: Tensors) -> Gaussian:
        """The Gaussian after the last of these tokens."""
        seen, known = tokens["present"].unbind(-1), told(tokens["present"]).unbind(-1)
        parts = [getattr(self, name)(tokens[name], seen[i]) for i, name in enumerate(PARTS)]
        parts += [self.surprise[name](surprises[name], known[i]) for i, name in enumerate(PARTS)]
        return self.head(self.gru(self.mlp(torch.cat([*parts, tokens["noise"]], -1)))[0][:, -1])


class Elbo(nn.Module):
    """The loss of stage 1 beside a baseline."""

    KL_WEIGHT, AHEAD, AHEAD_WEIGHT, STAYS = 0.3, 2, 0.5, 1

    def __init__(self, dim: int, hidden: int, *, prior: bool, free_bits: float) -> None:
        super().__init__()
        self.free_bits = free_bits
        self.baseline, self.encoder = Baseline(), SurprisedEncoder(dim, hidden)
        self.prior = mlp(2 * dim, 32, 2 * (dim - self.STAYS)) if prior else None
        d_in = {"state": STATE + ACTION + dim, "reward": STATE + ACTION + dim, "action": STATE + dim}
        self.decoder = nn.ModuleDict({name: mlp(width, 64, PARTS[name]) for name, width in d_in.items()})

    def belief(self, given: Tensors, surprises: Tensors, t: int) -> Gaussian:
        """After tokens 0..t as history, one step on what is shown of token t + 1: of a held one its state alone."""
        shown = torch.tensor([1.0, 0.0, 0.0]) if self.prior is None else given["successor_shown"][:, t]
        seen = given["present"][:, : t + 1] * given["history_shown"][:, : t + 1]
        seen = torch.cat([seen, (given["present"][:, t + 1] * shown)[:, None]], 1)
        tokens = {name: given[name][:, : t + 2] for name in [*PARTS, "noise"]} | {"present": seen}
        return self.encoder.after(tokens, {name: value[:, : t + 2] for name, value in surprises.items()})

    def next(self, mean: Tensor, log_var: Tensor) -> Gaussian:
        """The latent one step on."""
        if self.prior is None:
            return mean, log_var
        change, moved = self.prior(torch.cat([mean, log_var], -1)).chunk(2, -1)
        stays, moves = slice(self.STAYS), slice(self.STAYS, None)
        moved = moved.clamp(*LOG_VAR)
        return torch.cat([mean[:, stays], mean[:, moves] + change], -1), torch.cat([log_var[:, stays], moved], -1)

    def errors(self, given: Tensors, surprises: Tensors, latents: Sequence[Tensor], first: int, real: Tensor) -> Tensors:
        """Mean squares of what the latents, of steps `first` on, leave unexplained where `real`, `(B, steps)`, says so."""
        off: dict[str, list[Tensor]] = {name: [] for name in PARTS}
        for i, latent in enumerate(latents):
            t, rows = first + i, real[:, i] > 0.5
            state, action = given["state"][:, t], given["action"][:, t]
            both, alone = torch.cat([state, action, latent], -1), torch.cat([state, latent], -1)
            off["state"].append((self.decoder["state"](both) - surprises["state"][:, t + 1])[rows])
            off["reward"].append((self.decoder["reward"](both) - surprises["reward"][:, t])[rows])
            off["action"].append((self.decoder["action"](alone) - surprises["action"][:, t])[rows])
        return {name: torch.cat(parts).square().mean() for name, parts in off.items()}

    def weighted(self, errors: Tensors) -> Tensor:
        """Half sums of squares, each by its weight."""
        return sum(WEIGHTS[name] * PARTS[name] / 2 * error for name, error in errors.items())

    def divergence(self, q: Gaussian, p: Gaussian | None) -> Tensor:
        """KL of each row, to N(0, I) where nothing is named; what is below the free bits counts as these."""
        mean, log_var = p or (torch.zeros_like(q[0]), torch.zeros_like(q[0]))
        kl = kl_divergence(Normal(q[0], (q[1] / 2).exp()), Normal(mean, (log_var / 2).exp())).sum(-1)
        return kl.clamp(min=self.free_bits)

    def kl(self, q: Sequence[Gaussian], one: Gaussian, real: Tensor) -> Tensor:
        """Of the columns that move a mean over steps, to what the prior made of the step before; and of those that stay once a row."""
        moving = [self.moving(belief) for belief in q]
        if self.prior is None:
            steps, each = real, [self.divergence(belief, None) for belief in moving]
        else:
            expected = [self.moving(self.next(*belief)) for belief in q[:-1]]
            steps, each = real[:, 1:], [self.divergence(*pair) for pair in zip(moving[1:], expected, strict=True)]
        each, once = torch.stack(each, 1), self.divergence(one, None)
        all_of_them = torch.cat([each[steps > 0.5], once])
        below = (all_of_them == self.free_bits).sum()
        assert not self.free_bits or 0 < below < len(all_of_them), "some are below the free bits, and others are not"
        return (each * steps).sum() / steps.sum() + once.sum() / real.sum()

    def ahead(self, given: Tensors, surprises: Tensors, q: Sequence[Gaussian], first: int, real: Tensor) -> Tensor:
        """What the means of beliefs, moved on by the prior, leave unexplained of later steps."""
        later, parts = q, []
        for by in range(1, self.AHEAD + 1):
            later = [self.next(*belief) for belief in later[: len(q) - by]]
            means = [mean for mean, _ in later]
            parts.append(self.weighted(self.errors(given, surprises, means, first + by, real[:, : len(means)])))
        return torch.stack(parts).mean()

    def moving(self, belief: Gaussian) -> Gaussian:
        return belief[0][:, self.STAYS :], belief[1][:, self.STAYS :]

    def forward(self, given: Tensors) -> Tensors:
        surprises, first = self.baseline.surprises(given), 0 if self.prior is not None else 1
        eps, real = given["eps"][:, first:], given["valid"][:, first:]
        q = [self.belief(given, surprises, t) for t in range(real.shape[1])]
        chosen = given["believed"][:, 0].argmax(-1)
        one = tuple(torch.stack([q[t][i][row, : self.STAYS] for row, t in enumerate(chosen)]) for i in (0, 1))
        shared = draw(one, eps[:, 0, : self.STAYS])
        latents = [torch.cat([shared, draw(self.moving(belief), eps[:, i, self.STAYS :])], -1) for i, belief in enumerate(q)]
        errors = self.errors(given, surprises, latents, first, real)
        kl, ahead = self.kl(q, one, real), self.ahead(given, surprises, q, first, real)
        loss = self.weighted(errors) + self.KL_WEIGHT * kl + self.AHEAD_WEIGHT * ahead
        return {"loss": loss, "kl": kl, "ahead": ahead} | {f"{name}_error": error for name, error in errors.items()}


def draw(belief: Gaussian, noise: Tensor) -> Tensor:
    return belief[0] + (belief[1] / 2).exp() * noise


def tokens(batch: int, steps: int) -> Tensors:
    """Tokens of which this and that is absent, zeros there."""
    given = block(batch, steps)
    return given | {name: given[name] * given["present"][..., i : i + 1] for i, name in enumerate(PARTS)}


def blocks(steps: int, dim: int) -> Tensors:
    """Blocks of which the second begins before its episode, and the beliefs that explain them."""
    chosen = torch.tensor([1, steps - 3, 0])
    return elbo_block(len(chosen), steps, dim) | {"believed": functional.one_hot(chosen, steps - 1)[:, None].double()}


def main() -> None:
    torch.manual_seed(0)
    torch.set_default_dtype(torch.float64)
    cases = {
        "surprises": (Surprises(), tokens(3, 7)),
        "context_free": (ContextFree(), block(5, 2)),
        "elbo_surprises": (Elbo(3, 7, prior=True, free_bits=0.0), blocks(6, 3)),
        "elbo_held": (Elbo(2, 5, prior=False, free_bits=1.5), blocks(5, 2)),
    }
    save(Path(__file__).with_name("baseline.safetensors"), cases)


if __name__ == "__main__":
    main()
