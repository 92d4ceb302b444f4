"""The mixture's fit: known mixtures, beside scikit-learn, degenerate heatmaps, the number of modes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from heatmaps import CELL_PX, CELLS, CORNERS, XS, YS, draw_mixture, one_cell
from sklearn.mixture import GaussianMixture
from torch import Tensor

from mmgsd.match import em, mixture
from mmgsd.match.em import ModeReadout
from mmgsd.match.mixture import find_peaks, fit_modes
from mmgsd.measure.metrics import compute_mode_errors
from mmgsd.model.network import compute_cell_centres


def measure_errors(modes: np.ndarray, true: np.ndarray) -> np.ndarray:
    return compute_mode_errors(np.asarray(modes, dtype=float)[None], true[None])[0]


@pytest.mark.parametrize(
    ("n", "std_px"),
    [(1, 8.0), (2, 8.0), (4, 8.0), (1, 16.0), (2, 16.0), (4, 16.0), (1, 32.0), (4, 32.0)],
)
def test_separated_modes_are_found_below_a_cells_size(n: int, std_px: float) -> None:
    true = CORNERS[:n]
    fit = fit_modes(draw_mixture(true, std_px), n, XS, YS)
    # a mode of 32 px, 100 px from the image's border, has a thousandth of its mass beyond it
    assert measure_errors(fit.modes[0], true).max() < (0.1 if std_px < 32 else 0.15)


def test_random_separated_modes(rng: np.random.Generator) -> None:
    true = CORNERS + rng.uniform(-40, 40, (20, 4, 2))
    fit = fit_modes(torch.cat([draw_mixture(modes, 12.0) for modes in true]), 4, XS, YS)
    assert compute_mode_errors(fit.modes.double().numpy(), true).max() < 0.1


def test_a_modes_position_inside_its_cell_is_found() -> None:
    offsets = np.linspace(0, CELL_PX, 8)
    true = np.stack([200 + offsets, 300 - offsets], -1)[:, None]
    fit = fit_modes(torch.cat([draw_mixture(t, 6.0) for t in true]), 1, XS, YS)
    assert compute_mode_errors(fit.modes.double().numpy(), true).max() < 0.1


def test_weights_are_found_and_sorted() -> None:
    weights = np.array([0.2, 0.3, 0.22, 0.28])
    fit = fit_modes(draw_mixture(CORNERS, 8.0, weights), 4, XS, YS)
    order = np.argsort(-weights)
    np.testing.assert_allclose(fit.modes[0], CORNERS[order], atol=0.1)
    np.testing.assert_allclose(fit.weights[0], weights[order], atol=1e-3)


def test_less_of_a_prior_keeps_a_narrow_mode_out_of_a_wide_one() -> None:
    true = np.array([[200.0, 240.0], [290.0, 240.0]])
    heatmap = (draw_mixture(true[:1], 8.0) + draw_mixture(true[1:], 60.0)) / 2
    errors = [
        measure_errors(fit_modes(heatmap, 2, XS, YS, readout=ModeReadout(r)).modes[0], true) for r in (0.05, 0.2, 5.0)
    ]
    assert errors[0].max() < errors[1].max() < errors[2].max()


@pytest.mark.parametrize("name", ["shape_prior", "exponent", "mean_exponent"])
@pytest.mark.parametrize("value", [-1.0, 0.0, float("nan"), float("inf")])
def test_modes_are_not_read_flatter_than_they_are(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} must be .*, got"):
        ModeReadout(**{name: value})


def draw_tails() -> torch.Tensor:
    """Four lobes, each with half of its mass in a tail towards the middle, and a fifth of all spread evenly."""
    tails = CORNERS + 0.25 * (CORNERS.mean(0) - CORNERS)
    heatmap = 0.4 * draw_mixture(CORNERS, 8.0) + 0.4 * draw_mixture(tails, 20.0)
    return heatmap + 0.2 / heatmap[0].numel()


def test_modes_follow_the_peaks_of_what_spreads_to_one_side() -> None:
    readouts = [ModeReadout(), ModeReadout(mean_exponent=4.0), ModeReadout(exponent=2.0, mean_exponent=4.0)]
    fits = [fit_modes(draw_tails(), 4, XS, YS, readout=readout) for readout in readouts]
    plain, *others = (measure_errors(fit.modes[0], CORNERS).max() for fit in fits)
    assert plain > 20 and max(others) < 2
    assert fits[2].weights.sum() == pytest.approx(1, abs=1e-5)
    trace = [float(torch.diagonal(fit.covariances[0], dim1=-2, dim2=-1).sum(-1).mean()) for fit in fits]
    assert trace[1] == pytest.approx(trace[0], rel=0.05)  # spreads stay those of the heatmap itself


def test_absent_modes_stay_absent_however_modes_are_read() -> None:
    heatmaps = torch.cat([draw_mixture(CORNERS, 8.0), draw_mixture(CORNERS[:1], 8.0)])
    fit = fit_modes(heatmaps, torch.tensor([4, 1]), XS, YS, readout=ModeReadout(exponent=2.0, mean_exponent=3.0))
    assert fit.modes[1].isnan().sum(0).tolist() == [3, 3] and fit.weights[1].tolist() == [1, 0, 0, 0]


def test_a_weak_mode_beside_a_strong_one_is_found() -> None:
    fit = fit_modes(draw_mixture(CORNERS, 8.0, np.array([0.2, 0.4, 0.1, 0.3])), 4, XS, YS)
    assert measure_errors(fit.modes[0], CORNERS).max() < 0.1


def test_annealing_finds_wide_and_weak_modes_among_noise(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    heatmaps, true = [], CORNERS + rng.uniform(-40, 40, (60, 4, 2))
    for modes in true:
        clean = draw_mixture(modes, np.exp(rng.uniform(np.log(10), np.log(60), 4)), rng.dirichlet(np.full(4, 4.0)))
        heatmaps.append(clean * torch.from_numpy(np.exp(rng.normal(0, 0.5, clean.shape))).float())

    def measure() -> float:
        fit = fit_modes(torch.cat(heatmaps), 4, XS, YS)
        return np.sqrt(np.square(compute_mode_errors(fit.modes.double().numpy(), true)).mean(1)).mean()

    annealed = measure()
    monkeypatch.setattr(mixture, "ANNEALING", ())
    assert annealed < 0.6 * measure()


@pytest.mark.parametrize(("std_px", "even"), [(5.0, 0.01), (5.0, 0.02), (8.0, 0.02)])
def test_a_mode_without_mass_goes_to_the_peak_that_has_none(
    std_px: float, even: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two near peaks share a mode, and a fourth mode lies far off, alone with what spreads evenly."""
    true = np.array([[143.0, 240.0], [313.0, 343.0], [22.0, 416.0], [144.0, 354.0]])
    heatmap = (1 - even) * draw_mixture(true, std_px, np.array([0.3, 0.27, 0.24, 0.19])) + even / CELLS**2
    fit = fit_modes(torch.cat([heatmap, draw_mixture(CORNERS, std_px)]), 4, XS, YS)
    assert measure_errors(fit.modes[0], true).max() < 5 and fit.weights[0].min() > 0.15
    assert measure_errors(fit.modes[1], CORNERS).max() < 0.1
    monkeypatch.setattr(mixture, "COLLAPSED", 0.0)
    collapsed = fit_modes(heatmap, 4, XS, YS)
    assert measure_errors(collapsed.modes[0], true).max() > 150 and collapsed.weights[0].min() < 0.01


