"""The one training loop for all methods, and its optimisers: AdamW, and Muon for the weights of convolutions."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.overrides import TorchFunctionMode
from torch.utils import deterministic

from mmgsd.checks import read_count, read_flag
from mmgsd.config import CONTRASTIVE, DETAILED, MATCHES_OF_ONE, PASSES, TrainConfig
from mmgsd.dataset import Dataset, hold_out, join_datasets, load_parts
from mmgsd.files import is_kept, saying_what_stays, write_text
from mmgsd.learn import distributed
from mmgsd.learn.augmentation import Batch, load_training_images, make_batch
from mmgsd.learn.checkpoints import (
    CHECKPOINT,
    LOG,
    check_enough,
    is_trained,
    read_checkpoint,
    remove_run,
    training_lock,
    write_checkpoint,
)
from mmgsd.learn.losses import compute_prototype_loss, make_prototypes
from mmgsd.learn.objective import compute_head_loss, compute_loss
from mmgsd.match.matcher import Matcher, load
from mmgsd.measure.calibration import calibrate_bandwidth, calibrate_modes, calibrate_temperature, describe_places
from mmgsd.measure.questions import measure_rmse
from mmgsd.model.network import build_network, find_device, has_bfloat16, name_hardware, sample_descriptors
from mmgsd.model.tensors import WEIGHTS, write_tensors
from mmgsd.model.weights import PLACES
from mmgsd.numerics import own_numerics
from mmgsd.progress import ProgressBar

PROTOTYPE_EVERY = 4  # each step asks every so many material points
CHECKPOINT_SECONDS = 60.0  # of training between two checkpoints
PAUSED = 20  # times the median step's seconds: a step that takes longer was paused


def compute_learning_rate(config: TrainConfig, step: int) -> float:
    """Warm-up and cosine decay, or the reference's 0.9 every 250 steps."""
    if config.schedule == "step":
        return config.learning_rate * 0.9 ** (step // 250)
    warm_up = max(1, config.steps // 20)
    progress = (step - warm_up) / max(1, config.steps - warm_up)
    cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, max(0.0, progress))))
    return config.learning_rate * (min(1.0, (step + 1) / warm_up) * (0.01 + 0.99 * cosine))


def leave_out_pause(taken: float, earlier: list[float]) -> float:
    """Seconds of a step; where the process was stopped meanwhile, as many as a step may take (`PAUSED`).

    ``earlier`` are the sums of all seconds after each of the steps before.
    """
    steps = np.diff(earlier)
    return min(taken, PAUSED * float(np.median(steps))) if len(steps) > 1 else taken


