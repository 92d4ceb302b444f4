"""Matching: heatmaps, entropy, and the public Matcher's door."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from heatmaps import CELL_PX, CELLS, CORNERS, SIZE, draw_mixture, one_cell
from PIL import Image

from mmgsd.config import NETWORKS, TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.match import heatmap as heatmaps_of
from mmgsd.match import matcher as matching
from mmgsd.match.baselines import BaselineMatcher
from mmgsd.match.em import ModeReadout
from mmgsd.match.heatmap import compute_entropy, compute_heatmap, make_match, read_heatmap
from mmgsd.match.matcher import Matcher, load
from mmgsd.match.mixture import Mixture
from mmgsd.measure.metrics import compute_query_errors
from mmgsd.model.heads import Outputs
from mmgsd.model.network import build_network, compute_cell_centres

CONFIG = TrainConfig(input_px=64, descriptor_dim=8)
ROOT = Path(__file__).parents[2]


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


def test_entropy_is_the_log_of_an_area() -> None:
    uniform, gaussian = torch.full((1, CELLS, CELLS), 1 / CELLS**2), draw_mixture(CORNERS[:1] + 140, 30.0)
    entropy = compute_entropy(torch.cat([uniform, one_cell(3, 4), gaussian]).flatten(1), CELL_PX**2)
    areas = [485 * 485, CELL_PX**2, 2 * np.pi * np.e * 30**2]
    assert entropy.tolist() == pytest.approx(np.log(areas).tolist(), abs=1e-3)


@pytest.fixture(scope="module")
def matcher() -> Matcher:
    """An untrained network: what comes out means nothing, and has the promised form."""
    torch.manual_seed(0)
    return Matcher(build_network("lite0", 8, pretrained=False), CONFIG, modes=4, size=SIZE, device="cpu")


def test_a_photograph_gives_one_answer_by_path_by_pillow_and_as_pixels(
    matcher: Matcher, tmp_path: Path, rng: np.random.Generator
) -> None:
    shown, exif, path = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8), Image.Exif(), tmp_path / "towel.png"
    exif[0x0112] = 6  # stored turned
    Image.fromarray(np.rot90(shown)).save(path, exif=exif)
    expected = matcher.match(shown, shown, [(60, 5)])
    with Image.open(path) as opened:
        for image in (path, str(path), opened):
            answer = matcher.match(image, image, [(60, 5)])
            np.testing.assert_array_equal(answer.image1, shown)
            np.testing.assert_array_equal(answer.modes, expected.modes)


def test_modes_are_read_as_round_as_the_training_says(matcher: Matcher, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, fit = [], heatmaps_of.fit_modes

    def listen(*arguments: object, readout: ModeReadout, **others: object) -> Mixture:
        asked.append(readout)
        return fit(*arguments, readout=readout, **others)

    monkeypatch.setattr(heatmaps_of, "fit_modes", listen)
    image = np.zeros((64, 64, 3), np.uint8)
    matcher.match(image, image, [(5, 5)])
    config = dataclasses.replace(CONFIG, roundness=0.07)
    other = Matcher(matcher.network, config, modes=4, size=SIZE, device="cpu", power=1.5, sharpness=3.0)
    other.match(image, image, [(5, 5)])
    assert asked == [ModeReadout(0.2), ModeReadout(0.07, 1.5, 3.0)]


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
    said = Outputs(asking), Outputs(answering)
    heatmap = matcher.compute_heatmaps(*said, torch.tensor([[30.0, 30.0]]), (64, 64))[0]
    assert divmod(int(heatmap.argmax()), 8) == (5, 6) and heatmap.max() > 0.99


def test_match_has_the_promised_form(matcher: Matcher, rng: np.random.Generator) -> None:
    image0, image1 = (rng.integers(0, 256, (*shape, 3), dtype=np.uint8) for shape in ((90, 130), (300, 200)))
    match = matcher.match(image0, image1, xy=[(0, 0), (129, 89), (60.5, 40.25)])
    assert (match.modes.shape, match.weights.shape, match.covariances.shape) == ((3, 4, 2), (3, 4), (3, 4, 2, 2))
    assert (match.entropy.shape, match.heatmap.shape) == ((3,), (3, 300, 200))
    np.testing.assert_allclose(match.heatmap.sum((1, 2)), 1, rtol=1e-4)
    assert ((match.modes >= -0.5) & (match.modes <= [199.5, 299.5])).all()


def test_modes_follow_the_targets_size(matcher: Matcher, image: np.ndarray) -> None:
    double = np.repeat(np.repeat(image, 2, axis=0), 2, axis=1)
    sure = Matcher(matcher.network, CONFIG, modes=4, size=SIZE, device="cpu", temperature=0.01)  # of one peak
    one, two = (sure.match(image, target, xy=[(50, 60)], n=1).modes[0, 0] for target in (image, double))
    np.testing.assert_allclose((two + 0.5) / 2 - 0.5, one, atol=0.5)


def test_forms_of_one_image_give_one_answer(matcher: Matcher, image: np.ndarray) -> None:
    rgba = np.concatenate([image, np.zeros((*image.shape[:2], 1), np.uint8)], -1)
    expected, *others = (matcher.match(source, image, xy=[(50, 60)]).modes for source in (image, rgba, image / 255))
    for modes in others:
        np.testing.assert_array_equal(modes, expected)


@pytest.mark.parametrize("bad", [(160, 5), (-1, 5), (float("nan"), 5), (3, 4, 5), [[[1, 2]]]])
def test_what_is_no_pixel_of_the_source(matcher: Matcher, image: np.ndarray, bad: object) -> None:
    with pytest.raises(ValueError, match="^xy must be .*got"):
        matcher.match(image, image, xy=bad)


def test_no_pixel_no_answer(matcher: Matcher, image: np.ndarray) -> None:
    match = matcher.match(image, image, xy=[])
    assert (match.modes.shape, match.entropy.shape, match.heatmap.shape) == ((0, 4, 2), (0,), (0, 120, 160))


@pytest.mark.parametrize("bad", [np.zeros((4, 4, 2), np.uint8), np.zeros((40, 4000, 3), np.uint8)], ids=["2", "strip"])
@pytest.mark.parametrize("name", ["image0", "image1"])
def test_other_images(matcher: Matcher, image: np.ndarray, name: str, bad: np.ndarray) -> None:
    images = {"image0": image, "image1": image} | {name: bad}
    with pytest.raises(ValueError, match=f"{name} .*got .*{bad.shape[0]}"):
        matcher.match(**images, xy=[(1, 1)])


def test_contrastive_weights_have_a_bandwidth(matcher: Matcher) -> None:
    config = dataclasses.replace(CONFIG, method="pcl", margin=2.0)
    assert Matcher(matcher.network, config, modes=1, size=SIZE, device="cpu").bandwidth == 0.5
    assert matcher.bandwidth is None


def test_the_number_of_modes_may_be_given_or_found(matcher: Matcher, image: np.ndarray) -> None:
    given, found = (matcher.match(image, image, xy=[(50, 60), (9, 9)], n=n) for n in (2, "auto"))
    assert given.modes.shape == (2, 2, 2)
    assert ((found.weights > 0).sum(1) >= 1).all()


@pytest.mark.parametrize("bad", [-1.0, 0, float("nan"), float("inf"), "1", True])
@pytest.mark.parametrize("name", ["bandwidth", "temperature"])
def test_a_scale_is_finite_and_positive(matcher: Matcher, name: str, bad: object) -> None:
    for ask in (
        lambda: compute_heatmap(torch.ones(1, 4), **{name: bad}),
        lambda: Matcher(matcher.network, CONFIG, modes=4, size=SIZE, device="cpu", **{name: bad}),
    ):
        with pytest.raises(ValueError, match=f"{name} must .*got {bad!r}"):
            ask()


@pytest.mark.parametrize("bad", [0, -1, 10**6, True, 2.0, "4", None])
def test_a_model_has_a_number_of_modes(matcher: Matcher, bad: object) -> None:
    with pytest.raises(ValueError, match=f"modes must .*got {bad!r}"):
        Matcher(matcher.network, CONFIG, modes=bad, size=SIZE, device="cpu")


@pytest.mark.parametrize("bad", [(485,), (485, 485, 3), (0, 485), (-1, -1), (10**9, 485), (485.0, 485), "ab", None])
def test_a_model_has_a_size(matcher: Matcher, bad: object) -> None:
    with pytest.raises(ValueError, match="size must"):
        Matcher(matcher.network, CONFIG, modes=4, size=bad, device="cpu")


def test_fewer_modes_are_the_most_probable_of_the_groups(matcher: Matcher, image: np.ndarray) -> None:
    pair = matcher.prepare(image, image[::-1])
    every, fewer = pair.match([(50, 60), (9, 9)]), pair.match([(50, 60), (9, 9)], n=2)
    np.testing.assert_array_equal(fewer.modes, every.modes[:, :2])
    np.testing.assert_array_equal(fewer.covariances, every.covariances[:, :2])
    np.testing.assert_allclose(fewer.weights, every.weights[:, :2] / every.weights[:, :2].sum(1, keepdims=True))
    np.testing.assert_array_equal(fewer.outlier_mass, every.outlier_mass)


def test_each_query_may_have_its_number_of_modes(matcher: Matcher, image: np.ndarray) -> None:
    sure = Matcher(matcher.network, CONFIG, modes=4, size=SIZE, device="cpu", temperature=0.01)  # of one peak
    pair = sure.prepare(image, image[::-1])
    match, every = (pair.match([(50, 60), (9, 9), (20, 7)], n=n) for n in (np.array([1, 3, 6]), None))
    assert (match.weights > 0).sum(1).tolist() == [1, 3, 6]
    assert np.isfinite(match.modes).all(-1).sum(1).tolist() == [1, 3, 6]
    np.testing.assert_allclose(match.weights.sum(1), 1, rtol=1e-5)
    np.testing.assert_allclose(match.modes[0, 0], every.modes[0, 0], atol=1e-3)


def test_one_mode_of_four_is_not_their_middle() -> None:
    cells = draw_mixture(CORNERS, 12.0, np.array([0.4, 0.2, 0.2, 0.2]))
    blank = np.zeros((485, 485, 3), np.uint8)
    centres = compute_cell_centres(SIZE, (CELLS, CELLS))
    match = make_match(blank, blank, np.zeros((1, 2), np.float32), cells, centres, 1, fitted=4)
    np.testing.assert_allclose(match.modes[0], CORNERS[:1], atol=1)


@pytest.mark.parametrize("bad", [0, -3, 65, 10**30, True, [True], 2.0, [1, 2, 3], "4", "many", {}, float("nan")])
def test_another_number_of_modes(matcher: Matcher, image: np.ndarray, bad: object) -> None:
    with pytest.raises(ValueError, match="^n must be"):
        matcher.match(image, image, xy=[(5, 5)], n=bad)


def test_images_keep_their_aspect(matcher: Matcher) -> None:
    shapes = [(485, 485), (364, 485), (485, 364), (970, 970), (400, 100)]
    described = matcher.describe([np.zeros((*shape, 3), np.uint8) for shape in shapes])
    grids = [tuple(said.descriptors.shape[1:]) for said in described]
    assert grids == [(16, 16), (14, 18), (18, 14), (16, 16), (48, 12)]


def test_images_of_several_aspects_are_described_as_each_alone(matcher: Matcher, rng: np.random.Generator) -> None:
    images = [rng.integers(0, 256, (*shape, 3), dtype=np.uint8) for shape in ((90, 130), (200, 150), (180, 260))]
    for together, image in zip(matcher.describe(images), images, strict=True):
        alone = matcher.describe([image])[0].descriptors
        torch.testing.assert_close(together.descriptors, alone, atol=0.02, rtol=0.05)


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("shape", [(40, 640), (500, 33), (1, 1)])
def test_long_and_small_images_are_answered(network: str, shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    config = dataclasses.replace(CONFIG, input_px=128, network=network)
    matcher = Matcher(build_network(network, 8, pretrained=False), config, modes=2, size=SIZE, device="cpu")
    image = np.zeros((*shape, 3), np.uint8)
    assert np.isfinite(matcher.match(image, image, (0, 0)).modes).all()


@pytest.mark.parametrize(("name", "size", "squeezed_px"), [("cloth", (485, 364), 36.4), ("rope", (480, 480), 20.5)])
def test_cropped_images_are_answered_about_as_well_as_whole_ones(
    name: str, size: tuple[int, int], squeezed_px: float
) -> None:
    whole, cropped = (measure_sample(name, size) for size in ((9999, 9999), size))
    assert cropped < 1.2 * whole
    assert cropped < 0.9 * squeezed_px


def test_each_peak_of_a_cluttered_answer_has_its_mode() -> None:
    """A cloth's corner in a cluttered image: the fourth mode lay on the floor, and a peak of the heatmap had none."""
    data, matcher = load_dataset(ROOT / "data" / "sample" / "workspace" / "cloth", "test"), load("cloth", device="cpu")
    true = data.xy[5][data.group(matcher.config.group).permutations[:, 24]]
    match = matcher.match(data.load_image(2), data.load_image(5), data.xy[2, [24]])
    assert compute_query_errors(match.modes, match.covariances, true[None].astype(float))["rmse_px"][0] < 20
    assert match.weights.min() > 0.1