def test_modes_on_one_spot_are_one() -> None:
    heatmaps = torch.cat([draw_mixture(CORNERS[:3], 8.0), draw_mixture(CORNERS, 8.0)])
    apart, merged = (fit_modes(heatmaps, 4, XS, YS, merge=merge) for merge in (False, True))
    assert torch.isfinite(merged.modes).all(-1).sum(1).tolist() == [3, 4]
    assert ((merged.weights > 0) == torch.isfinite(merged.modes).all(-1)).all()
    torch.testing.assert_close(merged.weights[0], torch.tensor([1 / 3, 1 / 3, 1 / 3, 0]), rtol=0, atol=0.01)
    assert measure_errors(merged.modes[0, :3], CORNERS[:3]).max() < 0.1
    torch.testing.assert_close(merged.modes[1], apart.modes[1])
    torch.testing.assert_close(merged.covariances[0, 0], apart.covariances[0, 0], rtol=0.05, atol=1)


def test_a_merged_mode_is_as_wide_as_its_parts_together() -> None:
    parts = torch.tensor([[0.0, 0, 0.6, 4, 0, 4], [0.5, 0, 0.2, 9, 1, 9], [1.2, 0, 0.1, 9, 0, 9], [8, 8, 0.1, 1, 0, 1]])
    merged = mixture._merge(parts[None])[0]  # a chain of three: the last is less than a cell from the second alone
    x, shares = torch.tensor([0, 0.5, 1.2]), torch.tensor([0.6, 0.2, 0.1]) / 0.9
    torch.testing.assert_close(merged[:, 2], torch.tensor([0.9, 0, 0, 0.1]))
    torch.testing.assert_close(merged[0, 0], (shares * x).sum())
    torch.testing.assert_close(merged[0, 3], (shares * (parts[:3, 3] + (x - merged[0, 0]) ** 2)).sum())
    torch.testing.assert_close(merged[0, 4:], (shares[:, None] * parts[:3, 4:]).sum(0))
    torch.testing.assert_close(merged[3], parts[3])


