"""Training: every method runs, a killed run ends with the same weights, what does not fit is refused."""

from __future__ import annotations

import dataclasses
import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from mmgsd.config import METHODS, TrainConfig
from mmgsd.dataset import hold_out, load_dataset
from mmgsd.files import LockedError, locked
from mmgsd.learn import training
from mmgsd.learn.checkpoints import CHECKPOINT, LOG, check_enough
from mmgsd.learn.objective import compute_loss, compute_sigma
from mmgsd.learn.training import compute_learning_rate, leave_out_pause, load_training_images, make_batch, train_model
from mmgsd.match.matcher import Matcher
from mmgsd.model.tensors import WEIGHTS, load_metadata
from mmgsd.model.weights import PLACES

TINY = TrainConfig(steps=3, batch=4, pairs=6, queries=16, input_px=64, descriptor_dim=8)
ONE_STEP, LONGER = dataclasses.replace(TINY, steps=1), dataclasses.replace(TINY, steps=4)
HANG_IN_STEP = 2

KILLED_RUN = f"""
import sys, time
from pathlib import Path
from mmgsd.learn import training
from mmgsd.config import TrainConfig, from_dict
import json

training.CHECKPOINT_SECONDS = 0
make_batch, calls = training.make_batch, []

def hang(*arguments):
    calls.append(1)
    if len(calls) > {HANG_IN_STEP}:
        print("in the middle of a step", flush=True)
        time.sleep(600)
    return make_batch(*arguments)

training.make_batch = hang
config = from_dict(TrainConfig, json.loads(sys.argv[1]))
training.train_model(config, Path(sys.argv[2]), Path(sys.argv[3]), device="cpu", progress=False)
"""


def train(config: TrainConfig, dataset: Path, folder: Path, **options: int) -> Path:
    return train_model(config, dataset, folder, device="cpu", progress=False, **options)


