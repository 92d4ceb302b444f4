"""Procedural textures of the object and of what it lies on, as shader nodes.

Textures on the object are invariant under the symmetry of the plain object (all of a square's turns and flips) or live
in world space anew in each view: a print would tell the corners apart.
"""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np
from PIL import Image, ImageDraw

from mmgsd.scene.blender import MASK_PASS
from mmgsd.scene.geometry import log_uniform
from mmgsd.scene.textures.colours import Colour, draw_colour, draw_contrasting, to_srgb, vary_colour

CLUTTER_PX = 512


# Shader. ------------------------------------------------------------------------------------------------------------


class Shader:
    """A material's node tree under construction; sockets go in and out of its methods."""

    def __init__(self, material: bpy.types.Material) -> None:
        material.use_nodes = True
        self.material, self.tree = material, material.node_tree
        self.tree.nodes.clear()

    def node(self, kind: str, inputs: dict | None = None, **properties: object) -> bpy.types.Node:
        """Add a node; ``inputs`` are values or sockets, by name or position."""
        node = self.tree.nodes.new("ShaderNode" + kind)
        for name, value in properties.items():
            setattr(node, name, value)
        for key, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[key])
            else:
                node.inputs[key].default_value = value
        return node

    def math(self, operation: str, *values: object) -> bpy.types.NodeSocket:
        """A scalar operation on values or sockets."""
        return self.node("Math", dict(enumerate(values)), operation=operation).outputs[0]

    def mix(self, factor: object, a: object, b: object) -> bpy.types.NodeSocket:
        """Linear mix of two colours."""
        return self.node("MixRGB", {0: factor, 1: a, 2: b}).outputs[0]

    def picture(self, pixels: np.ndarray, place: object, *, name: str = "picture", repeat: bool = True) -> object:
        """The colour of a picture (H, W, 3) uint8 sRGB laid over the unit square of ``place``.

        None of an earlier view is removed before the episode ends: Cycles would take a new one at its address for it.
        """
        height, width = pixels.shape[:2]
        image = bpy.data.images.new(name, width, height)
        rgba = np.ones((height, width, 4), dtype=np.float32)
        rgba[..., :3] = pixels[::-1] / np.float32(255)
        image.pixels.foreach_set(rgba.ravel())
        extension = "REPEAT" if repeat else "EXTEND"
        return self.node("TexImage", {"Vector": place}, image=image, extension=extension).outputs[0]

    def finish(self, colour: object, roughness: float, gloss: float, on_object: bool, normal: object = None) -> None:
        """Close the tree with a rough surface under a share ``gloss`` of shine; the mask learns what is the object."""
        relief = {} if normal is None else {"Normal": normal}
        surface = self.node("BsdfDiffuse", {"Color": colour, "Roughness": roughness, **relief}).outputs[0]
        if gloss:  # a full principled shader takes half as long again for each image
            shine = self.node("BsdfGlossy", {"Color": (1, 1, 1, 1), "Roughness": roughness}).outputs[0]
            surface = self.node("MixShader", {0: gloss, 1: surface, 2: shine}).outputs[0]
        self.node("OutputMaterial", {"Surface": surface})
        self.node("OutputAOV", {"Value": float(on_object)}, aov_name=MASK_PASS)


def draw_gloss(rng: np.random.Generator, chance: float, most: float) -> float:
    """No shine, or with ``chance`` a share of at most ``most``."""
    return float(rng.uniform(0.01, most)) if rng.random() < chance else 0.0


# On the object. -------------------------------------------------------------------------------------------------------


def _mottled(rng: np.random.Generator, shader: Shader, colour: Colour) -> object:
    """Blotches in world space, of a size from threads to stains."""
    place = shader.node("TexCoord").outputs["Object"]
    scale = log_uniform(rng, 3, 120)
    inputs = {"Vector": shader.node("Mapping", {"Vector": place, "Location": rng.uniform(-50, 50, 3)}).outputs[0]}
    noise = shader.node("TexNoise", {**inputs, "Scale": scale, "Detail": 1.0}).outputs[0]
    return shader.mix(_steeper(shader, noise), colour, vary_colour(rng, colour, 0.35))


