"""Matching: heatmaps, entropy, the public Matcher's door and what its answer offers."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from heatmaps import CELL_PX, CELLS, CORNERS, SIZE, draw_mixture, one_cell
from PIL import Image
from safetensors.torch import save_file

from mmgsd import matching
from mmgsd.config import TrainConfig
from mmgsd.matching import Match, Matcher, compute_entropy, compute_heatmap, make_match, read_image
from mmgsd.mixture import Mixture
from mmgsd.network import build_network, compute_cell_centres

CONFIG = TrainConfig(input_px=64, descriptor_dim=8)


def test_heatmap_by_hand() -> None:
    squared = torch.tensor([[1.0, 2.0, 4.0, 4.0]]).log()
    torch.testing.assert_close(compute_heatmap(squared), torch.tensor([[0.5, 0.25, 0.125, 0.125]]))


def test_contrastive_heatmap_is_a_gaussian_of_distance() -> None:
    distance = torch.tensor([[0.0, 0.1, 0.3]])
    expected = torch.exp(-(distance**2) / (2 * 0.1**2))
    torch.testing.assert_close(compute_heatmap(distance**2, bandwidth=0.1), expected / expected.sum())


@pytest.mark.parametrize("bandwidth", [None, 0.2])
def test_temperature_is_a_power(bandwidth: float | None) -> None:
    squared = torch.tensor([[0.0, 0.5, 2.0, 0.1]])
    one, two = (compute_heatmap(squared, bandwidth=bandwidth, temperature=t) for t in (1.0, 2.0))
    torch.testing.assert_close(two, one.sqrt() / one.sqrt().sum())


def test_entropy_of_uniform_is_log_of_its_area() -> None:
    uniform = torch.full((2, CELLS * CELLS), 1 / CELLS**2)
    assert compute_entropy(uniform, CELL_PX**2).tolist() == pytest.approx([np.log(485 * 485)] * 2, rel=1e-5)


def test_entropy_of_one_cell_is_log_of_its_area() -> None:
    assert compute_entropy(one_cell(3, 4).flatten(1), CELL_PX**2).item() == pytest.approx(2 * np.log(CELL_PX))


def test_entropy_of_a_gaussian() -> None:
    entropy = compute_entropy(draw_mixture(CORNERS[:1] + 140, 30.0).flatten(1), CELL_PX**2)
    assert entropy.item() == pytest.approx(np.log(2 * np.pi * np.e * 30**2), abs=1e-3)


@pytest.fixture(scope="module")
def matcher() -> Matcher:
    """An untrained network: what comes out means nothing, and has the promised form."""
    torch.manual_seed(0)
    return Matcher(build_network("lite0", 8, pretrained=False), CONFIG, modes=4, size=SIZE, device="cpu")


def test_modes_are_read_as_round_as_the_training_says(matcher: Matcher, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, fit = [], matching.fit_modes

    def listen(*arguments: object, roundness: float) -> Mixture:
        asked.append(roundness)
        return fit(*arguments, roundness=roundness)

    monkeypatch.setattr(matching, "fit_modes", listen)
    image = np.zeros((64, 64, 3), np.uint8)
    matcher.match(image, image, [(5, 5)])
    monkeypatch.setattr(matcher, "config", dataclasses.replace(CONFIG, roundness=0.07))
    matcher.match(image, image, [(5, 5)])
    assert asked == [0.2, 0.07]


@pytest.fixture
def image(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (120, 160, 3), dtype=np.uint8)


def test_the_first_image_asks_and_the_second_answers() -> None:
    config = dataclasses.replace(CONFIG, roles=2, descriptor_dim=2)
    network = build_network("lite0", 2, roles=2, pretrained=False)
    matcher = Matcher(network, config, modes=1, size=(64, 64), device="cpu")
    asking, answering = torch.zeros(2, 4, 8, 8)
    asking[:2] = 3.0
    answering[2:, 5, 6] = 3.0  # the one cell that is a good target
    heatmap = matcher.compute_heatmaps(asking, answering, torch.tensor([[30.0, 30.0]]), (64, 64))[0]
    assert divmod(int(heatmap.argmax()), 8) == (5, 6) and heatmap.max() > 0.99


def save_weights(path: Path, network: torch.nn.Module, **metadata: str) -> Path:
    stored = {"format": "mmgsd-1", "config": json.dumps(dataclasses.asdict(CONFIG)), "modes": "4", "size": "[485, 485]"}
    save_file({k: v.contiguous() for k, v in network.state_dict().items()}, path, stored | metadata)
    return path


def test_match_has_the_promised_form(matcher: Matcher, rng: np.random.Generator) -> None:
    image0, image1 = (rng.integers(0, 256, (*shape, 3), dtype=np.uint8) for shape in ((90, 130), (300, 200)))
    match = matcher.match(image0, image1, xy=[(0, 0), (129, 89), (60.5, 40.25)])
    assert (match.modes.shape, match.weights.shape, match.covariances.shape) == ((3, 4, 2), (3, 4), (3, 4, 2, 2))
    assert (match.entropy.shape, match.heatmap.shape) == ((3,), (3, 300, 200))
    np.testing.assert_allclose(match.heatmap.sum((1, 2)), 1, rtol=1e-4)
    assert ((match.modes >= -0.5) & (match.modes <= [199.5, 299.5])).all()


def test_modes_follow_the_targets_size(matcher: Matcher, image: np.ndarray) -> None:
    double = np.repeat(np.repeat(image, 2, axis=0), 2, axis=1)
    one, two = (matcher.match(image, target, xy=[(50, 60)], n=1).modes[0, 0] for target in (image, double))
    np.testing.assert_allclose((two + 0.5) / 2 - 0.5, one, atol=0.5)


@pytest.mark.parametrize("form", ["rgba", "float32", "float64"])
def test_forms_of_one_image_give_one_answer(matcher: Matcher, image: np.ndarray, form: str) -> None:
    alpha = np.zeros((*image.shape[:2], 1), dtype=np.uint8)
    other = np.concatenate([image, alpha], -1) if form == "rgba" else (image / 255).astype(form)
    one, two = (matcher.match(source, image, xy=[(50, 60)]).modes for source in (image, other))
    np.testing.assert_array_equal(one, two)


def test_grey_is_three_equal_channels(matcher: Matcher, image: np.ndarray) -> None:
    grey = image[..., 0]
    one, two = (matcher.match(s, image, xy=[(50, 60)]).modes for s in (grey, np.stack([grey] * 3, -1)))
    np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("bad", [(160, 5), (5, 120), (-1, 5), (float("nan"), 5), (5, float("inf"))])
def test_pixels_outside_the_source(matcher: Matcher, image: np.ndarray, bad: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="xy must be finite and inside image0 of 160 x 120 px, got"):
        matcher.match(image, image, xy=[(3, 3), bad])


@pytest.mark.parametrize("bad", [(3, 4, 5), [(1, 2, 3)], 5, [[[1, 2]]]])
def test_pixels_of_another_shape(matcher: Matcher, image: np.ndarray, bad: object) -> None:
    with pytest.raises(ValueError, match=r"xy must be \(S, 2\) px, got shape"):
        matcher.match(image, image, xy=bad)


def test_no_pixel_no_answer(matcher: Matcher, image: np.ndarray) -> None:
    match = matcher.match(image, image, xy=[])
    assert (match.modes.shape, match.entropy.shape, match.heatmap.shape) == ((0, 4, 2), (0,), (0, 120, 160))


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (np.zeros((4, 4, 2), np.uint8), r"got shape \(4, 4, 2\)"),
        (np.zeros((0, 4, 3), np.uint8), r"got shape \(0, 4, 3\)"),
        (np.zeros((4, 4, 3), np.int64), "must be uint8 or float, got int64"),
        (np.full((4, 4, 3), 255.0), r"must lie in \[0, 1\], got 255.0 to 255.0"),
        (np.full((4, 4, 3), np.nan), r"must lie in \[0, 1\], got nan"),
    ],
)
@pytest.mark.parametrize("name", ["image0", "image1"])
def test_other_images(matcher: Matcher, image: np.ndarray, name: str, bad: np.ndarray, message: str) -> None:
    images = {"image0": image, "image1": image} | {name: bad}
    with pytest.raises(ValueError, match=f"{name} .*{message}"):
        matcher.match(**images, xy=[(1, 1)])


def test_saved_weights_give_the_same_answer(matcher: Matcher, image: np.ndarray, tmp_path: Path) -> None:
    loaded = Matcher.load(save_weights(tmp_path / "w.safetensors", matcher.network), device="cpu")
    one, two = (m.match(image, image[::-1], xy=[(50, 60)]).modes for m in (matcher, loaded))
    np.testing.assert_array_equal(one, two)
    assert (loaded.config, loaded.modes, loaded.size) == (CONFIG, 4, SIZE)


def test_missing_weights(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="none.safetensors does not exist: train a model"):
        Matcher.load(tmp_path / "none.safetensors")


@pytest.mark.parametrize("kept", [0, 5, 1000, -100])
def test_truncated_weights(matcher: Matcher, tmp_path: Path, kept: int) -> None:
    path = save_weights(tmp_path / "w.safetensors", matcher.network)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ValueError, match="w.safetensors is truncated or no safetensors file"):
        Matcher.load(path)


def test_foreign_weights(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(1)}, tmp_path / "foreign.safetensors")
    with pytest.raises(ValueError, match="foreign.safetensors holds no mmgsd weights: .*format None"):
        Matcher.load(tmp_path / "foreign.safetensors")


@pytest.mark.parametrize("changed", [{"network": "resnet34"}, {"descriptor_dim": 9}])
def test_weights_of_another_network(matcher: Matcher, tmp_path: Path, changed: dict) -> None:
    config = json.dumps(dataclasses.asdict(dataclasses.replace(CONFIG, **changed)))
    path = save_weights(tmp_path / "w.safetensors", matcher.network, config=config)
    with pytest.raises(ValueError, match="w.safetensors does not fit the network"):
        Matcher.load(path)


def test_contrastive_weights_have_a_bandwidth(matcher: Matcher) -> None:
    config = dataclasses.replace(CONFIG, method="pcl", margin=2.0)
    assert Matcher(matcher.network, config, modes=1, size=SIZE, device="cpu").bandwidth == 0.5
    assert matcher.bandwidth is None


def test_weights_carry_their_temperature(matcher: Matcher, image: np.ndarray, tmp_path: Path) -> None:
    path = save_weights(tmp_path / "w.safetensors", matcher.network, temperature="2.5")
    assert (Matcher.load(path, device="cpu").temperature, matcher.temperature) == (2.5, 1.0)
    calm, sure = (m.match(image, image[::-1], xy=[(50, 60)]) for m in (Matcher.load(path, device="cpu"), matcher))
    np.testing.assert_allclose(calm.cells, sure.cells**0.4 / (sure.cells**0.4).sum(), rtol=1e-3)


def test_the_number_of_modes_may_be_given_or_found(matcher: Matcher, image: np.ndarray) -> None:
    given, found = (matcher.match(image, image, xy=[(50, 60), (9, 9)], n=n) for n in (2, "auto"))
    assert given.modes.shape == (2, 2, 2)
    assert ((found.weights > 0).sum(1) >= 1).all()


def answer(cells: torch.Tensor, n: int | str) -> Match:
    """What a matcher with these heatmaps answers."""
    blank = np.zeros((485, 485, 3), np.uint8)
    centres = compute_cell_centres(SIZE, (CELLS, CELLS))
    return make_match(blank, blank, np.zeros((len(cells), 2), np.float32), cells, centres, n)


def test_best_is_the_narrowest_mode() -> None:
    std = np.array([30.0, 12.0, 20.0, 25.0])
    best = answer(draw_mixture(CORNERS, std), 4).best()
    np.testing.assert_allclose(best.xy, CORNERS[[1]], atol=0.5)
    np.testing.assert_allclose(best.spread_px, np.hypot(12, CELL_PX / np.sqrt(6)), rtol=0.02)


def test_best_of_as_many_as_there_are() -> None:
    best = answer(torch.cat([draw_mixture(CORNERS[:1], 12.0), draw_mixture(CORNERS[1:], 12.0)]), "auto").best()
    assert np.isfinite(best.xy).all()
    np.testing.assert_allclose(best.xy[0], CORNERS[0], atol=0.1)


def test_confidence_is_the_mass_near_a_mode() -> None:
    for std in (10.0, 20.0, 40.0):
        match = answer(draw_mixture(CORNERS[:1] + 140, std), 1)
        x, y = np.meshgrid(*(np.arange(485) - c for c in match.modes[0, 0]))
        near = match.heatmap[0][np.hypot(x, y) <= 20].sum()
        assert match.confidence(radius_px=20)[0, 0] == pytest.approx(near, abs=0.01)


def test_four_equal_modes_are_as_sure_as_one() -> None:
    one, four = (answer(draw_mixture(CORNERS[:n], 16.0), n).confidence() for n in (1, 4))
    np.testing.assert_allclose(four, np.full((1, 4), one[0, 0]), atol=0.01)


def test_a_weak_mode_is_less_sure() -> None:
    match = answer(draw_mixture(CORNERS[:2], 8.0, np.array([0.9, 0.1])), 2)
    confidence = match.confidence(radius_px=100)[0]
    np.testing.assert_allclose(confidence, [1, 0.2], atol=0.01)


def test_best_abstains_where_it_is_not_sure_enough() -> None:
    match = answer(torch.cat([draw_mixture(CORNERS[:1], 6.0), draw_mixture(CORNERS[:1], 60.0)]), 1)
    best = match.best(min_confidence=0.5)
    assert np.isfinite(best.xy[0]).all() and np.isnan(best.xy[1]).all()
    assert best.confidence[0] > 0.5 > best.confidence[1]


def test_best_of_nothing() -> None:
    assert answer(one_cell(3, 3)[:0], 4).best().xy.shape == (0, 2)


@pytest.mark.parametrize(("name", "bad"), [("min_confidence", 1.1), ("min_confidence", -1), ("radius_px", 0)])
def test_best_of_other_arguments(name: str, bad: float) -> None:
    with pytest.raises(ValueError, match=f"{name} must be .*, got {bad}"):
        answer(one_cell(3, 3), 1).best(**{name: bad})


def test_photographs_are_read_upright(tmp_path: Path) -> None:
    shown = np.zeros((4, 6, 3), np.uint8)
    shown[0] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # stored turned: to be turned by 90° clockwise when shown
    Image.fromarray(np.rot90(shown)).save(tmp_path / "photo.png", exif=exif)
    np.testing.assert_array_equal(read_image(tmp_path / "photo.png"), shown)