def train_and_kill(config: TrainConfig, dataset: Path, folder: Path) -> None:
    """Start training in a child process and kill it in the middle of a step, after some checkpoints."""
    arguments = [json.dumps(dataclasses.asdict(config)), str(dataset), str(folder)]
    command = [sys.executable, "-c", KILLED_RUN, *arguments]
    with subprocess.Popen(command, cwd=Path(training.__file__).parents[2], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout.readline() == "in the middle of a step\n"
        child.kill()
    assert child.returncode == -signal.SIGKILL


def test_the_log_holds_the_validation(cloth_dataset: Path, tmp_path: Path) -> None:
    weights = train(dataclasses.replace(TINY, method="spcl"), cloth_dataset, tmp_path / "watched", validate_every=2)
    rmse = pd.read_csv(tmp_path / "watched" / LOG).rmse_px
    assert rmse.notna().tolist() == [False, True, False]
    assert 0 < rmse[1] < 485
    other = train(dataclasses.replace(TINY, method="spcl"), cloth_dataset, tmp_path / "unwatched")
    assert "rmse_px" not in pd.read_csv(other.with_name(LOG))
    torch.testing.assert_close(load_file(other), load_file(weights), rtol=0, atol=0)  # watching changes nothing


@pytest.mark.parametrize("method", METHODS)
def test_every_method_trains(cloth_dataset: Path, tmp_path: Path, method: str) -> None:
    config = dataclasses.replace(TINY, method=method)
    weights = train(config, cloth_dataset, tmp_path / "model")
    log = pd.read_csv(tmp_path / "model" / LOG)
    assert log.step.tolist() == [1, 2, 3]
    assert np.isfinite(log.loss).all()
    assert all(torch.isfinite(value).all() for value in load_file(weights).values())
    matcher = Matcher.load(weights, device="cpu")
    assert (matcher.config, matcher.num_modes) == (config, 1 if method in ("pcl", "unimodal") else 4)
    assert not (tmp_path / "model" / CHECKPOINT).exists()


def test_a_finished_model_is_returned_as_it_is(cloth_dataset: Path, tmp_path: Path) -> None:
    weights = train(ONE_STEP, cloth_dataset, tmp_path)
    before = weights.stat().st_mtime_ns
    assert train(ONE_STEP, cloth_dataset, tmp_path) == weights
    assert weights.stat().st_mtime_ns == before


def test_test_images_alone_do_for_a_finished_model_and_not_for_a_new_one(cloth_dataset: Path, tmp_path: Path) -> None:
    weights = train(ONE_STEP, cloth_dataset, tmp_path / "model")
    alone = shutil.copytree(cloth_dataset, tmp_path / "alone")
    labels = load_dataset(alone, "test").labels
    labels.to_parquet(alone / "labels.parquet")
    info = json.loads((alone / "dataset.json").read_text()) | {"images": {"test": len(labels)}}
    (alone / "dataset.json").write_text(json.dumps(info))
    assert train(ONE_STEP, alone, tmp_path / "model") == weights
    with pytest.raises(ValueError, match="alone has no train images"):
        train(ONE_STEP, alone, tmp_path / "new")


def test_a_model_of_another_data_set_is_not_taken_for_this_one(cloth_dataset: Path, tmp_path: Path) -> None:
    train(ONE_STEP, cloth_dataset, tmp_path / "model")
    other = shutil.copytree(cloth_dataset, tmp_path / "other")
    info = json.loads((other / "dataset.json").read_text())
    info["config"] = {"seed": 99}
    (other / "dataset.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match="was trained on another data set"):
        train(ONE_STEP, other, tmp_path / "model")


def test_overwrite_trains_again_to_the_same_weights(cloth_dataset: Path, tmp_path: Path) -> None:
    first = train(ONE_STEP, cloth_dataset, tmp_path / "model").read_bytes()
    (tmp_path / "model" / "stale").touch()
    second = load_file(train(ONE_STEP, cloth_dataset, tmp_path / "model", overwrite=True))
    assert (tmp_path / "model" / "stale").exists()  # none of what training writes
    (tmp_path / "first.safetensors").write_bytes(first)
    torch.testing.assert_close(second, load_file(tmp_path / "first.safetensors"), rtol=0, atol=0)


@pytest.mark.parametrize("how", [{"overwrite": "perhaps"}, {"progress": "si"}, {"validate_every": "2"}])
def test_options_are_read_before_anything_is_touched(cloth_dataset: Path, tmp_path: Path, how: dict) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(how))} must be"):
        train_model(ONE_STEP, cloth_dataset, tmp_path / "model", **how)
    assert not list(tmp_path.iterdir())


def test_a_folder_is_trained_in_once_at_a_time(cloth_dataset: Path, tmp_path: Path) -> None:
    with locked(tmp_path / "model", "training"), pytest.raises(LockedError, match="model is in use by process"):
        train(ONE_STEP, cloth_dataset, tmp_path / "model")
    weights = train(ONE_STEP, cloth_dataset, tmp_path / "model")
    with locked(tmp_path / "model", "training"):  # what is finished is only read
        assert train(ONE_STEP, cloth_dataset, tmp_path / "model", overwrite="false") == weights
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_too_few_images_are_said_before_training(cloth_dataset: Path, tmp_path: Path) -> None:
    data = load_dataset(cloth_dataset)
    alone = dataclasses.replace(data, labels=data.labels.drop_duplicates("episode").reset_index(drop=True))
    with pytest.raises(ValueError, match="at least 2 training images of each simulation, or 30 simulations of one view "
                                         "each, .* got 3 images of 3 simulations"):  # fmt: skip
        check_enough(alone, hold_out(alone)[1])