def _steeper(shader: Shader, noise: object) -> bpy.types.NodeSocket:
    """Noise crowds around a half: spread it over 0 to 1."""
    return shader.node("MapRange", {"Value": noise, "From Min": 0.35, "From Max": 0.65}).outputs[0]


def _rest_axes(shader: Shader) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]:
    """The cloth's own coordinates, -1/2 to 1/2."""
    rest = shader.node("Attribute", attribute_name="rest").outputs["Vector"]
    split = shader.node("SeparateXYZ", {0: rest})
    return split.outputs[0], split.outputs[1]


def _woven(rng: np.random.Generator, shader: Shader, colour: Colour) -> object:
    """Threads both ways, even about the cloth's centre."""
    turns = 2 * np.pi * rng.uniform(20, 60)
    waves = [shader.math("COSINE", shader.math("MULTIPLY", axis, turns)) for axis in _rest_axes(shader)]
    factor = shader.math("MULTIPLY_ADD", shader.math("MULTIPLY", *waves), 0.5, 0.5)
    return shader.mix(factor, colour, vary_colour(rng, colour, 0.3))


def _gingham(rng: np.random.Generator, shader: Shader, colour: Colour) -> object:
    """Equal stripes along both axes, even about the cloth's centre: the same from all eight sides."""
    turns, width = 2 * np.pi * rng.uniform(2.5, 14), rng.uniform(-0.6, 0.6)
    stripes = []
    for axis in _rest_axes(shader):
        wave = shader.math("COSINE", shader.math("MULTIPLY", axis, turns))
        stripes.append(shader.math("GREATER_THAN", wave, width))
    factor = shader.math("MULTIPLY", shader.math("ADD", *stripes), 0.5)
    return shader.mix(factor, colour, draw_contrasting(rng, colour, distance=0.15, exempt=0.0))


def _hemmed(rng: np.random.Generator, shader: Shader, colour: Colour) -> object:
    """A band of another colour along all four edges."""
    x, y = (shader.math("ABSOLUTE", axis) for axis in _rest_axes(shader))
    out, width = rng.uniform(0.0, 0.08), rng.uniform(0.01, 0.06)
    rim = shader.math("SUBTRACT", 0.5 - out, shader.math("MAXIMUM", x, y))
    inside = shader.math("MULTIPLY", shader.math("GREATER_THAN", rim, 0.0), shader.math("LESS_THAN", rim, width))
    return shader.mix(inside, colour, draw_contrasting(rng, colour, distance=0.2, exempt=0.0))


Texture = Callable[[np.random.Generator, Shader, Colour], object]
OBJECT_TEXTURES: dict[str, Texture] = {"plain": lambda rng, shader, colour: colour, "mottled": _mottled}
CLOTH_TEXTURES: dict[str, Texture] = {**OBJECT_TEXTURES, "woven": _woven, "gingham": _gingham, "hemmed": _hemmed}


# On the floor. --------------------------------------------------------------------------------------------------------


def _ground_noise(rng: np.random.Generator, shader: Shader, colour: Colour, place: object) -> object:
    """Stone, carpet, concrete."""
    inputs = {"Vector": place, "Scale": log_uniform(rng, 2, 60), "Detail": 3.0}
    noise = shader.node("TexNoise", inputs).outputs[0]
    return shader.mix(_steeper(shader, noise), colour, vary_colour(rng, colour, 0.5))