@pytest.mark.parametrize("shape", [(64, 64), (63, 64), (64, 61), (33, 47), (5, 4)])
def test_any_grid_will_do(shape: tuple[int, int]) -> None:
    xs, ys = compute_cell_centres((640, 480), shape)
    true = np.array([[410.0, 130.0]])
    x, y = np.meshgrid(xs, ys)
    width = 2 * float(xs[1] - xs[0])
    heatmap = torch.from_numpy(np.exp(-((x - true[0, 0]) ** 2 + (y - true[0, 1]) ** 2) / (2 * width**2)))[None]
    moments = (heatmap[0] * torch.from_numpy(np.stack([x, y]))).sum((1, 2)) / heatmap.sum()
    np.testing.assert_allclose(fit_modes(heatmap, 1, xs, ys).modes[0, 0], moments, atol=0.1 * float(xs[1] - xs[0]))


def test_covariance_is_the_modes() -> None:
    fit = fit_modes(draw_mixture(CORNERS[:1] + 140, 20.0), 1, XS, YS)
    expected = np.eye(2) * (20.0**2 + CELL_PX**2 / 6)  # of the heatmap's pixels, between which cells are interpolated
    np.testing.assert_allclose(fit.covariances[0, 0], expected, rtol=0.01, atol=1)


def test_covariances_are_those_of_the_full_heatmap() -> None:
    cells = draw_mixture(CORNERS[:1] + 140, 12.0)
    pixels = cv2.resize(cells[0].numpy(), (485, 485), interpolation=cv2.INTER_LINEAR)
    x, y = np.meshgrid(np.arange(485), np.arange(485))
    expected = np.cov(np.stack([x.ravel(), y.ravel()]), aweights=pixels.ravel(), bias=True)
    np.testing.assert_allclose(fit_modes(cells, 1, XS, YS).covariances[0, 0], expected, rtol=0.02, atol=1)


def test_an_oblong_mode_keeps_its_shape() -> None:
    x, y = np.meshgrid(XS.numpy() - 240, YS.numpy() - 240)
    heatmap = np.exp(-((0.8 * x + 0.6 * y) ** 2) / (2 * 60**2) - (0.8 * y - 0.6 * x) ** 2 / (2 * 15**2))
    covariance = fit_modes(torch.from_numpy(heatmap[None]), 1, XS, YS).covariances[0, 0]
    variances, axes = torch.linalg.eigh(covariance - torch.eye(2) * CELL_PX**2 / 6)
    np.testing.assert_allclose(variances.sqrt(), [15, 60], rtol=0.02)
    np.testing.assert_allclose(axes[:, 1].abs(), [0.8, 0.6], atol=0.01)


def test_five_per_cent_lie_outside_the_ellipse() -> None:
    assert fit_modes(draw_mixture(CORNERS, 24.0), 4, XS, YS).outlier_mass.item() == pytest.approx(0.05, abs=0.01)


def test_a_place_without_a_mode_lies_outside() -> None:
    heatmap = draw_mixture(CORNERS[:2], 8.0, np.array([0.97, 0.03]))
    assert fit_modes(heatmap, 1, XS, YS).outlier_mass.item() == pytest.approx(0.03, abs=0.02)


@pytest.mark.parametrize("std_px", [4.0, 8.0, 16.0, 32.0])
@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_the_number_of_modes_is_found(n: int, std_px: float) -> None:
    fit = fit_modes(draw_mixture(CORNERS[:n], std_px), "auto", XS, YS)
    assert int((fit.weights > 0).sum()) == n
    assert measure_errors(fit.modes[0, :n], CORNERS[:n]).max() < 0.15
    assert torch.isnan(fit.modes[0, n:]).all()


def test_each_query_finds_its_own_number() -> None:
    heatmap = torch.cat([draw_mixture(CORNERS[:n], 12.0) for n in (3, 1, 4)])
    assert (fit_modes(heatmap, "auto", XS, YS).weights > 0).sum(1).tolist() == [3, 1, 4]


def test_modes_too_near_to_tell_apart_are_one() -> None:
    assert (fit_modes(draw_overlapping(1.0)[1], "auto", XS, YS).weights > 0).sum(1).tolist() == [1] * 12


