"""Two images side by side in a notebook: click or drag in the left one, the right one answers.

The browser (`explorer.js`) sends messages, ``{"do": "ask", "xy": [x, y], "pair": 3, "token": "…"}``, and draws two
traits. ``pair`` holds everything that is seen of a pair of images, and a number that no other pair has. ``answer``
names the pair it belongs to, and is drawn over no other; it is numbered, so that one equal to the last is sent as
well. Every message is answered by ``{"token": "…"}`` when it has been dealt with, with an ``error`` where that went
wrong.
"""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import anywidget
import cv2
import numpy as np
import traitlets

from mmgsd.checks import check_choice
from mmgsd.extras.explorer_scenes import Scene
from mmgsd.figures.plots import plot_samples
from mmgsd.figures.style import FADED, HEAT, compute_ellipse, compute_strength, fade_image
from mmgsd.images import decode_image
from mmgsd.match.baselines import FeatureMatcher
from mmgsd.match.describe import describe_answer
from mmgsd.match.match import Match
from mmgsd.match.matcher import Matcher
from mmgsd.measure.photographs import describe_marks
from mmgsd.studies.models import get_label

JPEG_QUALITY = 90  # of what the browser is sent, JPEG
DISPLAY_PX = 1600  # longer side of what the browser is sent
HEAT_PX = 128  # longer side of the heatmap that it is sent, several times as fine as the descriptors
BASELINE_PX = 640  # longer side of what hand-made descriptors see: their windows are made for images of this size
SCRIPTS = ("explorer_marks.js", "explorer_picture.js", "explorer.js")  # one module, in this order
MOST_PINS = 8  # as many as there are colours for

log = logging.getLogger(__name__)


class Pictures(anywidget.AnyWidget):
    """The explorer in the browser: everything that is seen of it."""

    _esm = "\n".join(Path(__file__).with_name(name).read_text("utf-8") for name in SCRIPTS)
    _css = Path(__file__).with_name("explorer.css")
    pair = traitlets.Dict().tag(sync=True)  # id, number, count, names, sizes; JPEG image0, image1, faded1; truth
    marks = traitlets.Unicode("[]").tag(sync=True)  # JSON for ``python -m mmgsd measure``: what is pinned on the left
    answer = traitlets.Dict().tag(sync=True)  # pair, number, milliseconds, json, points, heat, heat_size
    methods = traitlets.List().tag(sync=True)  # [name, label] of each
    method = traitlets.Unicode().tag(sync=True)
    together = traitlets.Bool(False).tag(sync=True)  # whether all points are answered under one member of the symmetry
    heat_colours = traitlets.Bytes((255 * HEAT).astype(np.uint8).tobytes()).tag(sync=True)  # 256 times R, G, B

    still: Callable[[], bytes] = bytes  # makes a JPEG of what is seen

    def __repr__(self) -> str:
        """What stands in a notebook where neither a widget nor a picture can be shown."""
        return "the explorer (run this cell to see it)"

    def _repr_mimebundle_(self, **kwargs: Any) -> tuple[dict, dict]:
        """The widget, and a picture for where nothing runs, as on a page that shows a notebook."""
        data, metadata = super()._repr_mimebundle_(**kwargs)
        return data | {"image/jpeg": base64.b64encode(self.still()).decode()}, metadata


