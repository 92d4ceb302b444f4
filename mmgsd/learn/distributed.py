"""Several processes that train one model, started by ``torchrun``: each takes some groups of every step's batch.

Pairs of images never reach across groups: the descriptors of another process's images, and gradients through them,
would have to travel at each step, and a group of 16 images has 240 ordered pairs already. So the groups are part of the
configuration, and the number of processes changes nothing but the time.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import psutil
import torch
from torch import distributed as dist

INTERFACES = ("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME")  # what names the network interface to talk over


@dataclass(frozen=True)
class World:
    """The processes of a run, seen from one of them."""

    device: torch.device
    batch_parts: tuple[int, ...]  # of each batch, that are this process's own
    rank: int = 0
    size: int = 1

    def add(self, value: float) -> float:
        """The sum of a number over all processes."""
        if self.size == 1:
            return value
        total = torch.tensor(value, dtype=torch.float64, device=self.device)
        dist.all_reduce(total)
        return total.item()

    def share_gradients(self, parameters: list[torch.nn.Parameter]) -> None:
        """Sum the gradients of all processes, in one message."""
        gradients = [p.grad for p in parameters if p.grad is not None]
        if self.size == 1 or not gradients:
            return
        flat = torch.cat([g.flatten() for g in gradients])
        dist.all_reduce(flat)
        for gradient, summed in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(summed.view_as(gradient))

    def wait(self) -> None:
        """Until all processes are here."""
        if self.size > 1:
            dist.barrier()


@contextmanager
def joined(groups: int, device: str) -> Iterator[World]:
    """The world that torchrun started, or this process alone; ValueError where it cannot share ``groups`` evenly."""
    rank, size = (int(os.environ.get(name, default)) for name, default in (("RANK", 0), ("WORLD_SIZE", 1)))
    if groups % size:
        raise ValueError(f"groups must be a multiple of the {size} processes, got {groups}")
    place = torch.device(device)
    if place.type == "cuda" and size > 1:
        place = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
        torch.cuda.set_device(place)
    world = World(place, tuple(range(rank, groups, size)), rank, size)
    if size == 1:
        yield world
        return
    with _on_this_machine():
        dist.init_process_group("nccl" if place.type == "cuda" else "gloo")
        try:
            yield world
        finally:
            dist.destroy_process_group()


@contextmanager
def _on_this_machine() -> Iterator[None]:
    """Let processes that all run here listen on the loopback interface alone, where the user names no other."""
    before = {name: os.environ.get(name) for name in INTERFACES}
    if os.environ.get("LOCAL_WORLD_SIZE") == os.environ.get("WORLD_SIZE"):
        addresses = psutil.net_if_addrs().items()
        loopback = [name for name, entries in addresses if any(one.address == "127.0.0.1" for one in entries)]
        os.environ.update({name: loopback[0] for name in INTERFACES if loopback and before[name] is None})
    try:
        yield
    finally:
        for name in (name for name in INTERFACES if before[name] is None):
            os.environ.pop(name, None)
