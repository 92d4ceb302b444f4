"""Points stay themselves: while the object turns, when frames lie, when it is hidden, lost and found again."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from videos import turn_sample

import mmgsd
from mmgsd.config import TrainConfig
from mmgsd.match import track
from mmgsd.match.match import Match
from mmgsd.match.matcher import Matcher
from mmgsd.match.track import Track, Tracker, assign_others, choose_apart, compare_maps, flow_there_and_back
from mmgsd.measure.tracking import Truth, measure_track
from mmgsd.model.network import build_network
from mmgsd.studies.tracking import METHODS
from mmgsd.symmetry import load_group

MIDDLE = np.array([100.0, 100.0])
PLACES = np.stack(np.meshgrid(*[np.linspace(40, 160, 7)] * 2), -1).reshape(-1, 2)  # of a square object
ASKED = np.array([[40.0, 40], [150, 60], [100, 45]])


def turn(xy: np.ndarray, degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    return (xy - MIDDLE) @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) + MIDDLE


def answer(degrees: float, rng: np.random.Generator, *, noise: float = 2.0, absent: float = 0.0) -> tuple:
    """What `Pair.match_everywhere` says of a square that is turned, its four maps in any order."""
    xy = np.concatenate([ASKED, PLACES])
    modes = np.stack([turn(xy, degrees + 90 * k) for k in rng.permutation(4)], 1) + noise * rng.normal(size=(52, 4, 2))
    shuffled = np.argsort(rng.random((52, 4)), 1)
    order, grey = np.argsort(shuffled, 1), np.zeros((200, 200, 3), np.uint8)
    covariances = np.tile(9 * np.eye(2), (52, 4, 1, 1))
    modes, nothing = np.take_along_axis(modes, shuffled[..., None], 1), np.zeros(52)
    match = Match(grey, grey, xy, modes, np.full((52, 4), 0.25), covariances, nothing, nothing, np.zeros((52, 2, 2)),
                  visible=np.full((52, 4), 0.9), absent=nothing + absent)  # fmt: skip
    return match, order


@pytest.fixture
def follow(monkeypatch: pytest.MonkeyPatch) -> Iterator:
    """Tracks through answers instead of images."""

    def run(answers: list) -> Track:
        pairs = (SimpleNamespace(image0=match.image0, image1=match.image1, outputs=(None,), mask0=None,
                                 match_everywhere=lambda _, answer=(match, order): answer)
                 for match, order in [answers[0], *answers])  # fmt: skip
        matcher = SimpleNamespace(prepare=lambda *_, **__: next(pairs), size=(200, 200))
        monkeypatch.setattr(Tracker, "_prepare", lambda *_: next(pairs))
        tracker = Tracker(matcher, None, ASKED)
        return Track.collect(tracker.update(None) for _ in answers)

    yield run


def measure_error(found: Track, degrees: list[float]) -> np.ndarray:
    return np.linalg.norm(found.xy - np.stack([turn(ASKED, angle) for angle in degrees]), axis=-1).max(1)


def test_points_of_a_square_stay_themselves_over_a_whole_turn(follow, rng: np.random.Generator) -> None:
    degrees = list(np.linspace(0, 360, 25))
    found = follow([answer(angle, rng) for angle in degrees])
    assert measure_error(found, degrees).max() < 12 and (found.confidence > 0.5).all()


def test_a_frame_of_nonsense_changes_nobody(follow, rng: np.random.Generator) -> None:
    degrees = list(np.linspace(0, 90, 13))
    answers = [answer(angle, rng) for angle in degrees]
    answers[5] = answer(degrees[5] + 45, rng, noise=60)
    answers[6] = answer(degrees[6] + 40, rng, noise=30)
    assert np.delete(measure_error(follow(answers), degrees), [5, 6]).max() < 12


def test_what_is_lost_is_found_again_as_itself(follow, rng: np.random.Generator) -> None:
    degrees = [0, 15, 30, 45, 50, 55, 60, 65]
    found = follow([answer(angle, rng, absent=0.9 * (3 <= k <= 5)) for k, angle in enumerate(degrees)])
    assert np.isnan(found.xy[3:6]).all() and not found.visible[3:6].any() and not found.confidence[3:6].any()
    assert found.absent.tolist() == [0, 0, 0, 0.9, 0.9, 0.9, 0, 0]
    assert np.delete(measure_error(found, degrees), [3, 4, 5]).max() < 12


def test_a_first_frame_without_the_object_is_refused(follow, rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match="image0 must"):
        follow([answer(0, rng, absent=0.9)])


def test_memory_does_not_grow(follow, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes, remember = [], Tracker._remember
    monkeypatch.setattr(Tracker, "_remember", lambda self, *a: (remember(self, *a), sizes.append(len(self._memory))))
    follow([answer(angle, rng) for angle in range(20)])
    assert max(sizes) == track.MEMORY


def test_a_map_that_stayed_is_likelier_than_one_that_moved(rng: np.random.Generator) -> None:
    before = rng.uniform(0, 100, (30, 3, 2))
    likelihood = compare_maps(before, before[:, [2, 0, 1]] + rng.normal(size=(30, 3, 2)), 1)
    assert likelihood.argmax(1).tolist() == [1, 2, 0]
    assert assign_others(likelihood, 0, 1)[0].tolist() == [1, 2, 0]
    assert assign_others(likelihood, 0, 2)[0][0] == 2  # as it is told, whatever fits better
    before[:, 1] = np.nan
    assert np.isfinite(compare_maps(before, before, 1)).all()


def test_places_apart_are_chosen_of_those_that_coincide() -> None:
    xy = np.array([[0.0, 0], [0.1, 0], [50, 0], [50.1, 0]])
    assert choose_apart(xy, 2).tolist() == [0, 3] and choose_apart(xy, 1).tolist() == [0]


def test_flow_comes_back_where_there_is_something_to_see(rng: np.random.Generator) -> None:
    grey = np.kron(rng.integers(0, 255, (20, 20), np.uint8), np.ones((8, 8), np.uint8))
    moved, kept = flow_there_and_back(grey, np.roll(grey, 3, 1), np.array([[80.0, 80], [60, 90], [np.nan, np.nan]]))
    assert kept.tolist() == [True, True, False] and np.isnan(moved[2]).all()
    np.testing.assert_allclose(moved[:2], [[83, 80], [63, 90]], atol=0.3)
    assert not flow_there_and_back(grey, 255 - grey, np.array([[80.0, 80]]))[1].any()


# With networks. -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def untrained() -> Matcher:
    torch.manual_seed(0)
    config = TrainConfig(input_px=64, descriptor_dim=8)
    return Matcher(build_network("lite0", 8, pretrained=False), config, modes=4, size=(485, 485), device="cpu",
                   places=torch.randn(625, 8))  # fmt: skip


@pytest.fixture
def frames(rng: np.random.Generator) -> list[np.ndarray]:
    return list(rng.integers(0, 256, (3, 60, 80, 3), dtype=np.uint8))


@pytest.fixture
def mask() -> np.ndarray:
    return np.pad(np.ones((40, 60), bool), 10)


def test_a_track_has_the_promised_form_and_its_stream_says_the_same(
    untrained: Matcher, frames: list[np.ndarray], mask: np.ndarray
) -> None:
    found = untrained.track(frames, [(20, 20), (60, 40)], mask0=mask)
    assert (found.xy.shape, found.visible.shape, found.confidence.shape, found.absent.tolist(), len(found)) == (
        (3, 2, 2), (3, 2), (3, 2), [0, 0, 0], 3)  # fmt: skip
    assert np.isnan(found.visible).all()  # these weights do not know
    stream = untrained.follow(iter(frames), [(20, 20), (60, 40)], mask0=mask)
    for k, one in enumerate(stream):
        np.testing.assert_array_equal(one.xy, found.xy[k])


def test_places_by_name_are_followed_with_all_like_them(untrained: Matcher, frames: list[np.ndarray]) -> None:
    untrained.object = "cloth"
    found = untrained.track(frames[:2], find=["corners", "centre"])
    assert found.xy.shape == (2, 4 + 1, 2) and np.isfinite(found.xy).all()


@pytest.mark.parametrize(("change", "wrong"), [
    ({"xy": None}, "either xy or places must be given, got none"),
    ({"find": "corners"}, "either xy or places must be given, got both"),
    ({"xy": [(90, 20)]}, "xy must be finite and inside image0"),
    ({"mask0": None}, "do not know where the object lies"),
    ({"frames": []}, "frames must be images, one or more, got none"),
])  # fmt: skip
def test_what_cannot_be_followed_is_refused(
    untrained: Matcher, frames: list[np.ndarray], mask: np.ndarray, change: dict, wrong: str
) -> None:
    given = {"frames": frames, "xy": [(20, 20)], "mask0": mask, **change}
    with pytest.raises(ValueError, match=wrong):
        untrained.track(**given)


def test_frames_of_other_sizes_are_refused(untrained: Matcher, frames: list[np.ndarray], mask: np.ndarray) -> None:
    stream = untrained.follow([frames[0], frames[1][:50]], [(20, 20)], mask0=mask)
    next(stream)
    with pytest.raises(ValueError, match="80 x 60 px, got 80 x 50 px for frame 1"):
        next(stream)


def test_a_turning_cloth_s_points_stay_themselves_with_the_shipped_weights() -> None:
    video = turn_sample("cloth", 0, count=8, degrees=120)
    points = np.array([p for p in (0, 12, 24, 300, 324, 600, 612, 624) if video.visible[0, p]])
    likes = load_group("cloth", "c4").permutations[1:, points]
    truth = Truth(video.xy[:, points], video.visible[:, points], video.xy[:, likes], (485, 485))
    found = mmgsd.load("cloth").track(video.frames, video.xy[0, points])
    ours = measure_track(found.xy, found.visible > 0.5, truth)
    flow = measure_track(*METHODS["dis"].follow("cloth", video.frames, video.xy[0, points]), truth)
    assert ours["swaps"] <= 0.02 and ours["delta"] > max(0.45, flow["delta"])


def test_a_pixel_beside_the_object_is_named_and_hidden(follow, rng: np.random.Generator) -> None:
    match, order = answer(0, rng)
    seen = np.ones(len(match))
    seen[1] = 0.02
    with pytest.warns(UserWarning, match=r"more likely background: \[\[150.0, 60.0\]\]"):
        found = follow([(dataclasses.replace(match, on_object=seen), order)])
    assert found.visible[0].tolist() == pytest.approx([0.9, 0.02, 0.9])
