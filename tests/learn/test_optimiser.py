"""Optimisers: every trained parameter is stepped once, Muon steps convolutions as the matrices they are."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import nn

from mmgsd.config import NETWORKS, TrainConfig
from mmgsd.learn import training
from mmgsd.learn.training import ConvolutionMuon, make_optimisers
from mmgsd.model.network import build_network

MUON = TrainConfig(optimiser="muon", learning_rate=0.01, weight_decay=0.0)


def make_weight(*shape: int) -> nn.Parameter:
    return nn.Parameter(torch.randn(shape).contiguous(memory_format=torch.channels_last))


@pytest.mark.parametrize("optimiser", ["adamw", "muon"])
@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("roles", [1, 2])
def test_every_trained_parameter_moves_and_no_other(optimiser: str, network: str, roles: int) -> None:
    torch.manual_seed(0)
    model = build_network(network, 4, roles=roles, pretrained=network != "resnet34")
    model = model.to(memory_format=torch.channels_last)
    other = nn.Parameter(torch.ones(3, 4))
    optimisers = make_optimisers(model, [other], dataclasses.replace(MUON, optimiser=optimiser))
    assert len(optimisers) == 1 + (optimiser == "muon")
    parameters = {**dict(model.named_parameters()), "other": other}
    before = {name: p.detach().clone() for name, p in parameters.items()}
    for p in parameters.values():
        p.grad = torch.randn_like(p) if p.requires_grad else None
    for each in optimisers:
        each.step()
    assert all(torch.equal(p, before[name]) != p.requires_grad for name, p in parameters.items())
    for each in optimisers:
        each.zero_grad()
    assert all(p.grad is None for p in parameters.values())


def test_muon_has_the_convolutions_that_mix_channels_but_for_the_descriptors() -> None:
    model = build_network("lite0", 4, roles=2).to(memory_format=torch.channels_last)
    names = {id(p): name for name, p in model.named_parameters()}
    had = {names[id(weight)] for weight in make_optimisers(model, [], MUON)[0].weights}
    assert {"merge.0.0.weight", "head.target.0.0.weight", "trunk._blocks.9._expand_conv.weight"} < had
    assert not any(name.endswith(("_depthwise_conv.weight", "bias")) for name in had)
    assert not had & {"head.source.weight", "head.target.1.weight", "trunk._blocks.1._expand_conv.weight"}


def test_muon_steps_are_orthogonal_and_as_long_as_said() -> None:
    weight = make_weight(8, 6, 3, 3)
    before, weight.grad = weight.detach().clone(), torch.randn(8, 6, 3, 3)
    ConvolutionMuon([weight], lr=0.01, weight_decay=0.0).step()
    step = (before - weight.detach()).flatten(1) / 0.01
    values = torch.linalg.svdvals(step)  # Newton and Schulz's iteration leaves them between 0.7 and 1.2 or so
    torch.testing.assert_close(values, torch.full_like(values, 0.2 * 54**0.5), rtol=0.4, atol=0)


def test_muon_steps_in_float32_where_there_is_no_bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    gradient, steps = torch.randn(8, 6, 3, 3), {}
    first = make_weight(8, 6, 3, 3).detach()
    for there in (True, False):
        monkeypatch.setattr(training, "has_bfloat16", lambda device, there=there: there)
        weight = nn.Parameter(first.clone())
        weight.grad = gradient.clone()
        ConvolutionMuon([weight], lr=0.01, weight_decay=0.0).step()
        steps[there] = weight.detach() - first
    torch.testing.assert_close(steps[False], steps[True], rtol=0, atol=0.05 * steps[True].abs().max().item())
    assert not torch.equal(steps[False], steps[True])


def test_muon_does_not_care_how_a_gradient_lies_in_memory() -> None:
    first = make_weight(8, 6, 3, 3)
    second, gradient = nn.Parameter(first.detach().clone()), torch.randn(8, 6, 3, 3)
    first.grad, second.grad = gradient, gradient.contiguous(memory_format=torch.channels_last)
    for weight in (first, second):
        ConvolutionMuon([weight], lr=0.01, weight_decay=0.0).step()
    assert torch.equal(first, second)


def test_muon_refuses_weights_that_it_would_copy() -> None:
    with pytest.raises(ValueError, match="weights must .*got strides"):
        ConvolutionMuon([nn.Parameter(torch.randn(8, 6, 3, 3))], lr=0.01, weight_decay=0.0)