def test_a_match_that_a_mask_excludes_leaves_no_second_mode_on_another() -> None:
    data, matcher = load_dataset(ROOT / "data" / "sample" / "cloth", "test"), load("cloth-paper", device="cpu")
    true = data.xy[2][data.group(matcher.config.group).permutations[:, 24]].astype(float)  # (4, 2) px
    x, y = np.meshgrid(*map(np.arange, data.size))
    mask1 = np.hypot(x - true[2, 0], y - true[2, 1]) > 60
    images = data.load_image(0), data.load_image(2)
    match, together = (matcher.match(*images, data.xy[0, [24]], mask1=mask1, mask0=data.load_mask(0), joint=joint)
                       for joint in (False, True))  # fmt: skip
    assert np.isfinite(match.modes[0]).all(1).tolist() == [True] * 3 + [False] and match.weights[0, 3] == 0
    assert compute_query_errors(match.modes[:, :3], match.covariances[:, :3], true[None, [0, 1, 3]])["rmse_px"][0] < 10
    assert match.weights.sum() == pytest.approx(1) and np.isfinite(match.best().xy).all()
    assert np.isfinite(together.modes).all()  # each member of the symmetry has its place


def measure_sample(name: str, size: tuple[int, int]) -> float:
    """Mean RMSE (px) of a shipped model about sample images, each cropped to at most ``size`` around the object."""
    data, pair_errors = load_dataset(ROOT / "data" / "sample" / name, "test"), []
    matcher, points, group = load(f"{name}-paper", device="cpu"), np.arange(0, 625, 25), data.group()
    size = np.minimum(size, data.size)
    centres = [np.ptp(xy[seen], 0) / 2 + xy[seen].min(0) for xy, seen in zip(data.xy, data.visible, strict=True)]
    corners = [np.clip(c - size / 2, 0, np.array(data.size) - size).astype(int) for c in centres]
    crops = [data.load_image(k)[y : y + size[1], x : x + size[0]] for k, (x, y) in enumerate(corners)]
    questions, matches = [], []
    for first, second in ((k, (k + step) % len(crops)) for step in (1, 3) for k in range(len(crops))):
        xy = data.xy[first, points] - corners[first]
        true = data.xy[second][group.permutations[:, points].T] - corners[second]  # (S, G, 2)
        inside = ((true >= 0) & (true < size - 1)).all((1, 2)) & ((xy >= 0) & (xy < size - 1)).all(1)
        asked = inside & data.visible[first, points]
        questions.append((crops[first], crops[second], xy[asked]))
        matches.append(true[asked])
    for match, true in zip(matcher.match_many(questions), matches, strict=True):
        cells = torch.from_numpy(match.cells)
        fit, _ = read_heatmap(cells, len(group.permutations), compute_cell_centres(tuple(size), cells.shape[1:]))
        pair_errors.append(compute_query_errors(fit.modes.numpy(), fit.covariances.numpy(), true)["rmse_px"])
    return float(np.concatenate(pair_errors).mean())


