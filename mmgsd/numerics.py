"""Numbers as this library means them, whatever a caller has set for the rest of a program."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np

_LAYERS = threading.RLock()


@contextmanager
def numpy_defaults() -> Iterator[None]:
    """What NumPy does by itself about underflow and the like."""
    with np.errstate(divide="warn", over="warn", under="ignore", invalid="warn"):
        yield


@contextmanager
def own_numerics(*, gradients: bool = False) -> Iterator[None]:
    """No autocast but a network's own, tensors on the CPU unless told otherwise, and ``gradients`` or none at all.

    Each is a thread's own setting. torch's default dtype is not: tensors are made with their dtype instead.
    """
    import torch  # what needs NumPy alone does without

    with ExitStack() as stack:
        stack.enter_context(numpy_defaults())
        stack.enter_context(torch.inference_mode(not gradients))
        stack.enter_context(torch.set_grad_enabled(gradients))
        for kind in ("cpu", "cuda"):
            if torch.is_autocast_enabled(kind):  # whose cache would keep weights that a training step has changed
                stack.enter_context(torch.autocast(kind, enabled=False, cache_enabled=False))
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))
        yield


@contextmanager
def float32_layers() -> Iterator[None]:
    """Layers of torch are made in single precision, and draw as it does: they take no dtype, but the process's."""
    import torch

    with _LAYERS, own_numerics(gradients=True):
        before = torch.get_default_dtype()
        torch.set_default_dtype(torch.float32)
        try:
            yield
        finally:
            torch.set_default_dtype(before)
