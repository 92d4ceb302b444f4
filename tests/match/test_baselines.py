from functools import partial

import cv2
import numpy as np
import pytest
import torch

from mmgsd.match.baselines import (
    BASELINES,
    EXTRACTORS,
    BaselineMatcher,
    FeatureMatcher,
    compute_described_heatmap,
    compute_descriptors,
    compute_distances,
    compute_grid,
    compute_orientations,
)

SIZE = (240, 200)  # width, height
STRIDE = 8  # px, finer than the default: the image is small
CENTRE = np.array([119.5, 99.5])


@pytest.fixture(scope="module")
def image():
    rng = np.random.default_rng(3)
    layers = [rng.random((SIZE[1] // s + 1, SIZE[0] // s + 1, 3)).astype(np.float32) for s in (6, 14, 30)]
    total = sum(cv2.resize(layer, SIZE, interpolation=cv2.INTER_CUBIC) for layer in layers)
    return np.clip(total * 85, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def mask():
    return np.ones(SIZE[::-1], bool)


@pytest.fixture(scope="module")
def xy():
    columns, rows = np.meshgrid(np.arange(80, 160, 16), np.arange(60, 140, 16))
    return np.stack([columns, rows], -1).reshape(-1, 2) + 0.25


def compute_heatmap(image0, image1, xy, mask1, *, method, stride=STRIDE):
    describe = partial(compute_descriptors, method=method)
    return compute_described_heatmap(image0, image1, xy, mask1, describe=describe, stride=stride)


def find_top(heatmap, grid):
    return grid.reshape(-1, 2)[heatmap.reshape(len(heatmap), -1).argmax(1)]


def turn(image, xy, degrees):
    matrix = cv2.getRotationMatrix2D(tuple(CENTRE), degrees, 1.0)
    turned = cv2.warpAffine(image, matrix, SIZE, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return turned, np.c_[xy, np.ones(len(xy))] @ matrix.T


@pytest.mark.parametrize("method", BASELINES)
def test_heatmap_is_a_distribution_on_the_object(method, image, mask, xy):
    half = mask.copy()
    half[:, :100] = False
    heatmap, grid = compute_heatmap(image, image, xy, half, method=method)
    assert heatmap.shape == (len(xy), 25, 30)
    assert heatmap.dtype == np.float32
    assert grid.shape == (25, 30, 2)
    np.testing.assert_allclose(heatmap.sum((1, 2)), 1, atol=1e-4)
    assert (heatmap >= 0).all()
    assert not heatmap[:, grid[..., 0] < 99].any()


@pytest.mark.parametrize("method", BASELINES)
def test_an_image_matches_itself(method, image, mask, xy):
    heatmap, grid = compute_heatmap(image, image, xy, mask, method=method)
    errors = np.linalg.norm(find_top(heatmap, grid) - xy, axis=1)
    assert np.median(errors) <= 8  # the cell's own extent


@pytest.mark.parametrize("method", ["sift", "orb"])
@pytest.mark.parametrize("degrees", [35, 90, -140])
def test_a_turned_image_matches(method, degrees, image, mask, xy):
    turned, true = turn(image, xy, degrees)
    heatmap, grid = compute_heatmap(image, turned, xy, mask, method=method)
    errors = np.linalg.norm(find_top(heatmap, grid) - true, axis=1)
    assert np.median(errors) <= 8


@pytest.mark.parametrize("method", ["sift", "orb"])
def test_orientation_turns_with_the_image(method, image, xy):
    turned, true = turn(image, xy, 90)  # counter-clockwise as seen: y points down
    before, after = (
        compute_orientations(cv2.cvtColor(im, cv2.COLOR_RGB2GRAY), points, method=method)
        for im, points in ((image, xy), (turned, true))
    )
    difference = (before - after - 90 + 180) % 360 - 180
    assert np.median(np.abs(difference)) < 5


@pytest.mark.parametrize(("method", "tolerance"), [("sift", 6), ("orb", 1)])
def test_orientation_of_a_ramp_is_its_gradient(method, tolerance):
    rows, columns = np.mgrid[:200, :240]
    angle = np.radians(33)
    ramp = np.rint(128 + 0.8 * (np.cos(angle) * (columns - 119) + np.sin(angle) * (rows - 99))).clip(0, 255)
    got = compute_orientations(ramp.astype(np.uint8), np.array([[119.0, 99.0]]), method=method)
    assert got[0] == pytest.approx(33, abs=tolerance)  # SIFT's bins are 10 degrees wide


@pytest.mark.parametrize("method", BASELINES)
def test_no_point_is_dropped_at_the_border(method, image):
    corners = np.array([[-0.5, -0.5], [239.5, -0.5], [-0.5, 199.5], [239.5, 199.5], [0, 100]])
    descriptors = compute_descriptors(image, corners, method=method)
    assert descriptors.shape[0] == 5
    assert descriptors.dtype == np.float32
    assert np.isfinite(descriptors).all()


@pytest.mark.parametrize("method", [m for m in BASELINES if m not in EXTRACTORS])  # a network sees the border
def test_a_plain_image_gives_a_uniform_heatmap(method, image, mask, xy):
    plain = np.full_like(image, 90)
    heatmap, _ = compute_heatmap(plain, plain, xy[:3], mask, method=method)
    np.testing.assert_allclose(heatmap, 1 / heatmap[0].size, rtol=0.02)


def test_distances_by_hand():
    source = np.array([[1, 1, 1], [1, -1, -1]], np.float32)
    target = np.array([[1, 1, -1], [1, -1, -1]], np.float32)
    assert compute_distances(source, target).tolist() == [[4, 8], [4, 0]]  # four times the Hamming distance


def test_grid_cells_lie_where_documented():
    grid = compute_grid((485, 640), stride=8)
    assert grid.shape == (61, 80, 2)
    assert grid[0, 0].tolist() == [3.5, 3.5]
    assert grid[2, 5].tolist() == [3.5 + 8 * 5, 3.5 + 8 * 2]
    assert grid[-1, -1].tolist() == [635.5, 483.5]


def test_no_query_gives_an_empty_heatmap(image, mask):
    heatmap, _ = compute_heatmap(image, image, np.zeros((0, 2)), mask, method="orb")
    assert heatmap.shape == (0, 25, 30)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"method": "lift"}, "method must be one of 'sift'.*got 'lift'"),
        ({"image0": np.zeros((200, 240), np.uint8)}, r"image0 must be an RGB image.*got uint8 \(200, 240\)"),
        ({"image1": np.zeros((200, 240, 4), np.uint8)}, r"image1 must be.*\(200, 240, 4\)"),
        ({"image1": np.zeros((200, 240, 3))}, "image1 must be.*float64"),
        ({"image0": None}, "image0 must be.*NoneType"),
        ({"xy": np.zeros((2, 3))}, r"xy must be \(S, 2\) px, got shape \(2, 3\)"),
        ({"xy": [[1, 1], [240, 10]]}, r"inside image0 of 240 x 200 px, got \(240.0, 10.0\)"),
        ({"xy": [[np.nan, 1]]}, "xy must be finite"),
        ({"mask1": np.ones((200, 240))}, "mask1 must be bool.*float64"),
        ({"mask1": np.ones((20, 24), bool)}, r"mask1 must be bool of shape \(200, 240\)"),
        ({"mask1": np.zeros((200, 240), bool)}, "at least one cell"),
        ({"stride": 0}, "stride must be an integer from 1 to the image's 200 px, got 0"),
        ({"stride": 2.5}, "stride must be an integer.*got 2.5"),
    ],
)
def test_bad_arguments_are_named(change, message, image, mask, xy):
    arguments = {"image0": image, "image1": image, "xy": xy, "mask1": mask, "method": "orb", **change}
    method, stride = arguments.pop("method"), arguments.pop("stride", 8)
    with pytest.raises(ValueError, match=message):
        compute_heatmap(**arguments, method=method, stride=stride)


@pytest.mark.parametrize("method", BASELINES)
def test_a_baseline_answers_as_a_matcher_does(method, image, mask):
    match = BaselineMatcher(method, modes=4).match(image, image, [(100, 90), (130.5, 110)], mask1=mask)
    assert (match.modes.shape, match.covariances.shape, match.heatmap.shape) == ((2, 4, 2), (2, 4, 2, 2), (2, 200, 240))
    nearest = np.nanmin(np.linalg.norm(match.modes - match.xy[:, None], axis=-1), 1)
    assert nearest.max() < 24  # one and a half of the grid's cells: the modes share one peak and the noise around it
    assert match.best().xy.shape == (2, 2)


def test_a_baseline_takes_images_as_a_matcher_does(image):
    grey = image[..., 0].astype(np.float32) / 255
    match = BaselineMatcher("sift").match(grey, np.dstack([image, image[..., :1]]), [], n="auto")
    assert (match.image0.shape, match.image1.shape, len(match.modes)) == ((200, 240, 3), (200, 240, 3), 0)


def test_an_unknown_baseline():
    with pytest.raises(ValueError, match="method must .*got 'lift'"):
        BaselineMatcher("lift")


def encode_colours(image):
    """A trivial extractor: what it says of a place is its colour, in cells of 4 px."""
    small = cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    return small.transpose(2, 0, 1).astype(np.float32)


def paint_patches(*places):
    """A dark picture with a red patch of 48 px at each place, the last one green."""
    image = np.full((200, 240, 3), (5, 5, 60), np.uint8)
    for k, (x, y) in enumerate(places):
        image[y - 24 : y + 24, x - 24 : x + 24] = (20, 220, 0) if k == len(places) - 1 else (220, 20, 0)
    return image


@pytest.mark.parametrize("kind", ["numpy", "torch", "integers"])
def test_features_of_ones_own_answer_with_all_matches(kind):
    convert = {"numpy": lambda x: x, "torch": torch.from_numpy, "integers": lambda x: x.astype(np.uint8)}[kind]
    matcher = FeatureMatcher(lambda image: convert(encode_colours(image)), modes=2)
    image0, image1 = paint_patches((60, 60), (180, 140)), paint_patches((40, 150), (190, 50), (110, 100))
    red, green = matcher.match(image0, image1, [(60, 60), (180, 140)])
    for place in ((40, 150), (190, 50)):
        assert np.linalg.norm(red.modes[0] - place, axis=1).min() < 16
    assert np.nanmin(np.linalg.norm(green.modes[0] - (110, 100), axis=1)) < 16
    (many,) = matcher.match_many([(image0, image1, (60, 60))])
    np.testing.assert_array_equal(many.modes, red.modes)


def test_features_of_ones_own_are_looked_for_on_the_object():
    image0, image1 = paint_patches((60, 60), (180, 140)), paint_patches((40, 150), (190, 50), (110, 100))
    mask = np.zeros(image1.shape[:2], bool)
    mask[:, 120:] = True
    match = FeatureMatcher(encode_colours).match(image0, image1, (60, 60), mask1=mask)
    assert np.linalg.norm(match.modes[0, 0] - (190, 50)) < 16
    assert not match.cells[0, :, :7].any()
    (many,) = FeatureMatcher(encode_colours).match_many([(image0, image1, (60, 60), None, mask)])
    np.testing.assert_array_equal(many.cells, match.cells)


@pytest.mark.parametrize(
    ("features", "message"),
    [
        (np.zeros((4, 5)), r"extractor must return numbers \(D, h, w\), got float64 \(4, 5\)"),
        (np.zeros((1, 3, 4, 5)), r"got float64 \(1, 3, 4, 5\)"),
        (np.zeros((3, 4, 5), bool), "got bool"),
        (np.full((3, 4, 5), np.nan), "extractor must return finite numbers"),
        (np.zeros((0, 4, 5)), "extractor must return finite numbers"),
        ("features", "extractor must return numbers"),
        (None, "extractor must return numbers"),
    ],
)
def test_other_features_are_refused(image, features, message):
    with pytest.raises(ValueError, match=message):
        FeatureMatcher(lambda _: features).match(image, image, (5, 5))


def test_an_extractor_is_a_function():
    with pytest.raises(ValueError, match="extractor must .*got 'dino'"):
        FeatureMatcher("dino")
