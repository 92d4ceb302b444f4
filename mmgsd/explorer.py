"""Two images side by side in a notebook: click or drag in the left one, the right one answers."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import anywidget
import cv2
import ipywidgets
import numpy as np
import traitlets

from mmgsd.answer import Match
from mmgsd.baselines import BaselineMatcher
from mmgsd.dataset import Dataset, sample_pairs
from mmgsd.drawing import METHOD_LABELS, blend_heatmap, compute_ellipse
from mmgsd.images import to_rgb

QUALITY = 90  # of what the browser is sent, JPEG
SNAP_PX = 12.0  # a click so near to a material point shows that point's true matches


@dataclass(frozen=True)
class Scene:
    """A pair of images and, where they are known, the labels of the first and the matches in the second."""

    image0: np.ndarray  # (H0, W0, 3) uint8
    image1: np.ndarray  # (H1, W1, 3) uint8
    title: str = ""
    mask1: np.ndarray | None = None  # (H1, W1) bool, which hand-made descriptors need
    xy0: np.ndarray | None = None  # (P, 2) px of the material points
    orbits: list[np.ndarray] | None = None  # true matches (n, 2) px of each

    def find_truth(self, xy: np.ndarray) -> np.ndarray:
        """True matches (n, 2) px of the material point nearest to a pixel (2,); none where it is far or unknown."""
        if self.xy0 is None:
            return np.empty((0, 2))
        apart = np.linalg.norm(self.xy0 - xy, axis=1)
        return self.orbits[int(apart.argmin())] if apart.min() <= SNAP_PX else np.empty((0, 2))


def make_scenes(data: Dataset, *, pairs: int = 50, seed: int = 0) -> list[Callable[[], Scene]]:
    """Pairs of images of a data set's split, read when they are looked at."""
    group = data.group()

    def make(first: int, second: int) -> Scene:
        orbits = [data.xy[second][group.distinct_modes(point)] for point in range(group.n_points)]
        title = f"{data.object}, images {first} and {second}"
        images = data.load_image(first), data.load_image(second)
        seen = np.where(data.visible[first][:, None], data.xy[first], np.inf)
        return Scene(*images, title, data.load_mask(second), seen, orbits)

    chosen = sample_pairs(data.episode, pairs, np.random.default_rng(seed))
    return [lambda a=int(a), b=int(b): make(a, b) for a, b in chosen]


class Pictures(anywidget.AnyWidget):
    """The two pictures in the browser (`explorer.js`), which sends ``{"xy": [x, y]}`` and awaits an ``answered``."""

    _esm = Path(__file__).with_name("explorer.js")
    image0 = traitlets.Bytes().tag(sync=True)  # JPEG
    image1 = traitlets.Bytes().tag(sync=True)  # JPEG
    marks = traitlets.Dict().tag(sync=True)  # xy, modes, matches in px; set last, it has the browser draw