class Explorer:
    """The two pictures with everything around them; ``show()`` them in a notebook.

    ``matchers`` {name: `Matcher` or `FeatureMatcher`}; ``scenes`` are pairs of images, or functions that load one.
    Click or drag in the left image; ``ask(x, y)`` does the same from code.
    """

    def __init__(self, matchers: Mapping[str, Any], scenes: list) -> None:
        if not matchers or not scenes:
            raise ValueError("matchers and scenes must not be empty")
        self.matchers, self.scenes, self.pairs_opened, self.answers = dict(matchers), list(scenes), 0, 0
        self.rng, self._own, self._parts, self.marks = np.random.default_rng(), None, {}, {}
        methods = [[name, get_label(name, short=True)] for name in self.matchers]
        self.pictures = Pictures(methods=methods, method=methods[0][0])
        self.pictures.still = self._draw
        self.pictures.on_msg(self._on_message)
        self.open(0)

    def show(self) -> Pictures:
        """The widget to put on the page."""
        return self.pictures

    def _draw(self) -> bytes:
        """A JPEG of the last answer, or of the two images."""
        images, written = [self.scene.image0, self.scene.image1], io.BytesIO()
        figure = plot_samples(images, columns=2) if self.answer is None else self.answer.plot(len(self.answer) - 1)
        figure.savefig(written, format="jpeg", bbox_inches="tight")
        return written.getvalue()

    def open(self, index: int) -> None:
        """Show one of the pairs; where it cannot be read, the last one stays."""
        index %= len(self.scenes)
        scene = self.scenes[index]
        self.scene = scene() if callable(scene) else scene
        self.index, self.xy, self.pins, self.answer, self._prepared = index, None, [], None, {}
        self.pairs_opened += 1
        place = {"id": self.pairs_opened, "number": index + 1, "count": len(self.scenes)}
        self.pictures.pair = place | show_scene(self.scene)

    def ask(self, x: float, y: float, *, pin: bool = False) -> Match:
        """Answer for the pixel, and for those pinned before it, and draw it all; ``pin`` has this one stay as well."""
        pins, xy = list(self.pins), (float(x), float(y))
        if pin and len(pins) == MOST_PINS:
            raise ValueError(f"{MOST_PINS} points are pinned, and there are no colours for more: clear them first")
        answer = self._answer([*pins, xy])
        self.pins, self.xy = (pins + [xy], None) if pin else (pins, xy)
        if pin:
            self._mark()
        return answer

    def choose(self, name: str, value: Any) -> None:
        """Answer all points anew with the trait ``method`` or ``together`` changed, or raise and leave all as it was.

        ``method`` is the name of the matcher that answers; ``together``: whether it answers all points together
        (`Matcher.match`, ``joint``).
        """
        if name == "method":
            check_choice(name, value, self.matchers)
        before = getattr(self.pictures, name)
        setattr(self.pictures, name, value)
        try:
            self._answer(self.points)
        except Exception:
            setattr(self.pictures, name, before)
            raise

    @property
    def points(self) -> list[tuple[float, float]]:
        """The pixels that are asked about: the pinned ones first."""
        return [*self.pins, *([] if self.xy is None else [self.xy])]

    def clear(self) -> None:
        """Forget every pixel that was asked about."""
        self.pins, self.xy = [], None
        self._answer([])
        self._mark()

    def _mark(self) -> None:
        """Take what is pinned for the marked places of the left image; they stay when another is opened."""
        if self.scene.flat:  # no photograph
            return
        file, kind = self.scene.name0, getattr(self.matchers[self.pictures.method], "object", "")
        self.marks.pop(file, None)
        if self.pins:
            self.marks[file] = describe_marks(file, self.pins, kind)
        self.pictures.marks = json.dumps(list(self.marks.values()), indent=1)

    def open_own(self, side: int, image: np.ndarray, name: str) -> None:
        """Show the user's image as the left (0) or right (1) one beside what is there; a pair after all others."""
        self._open_beside(self.scene.replace_image(side, image, name))

    def lay_flat(self) -> None:
        """Show the object laid flat for the left image: a click asks for a place, as `Matcher.find` does.

        ValueError where the chosen method does not know the object's places.
        """
        self._open_beside(self.scene.lay_flat(self._get_trained("laid flat").lay_flat()))

    def _open_beside(self, scene: Scene) -> None:
        if self._own is None:
            self._own = len(self.scenes)
            self.scenes.append(scene)
        self.scenes[self._own] = scene
        self.open(self._own)

    def _answer(self, points: list[tuple[float, float]]) -> Match | None:
        """Have the chosen method answer for all points, and the browser draw what it says."""
        start, match = time.perf_counter(), None
        if points:
            answer = self._get_answering()
            match = answer(np.array(points), joint=True) if self._check_together() else answer(np.array(points))
        drawing = {"json": "[]", "points": []} if match is None else show_answer(match, self.scene)
        self.milliseconds = 1000 * (time.perf_counter() - start)
        self.answers += 1
        about = {"pair": self.pairs_opened, "number": self.answers, "milliseconds": round(self.milliseconds)}
        self.answer, self.pictures.answer = match, about | drawing
        return match

    def _check_together(self) -> bool:
        """Whether all points are to be answered together; ValueError, in the page's words, where the method cannot."""
        if not self.pictures.together:
            return False
        if not self.scene.flat and not self._get_trained("together").config.heads:
            raise ValueError(f"together must be off for {get_label(self.pictures.method, short=True)}, which has not "
                             "learnt where the object is: choose another method")  # fmt: skip
        return True

    def _get_trained(self, what: str) -> Matcher:
        """The chosen method; ValueError, in the page's words, where it is a hand-made one."""
        name, matcher = self.pictures.method, self.matchers[self.pictures.method]
        if isinstance(matcher, FeatureMatcher):
            raise ValueError(f"{what} must be off for {get_label(name, short=True)}, which has learnt nothing of the "
                             "object: choose another method")  # fmt: skip
        return matcher

    def _get_answering(self) -> Callable[..., Match]:
        """The chosen method, its descriptors of this pair computed once."""
        name = self.pictures.method
        if name not in self._prepared:
            matcher, scene = self.matchers[name], self.scene
            if scene.flat:
                flat = self._get_trained("laid flat").lay_flat()
                answer = matcher.prepare(None, scene.image1).lay_beside(flat).match
            elif isinstance(matcher, FeatureMatcher):
                answer = prepare_baseline(matcher, scene)
            else:
                answer = matcher.prepare(scene.image0, scene.image1).match
            self._prepared[name] = answer
        return self._prepared[name]

    def _on_message(self, _: Pictures, content: dict, buffers: list) -> None:
        """Do what the browser asks for; it hears of every end, and the reader of every error, in a sentence."""
        reply = {"token": content.get("token")}
        try:
            self._handle(content, buffers)
        except (ValueError, OSError) as error:
            reply["error"] = _to_sentence(error)
        except Exception as error:
            log.exception("the explorer could not do %s", content.get("do"))
            reply["error"] = f"{type(error).__name__}: {_to_sentence(error)}"
        self.pictures.send(reply)

    def _handle(self, content: dict, buffers: list) -> None:
        do = content.get("do")
        if do == "ask":
            if content["pair"] == self.pairs_opened:  # else it was asked about a pair that is gone
                self.ask(*content["xy"], pin=bool(content.get("pin")))
        elif do == "step":
            self._step(content["to"])
        elif do == "method":
            self.choose("method", content["name"])
        elif do == "together":
            self.choose("together", bool(content["on"]))
        elif do == "clear":
            self.clear()
        elif do == "flat":
            self.lay_flat()
        elif do == "file":
            self._receive(content, buffers)
        else:
            raise ValueError(f"do must be ask, step, method, together, clear, flat or file, got {do!r}")

    def _step(self, to: str) -> None:
        count = len(self.scenes)
        other = int(self.rng.integers(1, count)) if count > 1 else 0  # never the same pair again
        self.open(self.index + {"previous": -1, "next": 1, "random": other}[to])

    def _receive(self, content: dict, buffers: list) -> None:
        """A part of a file; with the last one, the image is shown."""
        side, name = int(content["side"]), str(content["name"])
        parts = [] if content["part"] == 0 else self._parts.pop(side, [])
        parts.append(bytes(buffers[0]))
        if len(parts) < content["parts"]:
            self._parts[side] = parts
        else:
            self.open_own(side, decode_image(io.BytesIO(b"".join(parts)), name), name)


