"""One motion for all questions: modes that belong together are found among those that look alike."""

from __future__ import annotations

import numpy as np
import pytest

from mmgsd.fold.consensus import Motion, assign_grasps, find_consensus, fit_motion_to, refine_motion

ASKED = np.array([[-0.4, 0.4], [0.4, 0.4], [0.4, -0.4], [-0.4, -0.4], [0.2, 0.05], [-0.3, 0.1]])
TRUTH = Motion(np.exp(0.7j), 0.3 - 0.2j)


def answer(rng: np.random.Generator, *, noise: float = 0.0, motion: Motion = TRUTH) -> tuple[np.ndarray, np.ndarray]:
    """Modes (S, 4, 2) at all quarter turns of the questions, in any order, and equal weights."""
    turned = np.stack([Motion(1j**k, 0j).apply(ASKED) for k in range(4)], 1)  # (S, 4, 2)
    modes = motion.apply(turned) + rng.normal(0, noise, turned.shape)
    return np.stack([rng.permutation(each) for each in modes]), np.full(modes.shape[:2], 0.25)


def count_quarters(motion: Motion) -> float:
    """Quarter turns from the truth."""
    return np.angle(motion.factor / TRUTH.factor) / (np.pi / 2)


def test_all_questions_are_turned_alike(rng: np.random.Generator) -> None:
    for _ in range(20):
        modes, weights = answer(rng, noise=0.005)
        motion, share = find_consensus(ASKED, modes, weights)
        quarters = count_quarters(motion)
        assert quarters == pytest.approx(round(quarters), abs=0.03) and share == 1
        assert np.linalg.norm(modes - motion.apply(ASKED)[:, None], axis=-1).min(1).max() < 0.03


def test_the_more_probable_of_like_turns_is_chosen(rng: np.random.Generator) -> None:
    modes, weights = answer(rng)
    nearest = np.linalg.norm(modes - TRUTH.apply(ASKED)[:, None], axis=-1).argmin(1)
    weights[np.arange(len(modes)), nearest] = 0.5
    motion, _ = find_consensus(ASKED, modes, weights)
    np.testing.assert_allclose(motion.apply(ASKED), TRUTH.apply(ASKED), atol=1e-6)


def test_wrong_and_absent_modes_are_outvoted(rng: np.random.Generator) -> None:
    modes, weights = answer(rng)
    modes[4] = rng.uniform(2, 3, (4, 2))
    modes[5, 1:] = np.nan
    motion, share = find_consensus(ASKED, modes, weights)
    quarters = count_quarters(motion)
    assert share in (4 / 6, 5 / 6) and quarters == pytest.approx(round(quarters), abs=1e-6)


def test_the_scale_is_free_where_no_camera_tells_it(rng: np.random.Generator) -> None:
    modes, weights = answer(rng, motion=Motion(1.7 * TRUTH.factor, 0.5 + 0.4j))
    assert find_consensus(ASKED, modes, weights)[1] < 1
    motion, share = find_consensus(ASKED, modes, weights, free_scale=True)
    assert abs(motion.factor) == pytest.approx(1.7, rel=1e-6) and share == 1


@pytest.mark.parametrize(("count", "scale"), [(2, 0.9), (2, 1.3), (3, 0.75), (4, 0.5), (4, 1.0), (4, 1.5)])
def test_like_corners_are_neither_one_place_nor_a_diagonal(count: int, scale: float) -> None:
    corners = Motion(scale * np.exp(0.4j), 0.1 + 0j).apply(ASKED[:4])
    modes = np.tile(corners, (count, 1, 1))  # each is asked for a corner, and any corner is as good an answer
    motion, share = find_consensus(ASKED[:count], modes, np.full((count, 4), 0.25), free_scale=True)
    assert abs(motion.factor) == pytest.approx(scale, rel=1e-6) and share == 1


def test_all_questions_weigh_more_than_a_scale_near_one() -> None:
    asked = np.array([[-0.4, 0.4], [0.4, 0.4], [0.1, 0.05]])
    truth = Motion(0.4 * np.exp(0.4j), 0.1 + 0j)
    corners = truth.apply(ASKED[:4])
    inner = truth.apply(np.stack([Motion(1j**k, 0j).apply(asked[2]) for k in range(4)]))
    motion, share = find_consensus(asked, np.stack([corners, corners, inner]), np.full((3, 4), 0.25), free_scale=True)
    assert abs(motion.factor) == pytest.approx(0.4, rel=1e-6) and share == 1


def test_nothing_agrees_with_no_modes() -> None:
    assert find_consensus(ASKED, np.full((6, 4, 2), np.nan), np.full((6, 4), 0.25)) is None


@pytest.mark.parametrize("asked", [ASKED[:1], ASKED[[0, 0]], ASKED[:0]])
def test_one_place_tells_no_motion(asked: np.ndarray) -> None:
    with pytest.raises(ValueError, match="picks and anchors must"):
        find_consensus(asked, np.zeros((len(asked), 4, 2)), np.ones((len(asked), 4)))


def test_a_motion_is_fitted_by_least_squares(rng: np.random.Generator) -> None:
    fitted = fit_motion_to(ASKED, TRUTH.apply(ASKED))
    np.testing.assert_allclose([fitted.factor, fitted.shift], [TRUTH.factor, TRUTH.shift], atol=1e-9)
    with pytest.raises(ValueError, match="source and target must"):
        fit_motion_to(ASKED[:1], ASKED[:1])


BENT = np.array([[-0.5, 0.3], [-0.4, 0.0], [0.0, -0.1], [0.4, 0.0], [0.5, 0.3]])  # a rope that was shown straight
STRAIGHT = np.array([[-0.8, 0.0], [-0.4, 0.0], [0.0, 0.0], [0.4, 0.0], [0.8, 0.0]])


def test_of_an_object_bent_otherwise_all_questions_count() -> None:
    modes = np.stack([BENT, BENT[::-1]], 1)  # (5, 2, 2)
    found = refine_motion(STRAIGHT, modes, Motion(np.exp(0.3j), 0.1 + 0.4j))
    best = fit_motion_to(STRAIGHT, BENT)
    np.testing.assert_allclose(found.apply(STRAIGHT), best.apply(STRAIGHT), atol=1e-9)
    modes[1:] = np.nan
    start = Motion(1 + 0j, 0j)
    assert refine_motion(STRAIGHT, modes, start) is start  # one question tells no motion


def test_no_two_questions_take_the_same_place() -> None:
    ends = STRAIGHT[[0, 4]]
    modes = np.stack([ends, ends], 0)  # both may be at either end
    aside = Motion(1 + 0j, 0.9 + 0j)  # both are nearer to the right end
    assert assign_grasps(ends, modes, aside, min_distance=0.1).tolist() == [[-0.8, 0.0], [0.8, 0.0]]
    taken = assign_grasps(ends, modes[:, 1:], aside, min_distance=0.1)  # only the right end is known
    assert np.isfinite(taken).all(1).sum() == 1
