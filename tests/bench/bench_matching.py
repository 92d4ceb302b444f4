"""How fast queries are answered, and whether the fast way's answers are the plain way's.

``python tests/bench/bench_matching.py [pairs] [preset]``: the cloth model of ``preset`` (default ``quick``, which
`make reproduce` trains), asked about ``pairs`` (default 40) pairs of test images, 625 points each, in one run:

- ours: descriptors, heatmaps, entropies and four-modal fits of all pairs, as the evaluation does it;
- the plain way: one query at a time the heatmap at all pixels and scikit-learn's mixture, which takes no weights, of
  10,000 pixels drawn from it; how far its modes move when others are drawn is printed beside it;
- the arg-min: one query at a time the least descriptor distance over all pixels in numpy, as Dense Object Nets do;
- one query on fresh images by `Matcher.match`, network included;
- agreement: our modes beside those of the same mixture fitted at all pixels in double precision, until at rest.
"""

import resource
import sys
import time

import cv2
import numpy as np
import torch
from sklearn.mixture import GaussianMixture

from mmgsd.command import run_command
from mmgsd.config import ROUNDNESS, load_preset
from mmgsd.dataset import load_dataset, sample_pairs
from mmgsd.match.em import PRIOR_WEIGHT
from mmgsd.match.heatmap import read_heatmap
from mmgsd.match.matcher import Matcher
from mmgsd.measure.metrics import compute_mode_errors
from mmgsd.model.network import compute_cell_centres
from mmgsd.model.tensors import WEIGHTS
from mmgsd.paths import Paths, find_root
from mmgsd.studies.parameters import check_images, check_made

MODES, PLAIN, AGREE_PX = 4, 100, 0.25  # modes; queries asked the plain way
DRAWN = 10_000  # pixels drawn for each; 640,000 take 0.2 queries/s and still move the modes by 4 px


def measure_ours(matcher, data, pairs):
    """Queries a second of the whole evaluation."""
    start = time.perf_counter()
    used = np.unique(pairs).tolist()
    descriptors = {}
    for i in range(0, len(used), 16):
        part = used[i : i + 16]
        descriptors |= zip(part, matcher.describe([data.load_image(k) for k in part]), strict=True)
    for first, second in pairs:
        xy = torch.from_numpy(data.xy[first])
        heatmap = matcher.compute_heatmaps(descriptors[first], descriptors[second], xy, data.size)
        read_heatmap(heatmap, MODES, compute_cell_centres(data.size, heatmap.shape[-2:]))
    return len(pairs) * data.xy.shape[1] / (time.perf_counter() - start), descriptors


def draw_queries(data, pairs):
    """(first, second, point) of the queries that the slow ways are asked."""
    rng = np.random.default_rng(0)
    return [(*pairs[i % len(pairs)], int(rng.integers(data.xy.shape[1]))) for i in range(PLAIN)]


def measure_plain(matcher, data, descriptors, queries):
    """Queries a second, the modes that scikit-learn finds, and how far they move with other draws (median px)."""
    rng, modes, apart, seconds = np.random.default_rng(0), [], [], 0.0
    for first, second, point in queries:
        start = time.perf_counter()
        pixels = compute_pixels(matcher, data, descriptors, first, second, point)
        xy = draw_pixels(pixels, DRAWN, rng)
        fit = GaussianMixture(MODES, random_state=0).fit(xy)
        seconds += time.perf_counter() - start
        modes.append(fit.means_)
        again = GaussianMixture(MODES, means_init=fit.means_, random_state=0).fit(draw_pixels(pixels, DRAWN, rng))
        apart.append(compute_mode_errors(fit.means_[None], again.means_[None]).max())
    return len(queries) / seconds, np.stack(modes), float(np.median(apart))


def draw_pixels(pixels, count, rng):
    """(count, 2) px drawn from a heatmap (H, W)."""
    drawn = rng.choice(pixels.size, count, p=pixels.ravel())
    return np.stack([drawn % pixels.shape[1], drawn // pixels.shape[1]], -1)


def compute_pixels(matcher, data, descriptors, first, second, point):
    """Heatmap (H, W) over all pixels of one query."""
    xy = torch.from_numpy(data.xy[first, [point]])
    cells = matcher.compute_heatmaps(descriptors[first], descriptors[second], xy, data.size)[0]
    pixels = cv2.resize(cells.double().numpy(), data.size, interpolation=cv2.INTER_LINEAR)
    return pixels / pixels.sum()


def fit_all_pixels(pixels, means):
    """The same mixture as ours, written plainly: every pixel, double precision, until no mode moves by 0.001 px."""
    pixels, means = torch.from_numpy(pixels), torch.from_numpy(means)
    y, x = torch.nonzero(pixels > 1e-12).double().T
    mass = pixels[pixels > 1e-12][:, None]
    moments = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], -1)  # (P, 6)
    one = torch.eye(2, dtype=torch.float64)
    weights, shapes = torch.full((len(means),), 1 / len(means)).double(), (900 * one).expand(len(means), 2, 2)
    for _ in range(3000):
        inverse = torch.linalg.inv(shapes)
        pull = torch.einsum("nij,nj->ni", inverse, means)
        constant = weights.log() - 0.5 * shapes.logdet() - 0.5 * (pull * means).sum(-1)
        squares = -inverse[:, 0, 0] / 2, -inverse[:, 0, 1], -inverse[:, 1, 1] / 2
        densities = moments @ torch.stack([constant, *pull.T, *squares])  # logarithms, (P, n)
        summed = (densities.softmax(-1) * mass).T @ moments  # (n, 6)
        count, before = summed[:, 0], means
        means = summed[:, 1:3] / count[:, None]
        inner = summed[:, [3, 4, 4, 5]].view(-1, 2, 2) - count[:, None, None] * means[:, :, None] * means[:, None]
        average = inner.diagonal(dim1=1, dim2=2).mean(-1).sum()
        shapes = (inner + ROUNDNESS * average * one) / (count + ROUNDNESS)[:, None, None]
        weights = (count + PRIOR_WEIGHT) / (count + PRIOR_WEIGHT).sum()
        if (means - before).abs().max() < 1e-3:
            break
    return means.numpy()