class Explorer:
    """The two pictures and their buttons; ``show()`` them in a notebook.

    ``matchers`` {name: `Matcher` or `BaselineMatcher`}; ``scenes`` are pairs of images, or functions that load one.
    Click or drag in the left image; ``ask(x, y)`` does the same from code.
    """

    def __init__(self, matchers: Mapping[str, Any], scenes: list) -> None:
        if not matchers or not scenes:
            raise ValueError("matchers and scenes must not be empty")
        self.matchers, self.scenes, self.index = dict(matchers), list(scenes), 0
        self.xy, self.answer, self.milliseconds = None, None, 0.0
        labels = [(METHOD_LABELS.get(name, name), name) for name in self.matchers]
        self.method = ipywidgets.Dropdown(options=labels, description="method")
        self.parts = {name: ipywidgets.ToggleButton(value=True, description=name, layout={"width": "9em"})
                      for name in ("heatmap", "modes", "true matches")}  # fmt: skip
        self.steps = {name: ipywidgets.Button(description=name, layout={"width": "7em"})
                      for name in ("previous", "random", "next")}  # fmt: skip
        self.pictures, self.title, self.line = Pictures(), ipywidgets.HTML(), ipywidgets.HTML()
        self._connect()
        self.open(0)

    def show(self) -> ipywidgets.Widget:
        """The widget to put on the page."""
        buttons = ipywidgets.HBox([self.method, *self.parts.values(), *self.steps.values()])
        return ipywidgets.VBox([buttons, self.title, self.pictures, self.line])

    def open(self, index: int) -> None:
        """Show one of the pairs."""
        self.index = index % len(self.scenes)
        scene = self.scenes[self.index]
        self.scene = scene() if callable(scene) else scene
        self.xy, self.answer, self._prepared = None, None, {}
        self.title.value = self.scene.title
        self.line.value = "Click or drag in the left image."
        self.pictures.image0 = _encode(self.scene.image0)
        self._draw()

    def ask(self, x: float, y: float) -> Match:
        """Answer for the pixel and draw it."""
        start = time.perf_counter()
        self.xy = np.array([x, y], float)
        self.answer = self._get_answering()(self.xy[None])
        self._draw()
        self.milliseconds = 1000 * (time.perf_counter() - start)
        self.line.value = self._describe()
        return self.answer

    def _get_answering(self) -> Callable[[np.ndarray], Match]:
        """The chosen method, its descriptors of this pair computed once."""
        name = self.method.value
        if name not in self._prepared:
            matcher, scene = self.matchers[name], self.scene
            if isinstance(matcher, BaselineMatcher):
                mask = np.ones(scene.image1.shape[:2], bool) if scene.mask1 is None else scene.mask1
                self._prepared[name] = lambda xy: matcher.match(scene.image0, scene.image1, xy, mask1=mask)
            else:
                self._prepared[name] = matcher.prepare(scene.image0, scene.image1).match
        return self._prepared[name]

    def _draw(self) -> None:
        """Send the right picture and the marks in one message."""
        image, marks = self.scene.image1, {"xy": None, "modes": [], "matches": []}
        if self.answer is not None:
            marks["xy"] = self.xy.tolist()
            if self.parts["heatmap"].value:
                image = blend_heatmap(image, self.answer.compute_heatmap())
            if self.parts["modes"].value:
                marks["modes"] = describe_modes(self.answer)
            if self.parts["true matches"].value:
                marks["matches"] = self.scene.find_truth(self.xy).tolist()
        with self.pictures.hold_sync():
            self.pictures.image1 = _encode(image)
            self.pictures.marks = marks

    def _describe(self) -> str:
        best, answer = self.answer.best(), self.answer
        return (
            f"pixel ({self.xy[0]:.0f}, {self.xy[1]:.0f}) · entropy {answer.entropy[0]:.1f} nats · outside the modes "
            f"{100 * answer.outside[0]:.0f} % · narrowest mode at ({best.xy[0, 0]:.0f}, {best.xy[0, 1]:.0f}), "
            f"±{best.spread_px[0]:.0f} px · {self.milliseconds:.0f} ms"
        )

    def _connect(self) -> None:
        self.pictures.on_msg(self._on_message)
        for widget in (self.method, *self.parts.values()):
            widget.observe(self._on_change, "value")
        rng = np.random.default_rng()
        self.steps["previous"].on_click(lambda _: self.open(self.index - 1))
        self.steps["next"].on_click(lambda _: self.open(self.index + 1))
        self.steps["random"].on_click(lambda _: self.open(int(rng.integers(len(self.scenes)))))

    def _on_message(self, _: Pictures, content: dict, buffers: list) -> None:
        try:
            self.ask(*content["xy"])
        finally:  # the browser asks on
            self.pictures.send({"answered": content["xy"]})

    def _on_change(self, change: dict) -> None:
        if self.xy is not None:
            self.ask(*self.xy)


def describe_modes(match: Match) -> list[dict[str, Any]]:
    """The first query's modes: ``x``, ``y``, the 1-std ellipse's ``radii`` in px and ``angle`` in rad, ``weight``."""
    modes = []
    for (x, y), weight, covariance in zip(match.modes[0], match.weights[0], match.covariances[0], strict=True):
        if np.isfinite(x):
            radii, angle = compute_ellipse(covariance)
            place = {"x": float(x), "y": float(y), "weight": float(weight)}
            modes.append({**place, "radii": radii.tolist(), "angle": float(angle)})
    return modes


def _encode(image: np.ndarray) -> bytes:
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()


def make_own_scene(image0: np.ndarray, image1: np.ndarray) -> Scene:
    """A scene of a user's own images, of any kind that `Matcher.match` takes."""
    return Scene(to_rgb(image0, "image0"), to_rgb(image1, "image1"), "your images")