def test_queries_do_not_disturb_each_other() -> None:
    heatmaps = torch.cat([draw_mixture(CORNERS[:2] + k, 5.0 * k) for k in (1, 2, 3, 4)])
    together, alone = fit_modes(heatmaps, 2, XS, YS), [fit_modes(h[None], 2, XS, YS) for h in heatmaps]
    torch.testing.assert_close(together.modes, torch.cat([f.modes for f in alone]), rtol=0, atol=1e-3)


def test_chunks_do_not_change_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    heatmaps = draw_overlapping(2.0)[1]
    whole = fit_modes(heatmaps, 2, XS, YS)
    monkeypatch.setitem(em.CHUNK, "cpu", 2 * 5 * CELLS**2)  # five queries at a time
    parts = fit_modes(heatmaps, 2, XS, YS)
    assert compute_mode_errors(parts.modes.numpy(), whole.modes.numpy()).max() < 0.01  # equal ones in any order


def draw_overlapping(separation: float, std_px: float = 24.0) -> tuple[np.ndarray, Tensor]:
    """Twelve pairs of modes (12, 2, 2) px, ``separation`` stds apart in any direction, and their heatmaps."""
    rng, true = np.random.default_rng(0), []
    for _ in range(12):
        angle = rng.uniform(0, np.pi)
        half = 0.5 * separation * std_px * np.array([np.cos(angle), np.sin(angle)])
        true.append(rng.uniform(180, 300, 2) + np.array([half, -half]))
    return np.array(true), torch.cat([draw_mixture(t, std_px) for t in true])