def test_what_the_caller_changes_later_does_not_change_the_answer(matcher: Matcher, image: np.ndarray) -> None:
    image1, xy = image.copy(), np.float32([[5, 5]])
    for match in (matcher.match(image, image1, xy), BaselineMatcher("sift").match(image, image1, xy)):
        before = match.image1.copy(), match.xy.copy()
        image1 ^= 255
        xy += 1
        np.testing.assert_array_equal(match.image1, before[0])
        np.testing.assert_array_equal(match.xy, before[1])
        xy -= 1


def test_a_pair_of_numbers_is_one_query(matcher: Matcher, image: np.ndarray) -> None:
    one, same = (matcher.match(image, image, xy=xy) for xy in ((50, 60), [(50, 60)]))
    np.testing.assert_array_equal(one.modes, same.modes)


def test_damaged_descriptors_give_no_answer(matcher: Matcher, image: np.ndarray) -> None:
    cells = torch.full((1, 8, 8), torch.nan)
    with pytest.raises(ValueError, match="heatmap must .*got NaN or infinity"):
        make_match(image, image, np.zeros((1, 2)), cells, compute_cell_centres((160, 120), (8, 8)), 4)


@pytest.fixture(scope="module")
def seeing() -> Matcher:
    """A matcher whose network has heads, and has learnt nothing."""
    torch.manual_seed(0)
    config = dataclasses.replace(CONFIG, roles=2, heads=True)
    network = build_network("lite0", config.descriptor_dim, roles=2, heads=True, pretrained=False)
    return Matcher(network, config, modes=4, size=(485, 485), device="cpu")