def test_a_failing_calibration_costs_no_training(
    cloth_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> float:
        raise RuntimeError("no calibration")

    monkeypatch.setattr(training, "calibrate_temperature", fail)
    with pytest.raises(RuntimeError, match="no calibration"):
        train(ONE_STEP, cloth_dataset, tmp_path / "model")
    monkeypatch.undo()
    monkeypatch.setattr(training.Run, "advance", fail)  # all steps are done
    assert train(ONE_STEP, cloth_dataset, tmp_path / "model").is_file()


def test_stopping_says_what_is_kept(cloth_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(run: training.Run) -> float:
        raise KeyboardInterrupt

    monkeypatch.setattr(training.Run, "learn", lambda run, group: stop(run))
    with pytest.raises(KeyboardInterrupt, match="stopped after step 0; nothing is kept yet"):
        train(TINY, cloth_dataset, tmp_path / "model")


def test_training_starts_from_trained_weights(cloth_dataset: Path, tmp_path: Path) -> None:
    first = train(ONE_STEP, cloth_dataset, tmp_path / "first")
    config = dataclasses.replace(ONE_STEP, trunk_weights=str(first), seed=1, learning_rate=1e-9, input_px=96)
    went_on = load_file(train(config, cloth_dataset, tmp_path / "second"))
    beside = load_file(train(dataclasses.replace(config, trunk_weights="first"), cloth_dataset, tmp_path / "third"))
    assert all(torch.equal(went_on[name], value) for name, value in beside.items())
    for name, value in load_file(first).items():
        if not name.endswith(("running_mean", "running_var", "num_batches_tracked", PLACES)):
            torch.testing.assert_close(went_on[name], value, rtol=0, atol=1e-6)


def test_dense_supervision_goes_on_from_the_places_of_trained_weights(cloth_dataset: Path, tmp_path: Path) -> None:
    first = train(ONE_STEP, cloth_dataset, tmp_path / "first")
    config = dataclasses.replace(ONE_STEP, trunk_weights="first", learning_rate=1e-9)
    kept = {}

    class Kept(training.Run):
        def finish(self, weights: Path) -> Path:
            kept["prototypes"] = self.prototypes.detach()
            return super().finish(weights)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "Run", Kept)
        train(config, cloth_dataset, tmp_path / "second")
    places = load_file(first)[PLACES]
    assert places.shape == (625, 8)
    torch.testing.assert_close(kept["prototypes"], places, rtol=0, atol=1e-6)


def test_a_deeper_network_starts_from_a_shallower_one(cloth_dataset: Path, tmp_path: Path) -> None:
    shallow = train(ONE_STEP, cloth_dataset, tmp_path / "shallow")
    config = dataclasses.replace(ONE_STEP, network="lite0x2", trunk_weights="shallow", learning_rate=1e-9)
    deep = load_file(train(config, cloth_dataset, tmp_path / "deep"))
    torch.testing.assert_close(deep["head.weight"], load_file(shallow)["head.weight"], rtol=0, atol=1e-6)
    back = dataclasses.replace(ONE_STEP, trunk_weights="deep")
    with pytest.raises(ValueError, match="trunk_weights .* has network 'lite0x2', the training 'lite0'"):
        train(back, cloth_dataset, tmp_path / "back")


def test_weights_that_cannot_be_started_from(cloth_dataset: Path, tmp_path: Path) -> None:
    start = train(ONE_STEP, cloth_dataset, tmp_path / "model")
    for change, message in (
        ({"descriptor_dim": 4}, "trunk_weights .* has descriptor_dim 8, the training 4"),
        ({"roles": 2}, "trunk_weights .* has roles 1, the training 2"),
        ({"trunk_weights": "clth"}, "clth must be a safetensors file or one of 'cloth', "),
    ):
        config = dataclasses.replace(ONE_STEP, **{"trunk_weights": str(start), **change})
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            train(config, cloth_dataset, tmp_path / "model", overwrite=True)
    assert start.is_file()  # what is finished is deleted only where it can be made again


@pytest.mark.parametrize("optimiser", ["adamw", "muon"])
def test_a_killed_run_ends_with_the_same_weights(cloth_dataset: Path, tmp_path: Path, optimiser: str) -> None:
    config = dataclasses.replace(LONGER, optimiser=optimiser)
    train_and_kill(config, cloth_dataset, tmp_path / "killed")
    assert not (tmp_path / "killed" / WEIGHTS).exists()
    assert json.loads(load_metadata(tmp_path / "killed" / CHECKPOINT)["numbers"])["step"] == HANG_IN_STEP
    resumed = load_file(train(config, cloth_dataset, tmp_path / "killed"))
    undisturbed = load_file(train(config, cloth_dataset, tmp_path / "undisturbed"))
    torch.testing.assert_close(resumed, undisturbed, rtol=0, atol=0)
    assert pd.read_csv(tmp_path / "killed" / LOG).step.tolist() == list(range(1, LONGER.steps + 1))


def test_a_checkpoint_of_another_configuration(
    cloth_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0)
    monkeypatch.setattr(training.Run, "finish", lambda run, weights: weights)  # as if killed just before
    train(ONE_STEP, cloth_dataset, tmp_path)
    with pytest.raises(ValueError, match="checkpoint.safetensors belongs to another configuration: .*overwrite=True"):
        train(dataclasses.replace(ONE_STEP, seed=1), cloth_dataset, tmp_path)


@pytest.mark.parametrize("change", [{"object": "rope", "group": "c2"}, {"group": "c3"}])
def test_a_data_set_of_another_object_or_without_the_group(cloth_dataset: Path, tmp_path: Path, change: dict) -> None:
    with pytest.raises(ValueError, match="object is 'rope', but .* shows a cloth|group must be one of .*got 'c3'"):
        train(dataclasses.replace(TINY, **change), cloth_dataset, tmp_path)


def test_the_rope_trains(tiny_dataset: Callable[..., Path], tmp_path: Path) -> None:
    config = dataclasses.replace(TINY, object="rope", group="c2", steps=1)
    with safe_open(train(config, tiny_dataset(object="rope"), tmp_path / "model"), "pt") as file:
        assert (file.metadata()["modes"], file.metadata()["size"]) == ("2", "[640, 480]")


@pytest.mark.parametrize("roles", [1, 2])
def test_learns_a_single_batch(roles: int) -> None:
    """Descriptors that are free parameters come two nats closer than a uniform guess, ln 256."""
    config = dataclasses.replace(TINY, roles=roles, sigma_px=16.0, sigma_start_px=16.0, augment=False)
    xy = torch.tensor([[[60.0, 60], [420, 60], [420, 420], [60, 420]]] * 2)
    seen = torch.ones(2, 4, dtype=torch.bool)
    batch = training.Batch(torch.zeros(2, 3, 64, 64), torch.ones(2, 64, 64, dtype=torch.bool), xy, seen, seen)
    permutations = torch.tensor([[0, 1, 2, 3], [1, 2, 3, 0], [2, 3, 0, 1], [3, 0, 1, 2]])
    drawn = torch.randn(2, 8 * roles, 16, 16, generator=torch.Generator().manual_seed(0))
    descriptors = torch.nn.Parameter(0.1 * drawn)
    optimiser, values = torch.optim.Adam([descriptors], lr=0.1), []
    for _ in range(100):
        values.append(compute_loss(config, descriptors, batch, permutations, (485, 485), 0))
        optimiser.zero_grad()
        values[-1].backward()
        optimiser.step()
    assert values[-1] < values[0] - 2


@pytest.mark.parametrize("method", METHODS)
def test_roles_with_equal_descriptors_are_one_role(cloth_dataset: Path, method: str, rng: np.random.Generator) -> None:
    config = dataclasses.replace(TINY, method=method)
    data = load_dataset(cloth_dataset)
    batch = make_batch(load_training_images(data, 64), np.arange(4), config, rng, torch.device("cpu"))
    permutations = torch.tensor(data.group("c4").permutations)
    one = torch.randn(4, 8, 16, 16, generator=torch.Generator().manual_seed(0))
    two = torch.cat([one, one], 1).requires_grad_()
    losses = [compute_loss(dataclasses.replace(config, roles=roles), descriptors, batch, permutations, data.size, 0)
              for roles, descriptors in ((1, one), (2, two))]  # fmt: skip
    torch.testing.assert_close(losses[0], losses[1])
    losses[1].backward()
    assert two.grad[:, :8].any() and two.grad[:, 8:].any()


@pytest.mark.parametrize("method", ["pcl", "spcl"])
def test_noise_tells_no_match_from_a_non_match(
    cloth_dataset: Path, method: str, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a network learns how the two are sampled, not what they show: the shortest way to a small loss."""
    distances = []
    monkeypatch.setattr("mmgsd.learn.losses.pcl", lambda *both, margin: distances.append(both) or torch.zeros(()))
    data = load_dataset(cloth_dataset)
    config = dataclasses.replace(TINY, method=method, queries=256)
    batch = make_batch(load_training_images(data, 64), np.arange(4), config, rng, torch.device("cpu"))
    noise = torch.randn(4, 8, 16, 16, generator=torch.Generator().manual_seed(0))
    compute_loss(config, noise, batch, torch.tensor(data.group("c4").permutations), data.size, 0)
    [(match, valid, far, apart)] = distances
    assert match[valid].mean().item() == pytest.approx(far[apart].mean().item(), rel=0.03)


def test_hidden_points_are_not_asked(tiny_dataset: Callable[..., Path], rng: np.random.Generator) -> None:
    images = load_training_images(load_dataset(tiny_dataset(object="rope")), 64)
    config = dataclasses.replace(TINY, object="rope", group="c2", augment=False)
    batch = make_batch(images, np.arange(2), config, rng, torch.device("cpu"))
    np.testing.assert_array_equal(batch.askable, images.visible[:2])


def test_augmented_points_stay_on_their_mask(cloth_dataset: Path, rng: np.random.Generator) -> None:
    images = load_training_images(load_dataset(cloth_dataset), 128)
    batch = make_batch(images, np.arange(4), TINY, rng, torch.device("cpu"))
    scale = batch.mask.shape[-1] / images.size[0]
    inner = torch.arange(625).view(25, 25)[1:-1, 1:-1].flatten()  # the outline itself may fall on either side
    for mask, xy, inside in zip(batch.mask, batch.xy[:, inner], batch.inside[:, inner], strict=True):
        column, row = ((xy[inside] + 0.5) * scale - 0.5).round().long().clamp(0, mask.shape[-1] - 1).T
        assert mask[row, column].all()


def test_the_time_of_a_stopped_process_is_not_that_of_a_step() -> None:
    earlier = [2.0, 3.0, 4.1, 5.1]  # sums: steps of a second
    assert leave_out_pause(1.2, earlier) == 1.2 and leave_out_pause(700.0, earlier) == pytest.approx(20.0)
    assert leave_out_pause(9.0, [2.0]) == 9.0  # nothing tells how long a step takes


@pytest.mark.parametrize(("start", "end", "expected"), [(64.0, 1.0, [64, 8, 1, 1]), (4.0, 16.0, [16] * 4)])
def test_sigma_falls_to_its_final_value_and_never_starts_below_it(start: float, end: float, expected: list) -> None:
    config = TrainConfig(steps=300, sigma_px=end, sigma_start_px=start)
    assert [compute_sigma(config, s) for s in (0, 100, 200, 299)] == pytest.approx(expected)


def test_reference_schedule() -> None:
    config = TrainConfig(schedule="step", learning_rate=1e-4)
    assert [compute_learning_rate(config, s) for s in (0, 249, 250, 500)] == pytest.approx([1e-4, 1e-4, 9e-5, 8.1e-5])


def test_cosine_schedule_warms_up_and_ends_at_a_hundredth() -> None:
    config = TrainConfig(steps=1000, learning_rate=1.0)
    rates = [compute_learning_rate(config, s) for s in range(1001)]
    assert (rates[0], max(rates), rates[50], rates[1000]) == pytest.approx((0.02, 1.0, 1.0, 0.01), rel=0.01)


def test_dense_supervision_can_be_given_to_a_contrastive_loss(cloth_dataset: Path, tmp_path: Path) -> None:
    plain = dataclasses.replace(ONE_STEP, method="spcl")
    paths = [train(c, cloth_dataset, tmp_path / str(c.prototype_weight))
             for c in (plain, dataclasses.replace(plain, prototype_weight=1.0))]  # fmt: skip
    losses = [pd.read_csv(path.with_name(LOG)).loss[0] for path in paths]
    assert losses[1] > losses[0] + 1  # ln 625 = 6.4 where nothing is known
    assert (plain.dense_weight, ONE_STEP.dense_weight) == (0.0, 1.0)