def fit_with_scikit_learn(heatmap: Tensor, rng: np.random.Generator, samples: int = 3000) -> np.ndarray:
    mass = heatmap.double().flatten().numpy()
    drawn = rng.choice(len(mass), samples, p=mass / mass.sum())
    xy = np.stack([XS.numpy()[drawn % CELLS], YS.numpy()[drawn // CELLS]], -1)
    xy = xy + rng.uniform(-CELL_PX / 2, CELL_PX / 2, xy.shape)
    return GaussianMixture(2, random_state=0).fit(xy).means_


@pytest.mark.parametrize("separation", [1.5, 2.0, 3.0])
def test_overlapping_modes_are_found_and_no_worse_than_by_scikit_learn(
    separation: float, rng: np.random.Generator
) -> None:
    true, heatmaps = draw_overlapping(separation)
    ours = compute_mode_errors(fit_modes(heatmaps, 2, XS, YS).modes.double().numpy(), true).mean()
    theirs = np.stack([fit_with_scikit_learn(heatmap, rng) for heatmap in heatmaps])
    assert ours < CELL_PX / 2 and ours <= compute_mode_errors(theirs, true).mean()


DEGENERATE = {
    "flat": torch.full((1, CELLS, CELLS), 1 / CELLS**2),
    "nothing": torch.zeros(1, CELLS, CELLS),
    "one cell": one_cell(20, 33),
    "first corner": one_cell(0, 0),
    "last corner": one_cell(CELLS - 1, CELLS - 1),
    "two cells": one_cell(0, CELLS - 1) + one_cell(CELLS - 1, 0),
    "tiny": draw_mixture(CORNERS, 8.0) * 1e-20,
    "huge": draw_mixture(CORNERS, 8.0) * 1e20,
    "half on the edge": draw_mixture(np.array([[0.0, 200.0], [484.0, 300.0]]), 30.0),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_any_heatmap_has_a_number_of_modes(name: str) -> None:
    fit = fit_modes(DEGENERATE[name], "auto", XS, YS)
    present = fit.weights[0] > 0
    assert 1 <= present.sum() <= 8
    assert ((fit.modes[0, present] >= -0.5) & (fit.modes[0, present] <= 484.5)).all()


@pytest.mark.parametrize("n", [1, 2, 4, 8])
@pytest.mark.parametrize("name", DEGENERATE)
def test_fit_is_sound_on_any_heatmap(name: str, n: int) -> None:
    fit = fit_modes(DEGENERATE[name], n, XS, YS)
    assert (fit.modes.shape, fit.weights.shape, fit.covariances.shape) == ((1, n, 2), (1, n), (1, n, 2, 2))
    assert ((fit.modes >= -0.5) & (fit.modes <= 484.5)).all()  # false for NaN
    assert fit.weights.sum().item() == pytest.approx(1)
    assert (fit.weights[0].diff() <= 0).all()
    assert torch.linalg.eigvalsh(fit.covariances).min() > 0
    assert 0 <= fit.outlier_mass.item() <= 1


def test_one_cell_is_its_own_mode() -> None:
    fit = fit_modes(one_cell(7, 30), 1, XS, YS)
    torch.testing.assert_close(fit.modes[0, 0], torch.stack([XS[30], YS[7]]))
    corner = fit_modes(one_cell(0, CELLS - 1), 1, XS, YS).modes[0, 0]  # whose mass has only one side to spread to
    assert (corner - torch.stack([XS[-1], YS[0]])).abs().max() < 0.1 * CELL_PX


def test_double_heatmaps_are_taken() -> None:
    one, two = (fit_modes(draw_mixture(CORNERS, 8.0).to(t), 4, XS, YS) for t in (torch.float32, torch.float64))
    torch.testing.assert_close(one.modes, two.modes, rtol=0, atol=0.01)


def test_each_query_has_its_own_number_of_modes() -> None:
    heatmap = torch.cat([draw_mixture(CORNERS[:1], 8.0), draw_mixture(CORNERS, 8.0), draw_mixture(CORNERS[:2], 8.0)])
    fit = fit_modes(heatmap, torch.tensor([1, 4, 2]), XS, YS)
    assert torch.isfinite(fit.modes).all(-1).tolist() == [[True] + 3 * [False], 4 * [True], 2 * [True] + 2 * [False]]
    assert ((fit.weights > 0) == torch.isfinite(fit.modes).all(-1)).all()
    torch.testing.assert_close(fit.weights.sum(1), torch.ones(3))
    assert measure_errors(fit.modes[2, :2], CORNERS[:2]).max() < 0.1 * CELL_PX


def test_no_query_no_mode() -> None:
    fit = fit_modes(torch.zeros(0, CELLS, CELLS), 4, XS, YS)
    assert (fit.modes.shape[0], fit.modes.shape[2]) == (0, 2)


@pytest.mark.parametrize("n", [0, -1, 2.5, "many", torch.tensor([1, 2, 3])])
def test_another_number_of_modes(n: object) -> None:
    with pytest.raises(ValueError, match=r"n must"):
        fit_modes(one_cell(3, 3), n, XS, YS)


def test_a_fit_goes_on_from_a_start_and_leaves_out_what_is_not_there() -> None:
    heatmap, xs, ys = draw_mixture(CORNERS, 8.0), XS, YS
    start = torch.tensor(CORNERS[None, ::-1].copy() + 9.0)
    start[:, 3] = torch.nan
    fit = fit_modes(heatmap, 4, xs, ys, start=start)
    assert fit.weights[0].count_nonzero() == 3 and fit.modes[0, -1].isnan().all()
    whole = fit_modes(heatmap, 4, xs, ys, start=torch.tensor(CORNERS[None] + 9.0))
    np.testing.assert_allclose(sorted(whole.modes[0].tolist()), sorted(CORNERS.tolist()), atol=0.5)


def test_of_several_starts_the_likeliest_fit_counts() -> None:
    heatmap, true = draw_mixture(CORNERS, 8.0), torch.tensor(CORNERS[None])
    poor = torch.tensor(CORNERS[None, [0, 0, 1, 1]] + [[3.0, 0], [-3.0, 0], [3.0, 0], [-3.0, 0]])
    for start, others in ((poor, [true]), (true, [poor])):
        fit = fit_modes(heatmap, 4, XS, YS, start=start, others=others)
        np.testing.assert_allclose(sorted(fit.modes[0].tolist()), sorted(CORNERS.tolist()), atol=0.5)


def test_peaks_are_where_the_heatmap_is_highest_and_absent_ones_none() -> None:
    heatmap = torch.cat([draw_mixture(CORNERS, 8.0), draw_mixture(CORNERS[:2], 8.0)])
    peaks = find_peaks(heatmap, torch.tensor([4, 2]), XS, YS)
    assert measure_errors(peaks[0], CORNERS).max() <= CELL_PX and peaks[1, 2:].isnan().all()
    assert measure_errors(peaks[1, :2], CORNERS[:2]).max() <= CELL_PX


def test_the_median_of_the_widths_is_not_moved_by_one_wide_mode() -> None:
    heatmap = 0.25 * draw_mixture(CORNERS[:1], 40.0) + 0.75 * draw_mixture(CORNERS[1:], 8.0)
    fits = [fit_modes(heatmap, 4, XS, YS, readout=ModeReadout(5.0, median_width=median)) for median in (False, True)]
    shares = [fit.weights.max() for fit in fits]
    assert shares[1] < shares[0]  # the narrower the wide mode is believed to be, the less it takes from others