def test_heads_say_what_is_seen_what_is_asked_and_what_is_there(seeing: Matcher, image: np.ndarray) -> None:
    match = seeing.match(image, image, xy=[(5, 5), (60, 80)])
    assert match.visible.shape == (2, 4) and match.on_object.shape == match.absent.shape == (2,)
    for values in (match.visible, match.on_object, match.absent):
        assert ((values >= 0) & (values <= 1)).all()
    assert match[1].visible.shape == (1, 4)
    mask = seeing.segment(image)
    assert mask.shape == image.shape[:2] and mask.dtype == np.float32 and 0 <= mask.min() <= mask.max() <= 1


def test_without_heads_nothing_is_said_of_presence(matcher: Matcher, image: np.ndarray) -> None:
    match = matcher.match(image, image, xy=(5, 5))
    assert match.visible is None and match.on_object is None and match.absent is None
    assert match.answerable.all()
    with pytest.raises(ValueError, match="learnt no mask"):
        matcher.segment(image)


@pytest.mark.parametrize("name", ["matcher", "seeing"])
def test_a_mask_of_the_callers_decides(name: str, image: np.ndarray, request: pytest.FixtureRequest) -> None:
    left = np.zeros(image.shape[:2], bool)
    left[:, :40] = True
    match = request.getfixturevalue(name).match(image, image, xy=[(5, 5), (150, 5)], mask0=left, mask1=left)
    assert match.heatmap[:, :, 80:].sum(axis=(1, 2)).max() < 1e-6
    assert match.on_object.tolist() == [1, 0] and match.absent.tolist() == [0, 0]
    assert np.isfinite(match.best().xy[0]).all() and np.isnan(match.best().xy[1]).all()


