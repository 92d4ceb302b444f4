"""Two images side by side in a notebook: click or drag in the left one, the right one answers."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import ipywidgets
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.backend_bases import MouseEvent

from mmgsd.baselines import BaselineMatcher
from mmgsd.dataset import Dataset, sample_pairs
from mmgsd.drawing import MARK, METHOD_LABELS, blend_heatmap, draw_modes
from mmgsd.matching import Match, to_rgb

TRUE = "#00FF6A"  # the sign of true matches
QUEUED_S = 0.02  # a drag's positions that come so soon after an answer had to wait for it: later ones follow
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


class Explorer:
    """The two pictures and their buttons; ``show()`` in a notebook with ``%matplotlib widget``.

    ``matchers`` {name: `Matcher` or `BaselineMatcher`}; ``scenes`` are pairs of images, or functions that load one.
    Click or drag in the left image; ``ask(x, y)`` does the same from code.
    """

    def __init__(self, matchers: Mapping[str, Any], scenes: list) -> None:
        if not matchers or not scenes:
            raise ValueError("matchers and scenes must not be empty")
        self.matchers, self.scenes, self.index = dict(matchers), list(scenes), 0
        self.xy, self.answer, self.milliseconds, self._answered = None, None, 0.0, 0.0
        labels = [(METHOD_LABELS.get(name, name), name) for name in self.matchers]
        self.method = ipywidgets.Dropdown(options=labels, description="method")
        self.parts = {name: ipywidgets.ToggleButton(value=True, description=name, layout={"width": "8em"})
                      for name in ("heatmap", "modes", "true matches")}  # fmt: skip
        self.steps = {name: ipywidgets.Button(description=name, layout={"width": "7em"})
                      for name in ("previous", "random", "next")}  # fmt: skip
        self.line = ipywidgets.HTML("Click or drag in the left image.")
        self._build_figure()
        self._connect()
        self.open(0)

    def show(self) -> ipywidgets.Widget:
        """The widget to put on the page."""
        buttons = ipywidgets.HBox([self.method, *self.parts.values(), *self.steps.values()])
        return ipywidgets.VBox([buttons, self.figure.canvas, self.line])

    def open(self, index: int) -> None:
        """Show one of the pairs."""
        self.index = index % len(self.scenes)
        scene = self.scenes[self.index]
        self.scene = scene() if callable(scene) else scene
        self.xy, self._prepared = None, {}
        for axis, image, title in zip(self.axes, (self.scene.image0, self.scene.image1),
                                      (self.scene.title or "source", "matches"), strict=True):  # fmt: skip
            axis.clear()
            axis.set(xticks=[], yticks=[])
            axis.set_title(title, fontsize=9)
            axis.imshow(image)
            axis.autoscale(False)
        self.figure.set_layout_engine("constrained")
        self.figure.draw_without_rendering()
        self.figure.set_layout_engine("none")  # a third of the time to draw, and nothing moves any more
        self._refresh()

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
        left, right = self.axes
        for artist in (*left.collections, *right.collections, *right.patches):
            artist.remove()
        left.scatter(*self.xy, s=45, facecolors=MARK, edgecolors="black", linewidths=0.9, zorder=3)
        shown = self.parts["heatmap"].value
        image = blend_heatmap(self.scene.image1, self.answer.heatmap[0]) if shown else self.scene.image1
        right.images[0].set_data(image)
        if self.parts["modes"].value:
            draw_modes(right, self.answer, 0)
        truth = self.scene.find_truth(self.xy)
        if self.parts["true matches"].value and len(truth):
            right.scatter(*truth.T, s=55, marker="+", c=TRUE, linewidths=1.6, zorder=3)
        self._refresh()

    def _refresh(self) -> None:
        """Send the picture at once, as ``draw_idle`` would only when the browser asks, but not before it is there.

        ipympl draws all when a browser has opened the figure; what it is sent before that leaves it without a size.
        """
        if not getattr(self.figure.canvas, "syncing_data_url", False):
            self.figure.canvas.draw()

    def _describe(self) -> str:
        best, answer = self.answer.best(), self.answer
        return (
            f"pixel ({self.xy[0]:.0f}, {self.xy[1]:.0f}) · entropy {answer.entropy[0]:.1f} nats · outside the modes "
            f"{100 * answer.outside[0]:.0f} % · narrowest mode at ({best.xy[0, 0]:.0f}, {best.xy[0, 1]:.0f}), "
            f"±{best.spread_px[0]:.0f} px · {self.milliseconds:.0f} ms"
        )

    def _build_figure(self) -> None:
        with plt.ioff():
            self.figure, self.axes = plt.subplots(1, 2, figsize=(9, 4.7))
        for name in ("header_visible", "footer_visible", "toolbar_visible"):
            if hasattr(self.figure.canvas, name):  # ipympl's canvas: nothing but the pictures
                setattr(self.figure.canvas, name, False)
        if hasattr(self.figure.canvas, "syncing_data_url"):  # the size is known before a browser asks for it
            self.figure.canvas.manager.resize(*self.figure.bbox.size)

    def _connect(self) -> None:
        for kind in ("button_press_event", "motion_notify_event", "button_release_event"):
            self.figure.canvas.mpl_connect(kind, self._on_mouse)
        for widget in (self.method, *self.parts.values()):
            widget.observe(self._on_change, "value")
        rng = np.random.default_rng()
        self.steps["previous"].on_click(lambda _: self.open(self.index - 1))
        self.steps["next"].on_click(lambda _: self.open(self.index + 1))
        self.steps["random"].on_click(lambda _: self.open(int(rng.integers(len(self.scenes)))))

    def _on_mouse(self, event: MouseEvent) -> None:
        if event.inaxes is not self.axes[0] or event.button != 1:
            return
        waited = event.name == "motion_notify_event" and time.perf_counter() - self._answered < QUEUED_S
        xy = [event.xdata, event.ydata]
        if not waited and (self.xy is None or not np.array_equal(self.xy, xy)):
            self.ask(*xy)
            self._answered = time.perf_counter()

    def _on_change(self, change: dict) -> None:
        if self.xy is not None:
            self.ask(*self.xy)


def make_own_scene(image0: np.ndarray, image1: np.ndarray) -> Scene:
    """A scene of a user's own images, of any kind that `Matcher.match` takes."""
    return Scene(to_rgb(image0, "image0"), to_rgb(image1, "image1"), "your images")