class Bfloat16AsFloat32(TorchFunctionMode):
    """Within it ``tensor.bfloat16()`` is a copy in float32: torch's Muon asks for nothing else."""

    def __torch_function__(self, function: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        """Call the function, or copy."""
        return args[0].float().clone() if function is Tensor.bfloat16 else function(*args, **(kwargs or {}))


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
        emulated = self.weights and not has_bfloat16(self.weights[0].device)
        with Bfloat16AsFloat32() if emulated else nullcontext():
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


@own_numerics(gradients=True)
def train_model(
    config: TrainConfig, dataset: Path, folder: Path, *,
    overwrite: bool = False, device: str = "", progress: bool = True, validate_every: int = 0,
) -> Path:  # fmt: skip
    """Train one model on the data set's training split; returns the path of its weights (safetensors).

    The log (CSV) has a row a step; with ``validate_every`` steps, also the RMSE (px) on held-out simulations.

    Under ``torchrun`` the processes share every step's groups (``config.groups`` must be a multiple of their number),
    and the first one writes the files. The losses and gradients are those of a single process.

    A finished model is returned as it is, a killed run goes on from its last checkpoint and ends with the same weights.
    ``overwrite`` removes weights, checkpoint and log of the folder, nothing else.
    On a CPU two runs on as many threads give the same weights to the last bit; on a GPU they do not.
    Raises ValueError where the data set is of another object, does not store the symmetry group or has too few images,
    and where ``config.trunk_weights`` are of another network; FileNotFoundError where there are none; LockedError while
    another process trains in the folder.
    """
    overwrite, progress = read_flag("overwrite", overwrite), read_flag("progress", progress)
    validate_every, folder = read_count("validate_every", validate_every), Path(folder)
    weights = folder / WEIGHTS
    if not overwrite and is_trained(weights, dataset, also=config.also):
        return weights
    parts = load_parts(dataset, "train", also=config.also)
    if parts[0].object != config.object:
        raise ValueError(f"object is {config.object!r}, but {dataset} shows a {parts[0].object}")
    with distributed.joined(config.groups, find_device(device)) as world, training_lock(folder, world), (
        repeatable(world.device)
    ):  # fmt: skip
        # by the process that held the folder before
        if not overwrite and is_trained(weights, dataset, also=config.also):
            return weights
        run = Run(config, parts, folder, world, validate_every)  # what is wrong is said before anything is deleted
        if overwrite and world.rank == 0:
            remove_run(folder)
        world.wait()
        run.resume()
        show_bar = progress and world.rank == 0
        bar = ProgressBar(range(run.step, config.steps), desc=config.name, disable=not show_bar, leave=False)
        with saying_what_stays(run.describe_kept):
            for _ in bar:
                bar.set_postfix(loss=f"{run.advance():.3f}", refresh=False)
            if world.rank == 0:
                run.finish(weights)
        world.wait()
    return weights


class Run:
    """A training run that can be killed between any two steps.

    What derives from it learns from something else: it calls `start` in its own ``__init__``, with what is set there.
    """

    frozen_statistics = False  # of batch normalisation

    def __init__(
        self, config: TrainConfig, parts: list[Dataset], folder: Path, world: distributed.World, validate_every: int = 0
    ) -> None:
        self.config, self.folder, self.world, self.validate_every = config, folder, world, validate_every
        # the latter for calibration
        self.data, self.held_out = (join_datasets(*split) for split in zip(*map(hold_out, parts), strict=True))
        check_enough(self.data, self.held_out)
        self.device, self.size = world.device, self.data.size
        permutations = self.data.group(config.group).permutations
        permutations = permutations[:1] if config.method in MATCHES_OF_ONE else permutations
        self.permutations = torch.tensor(permutations, device=self.device)
        self.images = load_training_images(self.data, config.input_px)
        torch.manual_seed(config.seed)
        network, prototypes = _make_network(config, folder.parent)
        if prototypes is None or prototypes.shape != (self.data.n_points, config.descriptor_dim):
            prototypes = make_prototypes(self.data.xy, permutations, config.descriptor_dim, math.hypot(*self.size))
        self.start(network, prototypes, span=config.steps / 50)

    def start(self, network: nn.Module, prototypes: Tensor, *, span: float) -> None:
        """Before the first step; ``config``, ``folder``, ``world`` and ``device`` are set. ``span`` of the average."""
        self.network = network.to(self.device, memory_format=torch.channels_last)
        # the average of the last steps' weights, statistics of batch normalisation included, is what is kept
        average = get_ema_multi_avg_fn(1 - 1 / max(2.0, span))
        self.average = AveragedModel(self.network, multi_avg_fn=average, use_buffers=True)
        self.prototypes = nn.Parameter(prototypes.to(self.device))
        self.trained = [p for p in self.network.parameters() if p.requires_grad]
        self.optimisers = make_optimisers(self.network, [self.prototypes], self.config)
        self.step, self.seconds, self.saved_at, self.saved_step, self.log = 0, 0.0, 0.0, 0, []

    def advance(self) -> float:
        """One optimiser step, after which the run is validated and saved where it is time."""
        start = time.perf_counter()
        self.network.train(not self.frozen_statistics)
        for optimiser in self.optimisers:
            optimiser.param_groups[0]["lr"] = compute_learning_rate(self.config, self.step)
            optimiser.zero_grad(set_to_none=True)
        loss = self.world.add(sum(self.learn(group) for group in self.world.batch_parts))
        self.world.share_gradients([*self.trained, self.prototypes])
        nn.utils.clip_grad_norm_(self.trained, 5.0)
        for optimiser in self.optimisers:
            optimiser.step()
        self.average.update_parameters(self.network)
        self.step += 1
        self.seconds += leave_out_pause(time.perf_counter() - start, [row["seconds"] for row in self.log[-50:]])
        self.log.append({"step": self.step, "loss": loss, "seconds": round(self.seconds, 2)})
        if self.world.rank == 0:
            if self.validate_every and self.step % self.validate_every == 0:
                self.log[-1]["rmse_px"] = round(measure_rmse(self.make_matcher(), self.held_out), 2)
            if self.seconds - self.saved_at >= CHECKPOINT_SECONDS:
                self.save()
        return loss

    def learn(self, group: int) -> float:
        """Add the gradients of one group of the step's batch to the parameters'; returns its share of the loss."""
        count, (seed, step, groups) = len(self.images.images), (self.config.seed, self.step, self.config.groups)
        chosen = np.random.default_rng([seed, step]).choice(count, self.config.batch, count < self.config.batch)
        own = np.array_split(chosen, groups)[group]
        batch = make_batch(self.images, own, self.config, np.random.default_rng([seed, step, group]), self.device)
        outputs = self.network.describe(batch.image.contiguous(memory_format=torch.channels_last))
        loss = compute_loss(self.config, outputs.descriptors, batch, self.permutations, self.size, step, group)
        if self.config.dense_weight:
            loss = loss + self.config.dense_weight * self.compute_dense_loss(outputs.descriptors, batch)
        if self.config.heads:
            seeds = torch.Generator(self.device).manual_seed(-1 - (seed * 1_000_003 + step) * groups - group)
            loss = loss + compute_head_loss(self.network.heads, outputs, batch, self.permutations, self.size, seeds)
        (loss / groups).backward()
        return loss.item() / groups

    def compute_dense_loss(self, descriptors: Tensor, batch: Batch) -> Tensor:
        """The prototypes' loss, on a part of the material points in turn."""
        turn = torch.arange(batch.askable.shape[1], device=self.device) % PROTOTYPE_EVERY
        askable = batch.askable & (turn == self.step % PROTOTYPE_EVERY)
        sampled = sample_descriptors(descriptors[:, : self.config.descriptor_dim], batch.xy, self.size)
        return compute_prototype_loss(sampled, askable, self.prototypes, self.permutations)

    def make_matcher(self) -> Matcher:
        """A matcher of the averaged weights; of a contrastive loss, its bandwidth calibrated."""
        modes = len(self.permutations)
        matcher = Matcher(self.average.module, self.config, modes=modes, size=self.size, device=self.device.type)
        if self.config.method in CONTRASTIVE:
            calibrate_bandwidth(matcher, self.held_out)
        return matcher

    def save(self) -> None:
        """Write a checkpoint whole or not at all."""
        tensors = {"prototypes": self.prototypes.detach()}
        for part in ("network", "average"):
            tensors |= {f"{part}/{name}": value for name, value in getattr(self, part).state_dict().items()}
        for number, optimiser in enumerate(self.optimisers):
            for index, values in optimiser.state_dict()["state"].items():
                tensors |= {f"optimisers/{number}/{index}/{name}": value for name, value in values.items()}
        numbers = {"step": self.step, "seconds": self.seconds, "log": self.log}
        write_checkpoint(self.folder / CHECKPOINT, tensors, self._describe_config(), numbers)
        self.saved_at, self.saved_step = self.seconds, self.step

    def describe_kept(self) -> str:
        """What is on disk of a run that is stopped."""
        resumable = f"its checkpoint of step {self.saved_step} is kept in {self.folder}: call again without overwrite"
        return f"training was stopped after step {self.step}; {resumable if self.saved_step else 'nothing is kept yet'}"

    def resume(self) -> None:
        """Go on from the folder's checkpoint, if there is one; ValueError where it is of another configuration."""
        path = self.folder / CHECKPOINT
        if self.world.rank == 0:  # sets a damaged one aside before any process goes on
            is_kept(path, lambda file: read_checkpoint(file, str(self.device)))
        self.world.wait()
        if not path.is_file():
            return
        tensors, metadata = read_checkpoint(path, str(self.device))
        if metadata["config"] != self._describe_config():
            raise ValueError(f"{path} belongs to another configuration: choose another folder or overwrite=True")
        self.prototypes.data.copy_(tensors.pop("prototypes"))
        parts = {"network": {}, "average": {}, "optimisers": {}}
        for name, value in tensors.items():
            part, rest = name.split("/", 1)
            parts[part][rest] = value
        self.network.load_state_dict(parts["network"])
        self.average.load_state_dict(parts["average"])
        states = [{} for _ in self.optimisers]
        for name, value in parts["optimisers"].items():
            number, index, field = name.split("/")
            # the fused step takes for granted that moments lie in memory as their parameter does
            like = self.optimisers[int(number)].param_groups[0]["params"][int(index)]
            value = torch.empty_like(like).copy_(value) if value.ndim else value
            states[int(number)].setdefault(int(index), {})[field] = value
        for optimiser, state in zip(self.optimisers, states, strict=True):
            optimiser.load_state_dict({**optimiser.state_dict(), "state": state})
        numbers = json.loads(metadata["numbers"])
        self.step, self.seconds, self.log = numbers["step"], numbers["seconds"], numbers["log"]
        self.saved_at, self.saved_step = self.seconds, self.step

    def _describe_config(self) -> str:
        return json.dumps(dataclasses.asdict(self.config))

    def finish(self, weights: Path) -> Path:
        """Write log and weights, the weights last: a folder that has them is finished.

        The trained weights are in a checkpoint before they are calibrated: what fails there costs no training.
        """
        if self.saved_step < self.step:
            self.save()
        write_text(self.folder / LOG, pd.DataFrame(self.log).to_csv(index=False))
        metadata = {
            "format": "mmgsd-1",
            "config": json.dumps(dataclasses.asdict(self.config)),
            "size": json.dumps(self.size),
            "modes": str(len(self.permutations)),
            "data": self.data.fingerprint,
            "images": str(len(self.data)),
            "seconds": f"{self.seconds:.1f}",
            "hardware": name_hardware(self.device),
        }
        matcher = self.make_matcher()
        if matcher.bandwidth is not None:
            metadata["bandwidth"] = repr(matcher.bandwidth)
        metadata["temperature"] = repr(calibrate_temperature(matcher, self.held_out))
        calibration = calibrate_modes(matcher, self.held_out)
        if calibration is not None:
            metadata["calibration"] = calibration.to_json()
        places = describe_places(matcher, self.held_out).cpu()
        write_tensors(weights, {**self.average.module.state_dict(), PLACES: places}, metadata)
        (self.folder / CHECKPOINT).unlink(missing_ok=True)
        return weights


@contextmanager
def repeatable(device: torch.device) -> Iterator[None]:
    """Sums in the same order every time, on a CPU: a GPU has no such kernel for the gradient of sampling."""
    before, filled = torch.are_deterministic_algorithms_enabled(), deterministic.fill_uninitialized_memory
    torch.use_deterministic_algorithms(before or device.type == "cpu")
    deterministic.fill_uninitialized_memory = False  # a seventh of a step went into memory that is overwritten at once
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)
        deterministic.fill_uninitialized_memory = filled