@pytest.mark.parametrize("name", ["mask0", "mask1"])
@pytest.mark.parametrize("mask", [np.ones((120, 159), bool), np.zeros((120, 160), bool), np.ones((120, 160), np.uint8)])
def test_a_mask_that_cannot_be_is_refused_by_name(
    matcher: Matcher, image: np.ndarray, name: str, mask: np.ndarray
) -> None:
    with pytest.raises(ValueError, match=f"^{name} must"):
        matcher.match(image, image, xy=(5, 5), **{name: mask})


def test_many_questions_are_answered_as_each_alone_and_an_image_is_described_once(
    matcher: Matcher, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    reference, *frames = rng.integers(0, 256, (4, 60, 80, 3), dtype=np.uint8)
    described, describe = [], matcher.describe
    monkeypatch.setattr(matcher, "describe", lambda images: described.extend(images) or describe(images))
    answers = list(matcher.match_many(((reference, frame, [(5, 6)]) for frame in frames), n=2))
    assert len(described) == 4
    for frame, answer in zip(frames, answers, strict=True):
        alone = matcher.match(reference, frame, [(5, 6)], n=2)
        np.testing.assert_allclose(answer.cells, alone.cells, atol=1e-4)


def test_many_questions_take_masks(matcher: Matcher, rng: np.random.Generator) -> None:
    images = rng.integers(0, 255, (2, 60, 80, 3), dtype=np.uint8)
    left = np.zeros((60, 80), bool)
    left[:, :40] = True
    masks = [(left, ~left), (None, left), (~left, None)]
    answers = matcher.match_many([(*images, [(5, 6)], *pair) for pair in masks] + [(*images, [(5, 6)])])
    for answer, (mask0, mask1) in zip(answers, [*masks, (None, None)], strict=True):
        alone = matcher.match(*images, [(5, 6)], mask0=mask0, mask1=mask1)
        np.testing.assert_allclose(answer.cells, alone.cells, atol=1e-4)
        assert (answer.on_object is None) == (mask0 is None)


@pytest.mark.parametrize("length", [0, 2, 4, 6])
def test_a_question_of_another_length_is_refused(matcher: Matcher, image: np.ndarray, length: int) -> None:
    with pytest.raises(ValueError, match=f"questions must be .* got {length} values"):
        next(matcher.match_many([(image, image, [(5, 6)], None, None, None)[:length]]))


def test_a_refilled_array_is_another_image(matcher: Matcher, rng: np.random.Generator) -> None:
    buffer = np.zeros((60, 80, 3), np.uint8)

    def film() -> Iterator[tuple]:
        for value in (0, 200):
            buffer[:30] = value
            yield buffer, buffer, [(5, 6)]

    first, second = matcher.match_many(film())
    assert not np.array_equal(first.cells, second.cells)
    assert first.image1.max() == 0 and second.image1.max() == 200


def test_many_questions_are_taken_one_by_one(matcher: Matcher, image: np.ndarray) -> None:
    taken = []

    def ask() -> Iterator[tuple]:
        for k in range(1000):
            taken.append(k)
            yield image, image, [(k % 9, 3)]

    answers = matcher.match_many(ask())
    assert taken == []
    next(answers), next(answers)
    assert taken == [0, 1]


def test_no_more_than_the_last_few_images_are_kept() -> None:
    recent = matching._Recent(lambda images: [int(image[0, 0, 0]) for image in images], most=3)
    for value in range(20):
        recent.describe([np.full((2, 2, 3), value, np.uint8), np.zeros((2, 2, 3), np.uint8)])
    assert list(recent._outputs.values()) == [18, 19, 0]


def test_a_device_that_is_not_there_is_not_the_files_fault() -> None:
    with pytest.raises(ValueError, match=r"^device must"):
        load("cloth", device="abacus")