def show_scene(scene: Scene) -> dict[str, Any]:
    """What the browser is told of a pair of images; they are made smaller for it, their sizes are the true ones."""
    image0, image1 = (_shrink(image, DISPLAY_PX) for image in (scene.image0, scene.image1))
    faded = (255 * FADED * fade_image(image1)[..., 0]).astype(np.uint8)
    sizes = [[image.shape[1], image.shape[0]] for image in (scene.image0, scene.image1)]
    pictures = {"image0": _encode(image0[..., ::-1]), "image1": _encode(image1[..., ::-1]), "faded1": _encode(faded)}
    return pictures | {"names": [scene.name0, scene.name1], "sizes": sizes, "truth": scene.xy0 is not None}


def show_answer(match: Match, scene: Scene) -> dict[str, Any]:
    """What the browser is told of an answer: ``json`` as of ``python -m mmgsd match --json``, and what is drawn.

    ``points`` {ellipses, matches} of each query, see `describe_ellipses`, px; ``heat`` of the last one, 0 to 255;
    ``joint`` of answers that belong together how much each weighs, or [].
    """
    height, width = scene.image1.shape[:2]
    scale = HEAT_PX / max(width, height)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    heat = compute_strength(cv2.resize(match.cells[-1].astype(np.float32), size, interpolation=cv2.INTER_LINEAR))
    ellipses = (describe_ellipses(match, query) for query in range(len(match.xy)))
    truth = (scene.find_truth(xy).tolist() for xy in match.xy)
    points = [{"ellipses": shapes, "matches": true} for shapes, true in zip(ellipses, truth, strict=True)]
    heatmap = {"heat": np.rint(255 * heat).astype(np.uint8).tobytes(), "heat_size": list(size)}
    joint = [] if match.joint_weights is None else match.joint_weights.astype(float).round(4).tolist()
    return heatmap | {"json": json.dumps(describe_answer(match)), "points": points, "joint": joint}


