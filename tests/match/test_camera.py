"""Pixels and rays: by hand, there and back, and bad arguments."""

from __future__ import annotations

import numpy as np
import pytest

from mmgsd.match.camera import compute_rays

INTRINSICS = np.array([[500.0, 0, 242], [0, 500, 242], [0, 0, 1]])


def test_rays_by_hand() -> None:
    rays = compute_rays([[242, 242], [242 + 500, 242], [np.nan, 3]], INTRINSICS)
    np.testing.assert_allclose(rays, [[0, 0, 1], [np.sqrt(0.5), 0, np.sqrt(0.5)], [np.nan] * 3])


def test_there_and_back(rng: np.random.Generator) -> None:
    xy = rng.uniform(0, 485, (4, 7, 2))
    rays = compute_rays(xy, INTRINSICS.ravel())
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1)
    pixels = 3.7 * rays @ INTRINSICS.T
    np.testing.assert_allclose(pixels[..., :2] / pixels[..., 2:], xy)


@pytest.mark.parametrize("given", [INTRINSICS, INTRINSICS.ravel(), INTRINSICS.tolist(), (500, 500, 242, 242)])
def test_intrinsics_are_a_matrix_its_numbers_or_four(given: object) -> None:
    np.testing.assert_array_equal(compute_rays([7, 9], given), compute_rays([7, 9], INTRINSICS))


@pytest.mark.parametrize("bad", [np.zeros((3, 3)), np.arange(9), np.eye(4), 5, (1, 2, 3), (0, 500, 242, 242), np.eye(2),
                                 (500, np.nan, 242, 242), (500, -500, 242, 242), np.diag([0, 5, 1])])  # fmt: skip
def test_no_intrinsics(bad: object) -> None:
    with pytest.raises(ValueError, match="intrinsics must"):
        compute_rays([1, 2], bad)


def test_other_shapes() -> None:
    with pytest.raises(ValueError, match=r"xy must .*got \(3,\)"):
        compute_rays([1, 2, 3], INTRINSICS)
