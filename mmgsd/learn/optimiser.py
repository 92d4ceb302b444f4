"""The optimisers of a training: AdamW, and Muon for the weights of a network's convolutions."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mmgsd.config import TrainConfig


class ConvolutionMuon(torch.optim.Muon):
    """torch's Muon (Jordan 2024), which takes matrices, for convolutions: each weight as (outputs, all else).

    Its steps are as long as AdamW's at the same learning rate (Liu et al., arXiv 2502.16982).
    """

    def __init__(self, weights: list[nn.Parameter], *, lr: float, weight_decay: float) -> None:
        self.weights = weights
        matrices = [nn.Parameter(_view_as_matrix(weight.detach())) for weight in weights]
        for weight, matrix in zip(weights, matrices, strict=True):
            if weight.data_ptr() != matrix.data_ptr():
                raise ValueError(f"weights must lie in memory channels last, got strides {weight.stride()}")
        super().__init__(matrices, lr=lr, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")

    def step(self) -> None:
        """Step with the convolutions' gradients."""
        for weight, matrix in zip(self.weights, self.param_groups[0]["params"], strict=True):
            matrix.grad = None if weight.grad is None else _view_as_matrix(weight.grad)
        super().step()

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Clear the convolutions' gradients too."""
        super().zero_grad(set_to_none)
        for weight in self.weights:
            weight.grad = None


def make_optimisers(network: nn.Module, others: list[nn.Parameter], config: TrainConfig) -> list[torch.optim.Optimizer]:
    """Optimisers that together step every trained parameter of ``network`` and ``others``.

    With ``config.optimiser`` "muon" the first is Muon, of the convolutions that neither work channel by channel nor
    make the descriptors themselves; AdamW has the rest, or everything.
    """
    settings = {"lr": config.learning_rate, "weight_decay": config.weight_decay}
    trained = [p for p in network.parameters() if p.requires_grad]
    if config.optimiser == "adamw":
        return [torch.optim.AdamW([*trained, *others], fused=True, **settings)]
    last = {m.weight for m in network.head.modules() if isinstance(m, nn.Conv2d) and m.kernel_size == (1, 1)}
    dense = {m.weight for m in network.modules() if isinstance(m, nn.Conv2d) and m.groups == 1} - last
    weights, rest = [p for p in trained if p in dense], [p for p in trained if p not in dense]
    return [ConvolutionMuon(weights, **settings), torch.optim.AdamW([*rest, *others], fused=True, **settings)]


def _view_as_matrix(weight: Tensor) -> Tensor:
    """(outputs, inputs, h, w) as (outputs, h * w * inputs): a view of what lies channels last."""
    return weight.permute(0, 2, 3, 1).flatten(1)
