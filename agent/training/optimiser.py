"""Optimizer: Muon for the matrices inside the network, Adam for all other weights.

Muon replaces the momentum of a matrix by the nearest orthogonal matrix (Jordan et al., 2024), with
Newton-Schulz iterations. Its step is scaled to the size of Adam's (Liu et al., 2025), so that both
share one learning rate schedule.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

# Coefficients of the quintic iteration, from Jordan et al.
QUINTIC = (3.4445, -4.7750, 2.0315)
ADAM_STEP_SIZE = 0.2
WARMUP_STEPS = 60


class Muon(torch.optim.Optimizer):
    """Muon, for matrices only. A fused query-key-value weight counts as three matrices."""

    def __init__(
        self,
        named: Iterable[tuple[str, nn.Parameter]],
        learning_rate: float,
        momentum: float,
        decay: float,
        iterations: int,
    ) -> None:
        pairs = list(named)
        self.parts = {id(value): 3 if ".qkv." in name else 1 for name, value in pairs}
        self.iterations = iterations
        options = {"lr": learning_rate, "momentum": momentum, "decay": decay}
        super().__init__([value for _, value in pairs], options)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # type: ignore[override]
        for group in self.param_groups:
            by_shape: dict[torch.Size, list[tuple[nn.Parameter, int]]] = defaultdict(list)
            updates: dict[torch.Size, list[Tensor]] = defaultdict(list)
            for parameter in group["params"]:
                buffer = self.state[parameter].setdefault("momentum", torch.zeros_like(parameter))
                buffer.lerp_(parameter.grad, 1.0 - group["momentum"])
                # Nesterov momentum.
                ahead = parameter.grad.lerp(buffer, group["momentum"])
                parts = self.parts[id(parameter)]
                # (parts * rows, columns) -> parts x (rows, columns)
                for index, matrix in enumerate(ahead.chunk(parts)):
                    by_shape[matrix.shape].append((parameter, index))
                    updates[matrix.shape].append(matrix)
            for shape, places in by_shape.items():
                whole = orthogonalise(torch.stack(updates[shape]), self.iterations)
                scale = ADAM_STEP_SIZE * max(shape) ** 0.5
                for (parameter, index), matrix in zip(places, whole, strict=True):
                    target = parameter.chunk(self.parts[id(parameter)])[index]
                    target.mul_(1.0 - group["lr"] * group["decay"])
                    target.add_(matrix, alpha=-group["lr"] * scale)


def orthogonalise(matrices: Tensor, iterations: int) -> Tensor:
    """Orthogonalizes (count, rows, columns): singular values near 1, the same singular vectors.

    In bf16, as by Jordan et al.: the singular values are approximate anyway.
    """
    tall = matrices.shape[1] > matrices.shape[2]
    x = (matrices.transpose(1, 2) if tall else matrices).bfloat16()
    x = x / (x.flatten(1).norm(dim=1)[:, None, None] + 1e-7)
    first, second, third = QUINTIC
    for _ in range(iterations):
        square = x @ x.transpose(1, 2)
        polynomial = torch.baddbmm(square, square, square, beta=second, alpha=third)
        x = torch.baddbmm(x, polynomial, x, beta=first)
    return (x.transpose(1, 2) if tall else x).to(matrices.dtype)


def is_inner_matrix(name: str, parameter: nn.Parameter) -> bool:
    """Whether Muon updates a weight; Adam updates embeddings, the head and the patch embedding."""
    outside = ("embed_tokens", "lm_head", "patch_embed", "pos_embed")
    return parameter.ndim == 2 and not any(part in name for part in outside)


def build(
    network: nn.Module, learning_rate: float, adam_learning_rate: float
) -> list[torch.optim.Optimizer]:
    named = [(n, p) for n, p in network.named_parameters() if p.requires_grad]
    inner = [(n, p) for n, p in named if is_inner_matrix(n, p)]
    outer = [p for n, p in named if not is_inner_matrix(n, p)]
    return [
        Muon(inner, learning_rate, momentum=0.95, decay=0.01, iterations=5),
        torch.optim.AdamW(
            outer, lr=adam_learning_rate, betas=(0.9, 0.98), weight_decay=0.0, fused=True
        ),
    ]


def rate_factor(step: int, share: float) -> float:
    """Factor of all learning rates at a step and at the spent share, 0 to 1, of the budget.

    A short warmup, 1 for the first quarter of the budget, then linear to 0.
    """
    return min(1.0, (step + 1) / WARMUP_STEPS) * min(1.0, (1.0 - share) / 0.75)