def _ground_wood(rng: np.random.Generator, shader: Shader, colour: Colour, place: object) -> object:
    """Grain along one direction, cut into planks."""
    inputs = {"Vector": place, "Scale": rng.uniform(2, 10), "Distortion": rng.uniform(2, 8), "Detail Scale": 0.6}
    grain = shader.node("TexWave", inputs).outputs[1]
    wood = shader.mix(grain, colour, vary_colour(rng, colour, 0.35))
    planks = {"Vector": place, "Scale": rng.uniform(1, 3), "Color1": (1, 1, 1, 1), "Color2": (0.8, 0.8, 0.8, 1)}
    brick = shader.node("TexBrick", {**planks, "Mortar": (0.3, 0.3, 0.3, 1), "Mortar Size": 0.004, "Brick Width": 2.0})
    return shader.node("MixRGB", {0: 1.0, 1: wood, 2: brick.outputs[0]}, blend_type="MULTIPLY").outputs[0]


def _ground_tiles(rng: np.random.Generator, shader: Shader, colour: Colour, place: object) -> object:
    """Bricks or tiles with joints."""
    inputs = {"Vector": place, "Color1": colour, "Color2": vary_colour(rng, colour, 0.25), "Mortar": draw_colour(rng)}
    size = {"Scale": rng.uniform(1.5, 8), "Brick Width": rng.uniform(0.5, 1.5), "Row Height": 0.5}
    return shader.node("TexBrick", {**inputs, **size, "Mortar Size": rng.uniform(0.005, 0.03)}).outputs[0]


def _ground_checker(rng: np.random.Generator, shader: Shader, colour: Colour, place: object) -> object:
    inputs = {"Vector": place, "Color1": colour, "Color2": vary_colour(rng, colour, 0.7), "Scale": rng.uniform(3, 25)}
    return shader.node("TexChecker", inputs).outputs[0]


def _ground_terrazzo(rng: np.random.Generator, shader: Shader, colour: Colour, place: object) -> object:
    """Pebbles of many colours."""
    cells = shader.node("TexVoronoi", {"Vector": place, "Scale": rng.uniform(8, 60)}).outputs["Color"]
    return shader.mix(rng.uniform(0.1, 0.5), colour, cells)


def _ground_clutter(rng: np.random.Generator, shader: Shader, colour: Colour, place: object) -> object:
    """A picture of random shapes, about two metres wide."""
    pixels = np.asarray(draw_clutter(rng, colour))[::-1]
    vector = shader.node("Mapping", {"Vector": place, "Scale": [rng.uniform(0.3, 0.8)] * 3}).outputs[0]
    return shader.picture(pixels, vector, name="clutter")


def draw_clutter(rng: np.random.Generator, colour: Colour) -> Image.Image:
    """Polygons, discs and lines of random colours on ``colour``: an image of 512 × 512 px."""
    image = Image.new("RGB", (CLUTTER_PX, CLUTTER_PX), to_srgb(colour))
    pen = ImageDraw.Draw(image)
    for _ in range(rng.integers(15, 90)):
        centre, fill = rng.uniform(0, CLUTTER_PX, size=2), to_srgb(draw_colour(rng))
        reach = log_uniform(rng, 6, 110)
        corners = [tuple(point) for point in centre + rng.uniform(-reach, reach, size=(rng.integers(3, 7), 2))]
        shape = rng.choice(["polygon", "disc", "line"])
        if shape == "polygon":
            pen.polygon(corners, fill=fill)
        elif shape == "disc":
            pen.ellipse([*(centre - reach / 2), *(centre + reach / 2)], fill=fill)
        else:
            pen.line(corners, fill=fill, width=int(rng.integers(1, 9)))
    return image


Ground = Callable[[np.random.Generator, Shader, Colour, object], object]
BACKGROUNDS: dict[str, Ground] = {
    "plain": lambda rng, shader, colour, place: colour, "noise": _ground_noise, "wood": _ground_wood,
    "tiles": _ground_tiles, "checker": _ground_checker, "terrazzo": _ground_terrazzo, "clutter": _ground_clutter,
}  # fmt: skip