def describe_ellipses(match: Match, query: int = 0) -> list[dict[str, float]]:
    """A query's modes that are there: ``x``, ``y``, ``major`` and ``minor`` radius of 1 std in px, ``angle`` in rad."""
    described = []
    for k in np.flatnonzero(match.weights[query] > 0):
        (x, y), (radii, angle) = match.modes[query, k].tolist(), compute_ellipse(match.covariances[query, k])
        described.append({"x": x, "y": y, "major": float(radii[0]), "minor": float(radii[1]), "angle": float(angle)})
    return described


def prepare_baseline(matcher: FeatureMatcher, scene: Scene) -> Callable[..., Match]:
    """Answers of baselines, which see large images made smaller; pixels (S, 2) are those of the large."""
    small = [_shrink(image, BASELINE_PX) for image in (scene.image0, scene.image1)]
    size = (small[1].shape[1], small[1].shape[0])
    mask = None if scene.mask1 is None else cv2.resize(scene.mask1.astype(np.uint8), size, interpolation=0).astype(bool)
    ratio0, ratio1 = (
        np.divide(image.shape[1::-1], less.shape[1::-1])
        for image, less in zip((scene.image0, scene.image1), small, strict=True)
    )

    def answer(xy: np.ndarray) -> Match:
        """The answer about pixels of the whole image, from that about the small one."""
        small_match = matcher.match(*small, (xy + 0.5) / ratio0 - 0.5, mask1=mask)
        back = {
            "modes": (small_match.modes + 0.5) * ratio1 - 0.5,
            "covariances": small_match.covariances * np.outer(ratio1, ratio1),
            "scale": float(np.sqrt(ratio1.prod())),  # to the entropy and the confidence, the size is no matter
        }
        return dataclasses.replace(small_match, image0=scene.image0, image1=scene.image1, xy=xy, **back)

    return answer


def _shrink(image: np.ndarray, longest: int) -> np.ndarray:
    """The image, or a smaller one where its longer side exceeds ``longest``."""
    scale = longest / max(image.shape[:2])
    size = (max(1, round(scale * image.shape[1])), max(1, round(scale * image.shape[0])))
    return image if scale >= 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _encode(image: np.ndarray) -> bytes:
    """JPEG of a grey or BGR image."""
    return cv2.imencode(".jpg", np.ascontiguousarray(image), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def _to_sentence(error: Exception) -> str:
    return " ".join(str(error).split())[:400] or type(error).__name__