def measure_argmin(data, descriptors, dim, queries):
    """Queries a second of a search over all pixels for the nearest descriptor of ``dim`` numbers."""
    _, second, _ = queries[0]
    grid = descriptors[second].descriptors[-dim:].permute(1, 2, 0).numpy()
    full = np.stack([cv2.resize(grid[..., k], data.size) for k in range(grid.shape[-1])], -1)  # (H, W, D)
    start = time.perf_counter()
    for first, _, point in queries:
        x, y = np.rint(data.xy[first, point]).astype(int).clip(0, np.array(data.size) - 1)
        np.square(full - full[y, x]).sum(-1).argmin()
    return len(queries) / (time.perf_counter() - start)


def measure_one(matcher, data, queries):
    """Median milliseconds of one query on fresh images."""
    took = []
    for first, second, point in queries:
        images = data.load_image(first), data.load_image(second)
        start = time.perf_counter()
        matcher.match(*images, data.xy[first, [point]])
        took.append(1000 * (time.perf_counter() - start))
    return float(np.median(took))


def main():
    """Print what was measured, then the line that is compared."""
    pairs, preset = (int(sys.argv[1]) if len(sys.argv) > 1 else 40), (sys.argv[2:] or ["quick"])[0]
    paths, config = Paths(find_root(), preset), load_preset(preset).train["cloth"]
    weights = paths.model(config) / WEIGHTS
    check_images(paths, ["cloth"])
    check_made(paths, "03_train with run=True", [weights])
    data, matcher = load_dataset(paths.dataset("cloth"), "test"), Matcher.load(weights, device="cpu")
    chosen = [tuple(pair) for pair in sample_pairs(data.episode, pairs, np.random.default_rng(0)).tolist()]
    queries = draw_queries(data, chosen)
    measure_ours(matcher, data, chosen[:2])  # warms up
    ours, descriptors = measure_ours(matcher, data, chosen)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"cloth, preset {preset}, {torch.get_num_threads()} threads")
    plain, theirs, repeats = measure_plain(matcher, data, descriptors, queries)
    print(f"plain way, {DRAWN} pixels drawn: {plain:.1f} queries/s, repeatable to {repeats:.1f} px", flush=True)
    argmin, one = measure_argmin(data, descriptors, config.descriptor_dim, queries), measure_one(matcher, data, queries)
    fast, exact = [], []
    for first, second, point in queries:
        cells = matcher.compute_heatmaps(
            descriptors[first], descriptors[second], torch.from_numpy(data.xy[first, [point]]), data.size
        )
        fit, _ = read_heatmap(cells, MODES, compute_cell_centres(data.size, cells.shape[-2:]))
        fast.append(fit.modes[0].double().numpy())
        exact.append(fit_all_pixels(compute_pixels(matcher, data, descriptors, first, second, point), fast[-1]))
    apart, sklearn_apart = (compute_mode_errors(np.stack(fast), other).max(1) for other in (np.stack(exact), theirs))
    grid = "x".join(map(str, cells.shape[-2:]))
    print(f"grid {grid}; one query on fresh images: {one:.0f} ms; memory of {pairs} pairs: {memory:.2f} GiB")
    print(f"the same mixture at all pixels: {100 * (apart <= AGREE_PX).mean():.0f} % of queries within {AGREE_PX} px, "
          f"median {np.median(apart):.3f} px, most {apart.max():.2f} px")  # fmt: skip
    print(f"scikit-learn's, which knows no symmetry and starts elsewhere: median {np.median(sklearn_apart):.1f} px")
    print(f"arg-min: {argmin:.1f} queries/s")
    print(f"{ours:.0f} queries/s, {ours / plain:.0f} x the plain way, {ours / argmin:.0f} x arg-min")


if __name__ == "__main__":
    run_command(main)
