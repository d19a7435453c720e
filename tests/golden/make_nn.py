"""Golden numbers for the layers of `src/model/nn`, from PyTorch: inputs, weights, results and gradients.

    python -m venv target/torch && target/torch/bin/pip install torch numpy safetensors
    target/torch/bin/python tests/golden/make_nn.py

Writes `nn.safetensors` beside this file. Computed in float64 and rounded once. Activations are channels last; gradients are those
of `sum(y * r)`. Tensor names: `<case>.x`, `.h0`, `.y`, `.r`, `.p.<parameter>`, `.dx`, `.dh0`, `.dp.<parameter>`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional

Forward = Callable[[nn.Module, dict[str, Tensor]], Tensor]


def last(layer: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """A channels-first layer on a channels-last tensor."""
    return layer(x.transpose(1, 2)).transpose(1, 2)


def attend(qkv: Tensor, heads: int) -> Tensor:
    """Self-attention over rows that hold q, k, v."""
    batch, steps, width = qkv.shape
    q, k, v = qkv.view(batch, steps, 3, heads, width // (3 * heads)).permute(2, 0, 3, 1, 4)
    return functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(batch, steps, width // 3)


def sinusoid(levels: Tensor, dim: int) -> Tensor:
    """The time embedding of Diffuser's U-Net."""
    half = dim // 2
    angle = levels[..., None] * torch.exp(torch.arange(half) * (-math.log(10000.0) / (half - 1)))
    return torch.cat([angle.sin(), angle.cos()], -1)


def cases() -> dict[str, tuple[nn.Module, dict[str, tuple[int, ...]], Forward]]:
    """Name -> (module with the parameters, shapes of the inputs, forward)."""

    def one(module: nn.Module, *shape: int) -> tuple[nn.Module, dict[str, tuple[int, ...]], Forward]:
        return module, {"x": shape}, lambda m, i: m(i["x"])

    def conv(module: nn.Module, *shape: int) -> tuple[nn.Module, dict[str, tuple[int, ...]], Forward]:
        return module, {"x": shape}, lambda m, i: last(m, i["x"])

    def plain(f: Callable[[Tensor], Tensor], *shape: int) -> tuple[nn.Module, dict[str, tuple[int, ...]], Forward]:
        return nn.Identity(), {"x": shape}, lambda _, i: f(i["x"])

    return {
        "linear": one(nn.Linear(7, 35), 3, 4, 7),
        "conv": conv(nn.Conv1d(6, 20, 5, padding=2), 3, 9, 6),
        "conv_stride": conv(nn.Conv1d(6, 10, 3, 2, 1), 3, 9, 6),
        "conv_transpose": conv(nn.ConvTranspose1d(6, 10, 4, 2, 1), 3, 5, 6),
        "group_norm_mish": (nn.GroupNorm(4, 20), {"x": (3, 6, 20)}, lambda m, i: functional.mish(last(m, i["x"]))),
        "layer_norm": one(nn.LayerNorm(21), 3, 4, 21),
        "layer_norm_plain": one(nn.LayerNorm(21, elementwise_affine=False, eps=1e-6), 3, 4, 21),
        "gru": (
            nn.GRU(6, 9, batch_first=True),
            {"x": (3, 5, 6), "h0": (3, 9)},
            lambda m, i: m(i["x"], i["h0"][None])[0],
        ),
        "attention": plain(lambda x: attend(x, 2), 3, 7, 30),
        "mish": plain(functional.mish, 4, 25),
        "silu": plain(functional.silu, 4, 25),
        "gelu_tanh": plain(lambda x: functional.gelu(x, approximate="tanh"), 4, 25),
        "relu": plain(functional.relu, 4, 25),
    }


def main() -> None:
    torch.manual_seed(0)
    torch.set_default_dtype(torch.float64)
    out: dict[str, Tensor] = {}
    for name, (module, shapes, forward) in cases().items():
        with torch.no_grad():
            for parameter in module.parameters():
                # Rounded first, so that the float32 reader has the same numbers.
                parameter.copy_((parameter + 0.2 * torch.randn_like(parameter)).float())
        scale = 4.0 if isinstance(module, nn.Identity) and name != "attention" else 1.0
        inputs = {key: (scale * torch.randn(shape)).float().double().requires_grad_() for key, shape in shapes.items()}
        y = forward(module, inputs)
        r = torch.randn(y.shape).float().double()
        (y * r).sum().backward()
        out |= {f"{name}.y": y, f"{name}.r": r}
        out |= {f"{name}.{key}": value for key, value in inputs.items()}
        out |= {f"{name}.d{key}": value.grad for key, value in inputs.items()}
        out |= {f"{name}.p.{key}": value for key, value in module.named_parameters()}
        out |= {f"{name}.dp.{key}": value.grad for key, value in module.named_parameters()}
    levels = torch.tensor([[0.0, 1.0, 37.5], [74.25, 149.0, 999.0]])
    out |= {"sinusoid.x": levels, "sinusoid.y": sinusoid(levels, 32)}
    save_file({key: value.detach().float().contiguous() for key, value in out.items()}, Path(__file__).with_name("nn.safetensors"))


if __name__ == "__main__":
    main()