def check_start(config: TrainConfig, models: Path) -> None:
    """ValueError where ``config.trunk_weights`` do not fit the network, FileNotFoundError where there are none.

    ``models`` is the folder that a model's name is looked for in, before data/weights.
    """
    _make_network(config, models)


def _make_network(config: TrainConfig, models: Path) -> tuple[nn.Module, Tensor | None]:
    """The network as training starts from it, and the object's places if the weights it goes on from know them.

    ``models`` is the folder of the models trained beside it.
    """
    start, beside, places = config.trunk_weights, models / config.trunk_weights / WEIGHTS, None
    start = str(beside) if start and beside.is_file() else start
    parts = {"roles": config.roles, "heads": config.heads, "trunk_weights": start}
    network = build_network(config.network, config.descriptor_dim, **parts)
    if start and config.network in PASSES:  # of a model of ours; resnet34 has read torchvision's
        trained = load(start, device="cpu")
        for name in ("network", "descriptor_dim", "roles"):
            theirs, ours = getattr(trained.config, name), getattr(config, name)
            within = name == "network" and PASSES.get(theirs, math.inf) <= PASSES[ours] and theirs not in DETAILED
            if theirs != ours and not within:
                raise ValueError(f"trunk_weights {start!r} has {name} {theirs!r}, the training {ours!r}")
        network.start_from(trained.network)
        places = trained.places
    return network, places
