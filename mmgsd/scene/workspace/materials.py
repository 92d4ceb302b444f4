"""Materials of a workspace: of the object, and of what lies around it; all are removed once the view is rendered."""

from __future__ import annotations

import bpy
import numpy as np

from mmgsd.scene.geometry import choose, log_uniform
from mmgsd.scene.textures import printed
from mmgsd.scene.textures.colours import RGB, draw_other_rgb, draw_rgb, to_linear
from mmgsd.scene.textures.procedural import BACKGROUNDS, Shader, draw_gloss

PREFIX = "view "  # of the names of what belongs to one view
PROCEDURAL = {"wood": 0.4, "noise": 0.25, "tiles": 0.15, "checker": 0.08, "terrazzo": 0.12}


def remove_view() -> None:
    """Forget the things and materials of the last view; its pictures stay, see `Shader.picture`."""
    kinds = (bpy.data.objects, bpy.data.meshes, bpy.data.materials)
    bpy.data.batch_remove([block for kind in kinds for block in kind if block.name.startswith(PREFIX)])


def _new_shader() -> Shader:
    return Shader(bpy.data.materials.new(f"{PREFIX}material"))


def paint_surface(rng: np.random.Generator, colour: RGB, *, fitted: bool) -> tuple[bpy.types.Material, str]:
    """A material of what lies around, ``fitted`` to its own extent or laid over the plane; the name of its texture."""
    shader = _new_shader()
    kind = str(rng.choice(["plain", "procedural", "picture"], p=[0.4, 0.25, 0.35] if fitted else [0.3, 0.45, 0.25]))
    if kind == "picture":
        name = str(rng.choice(list(printed.PICTURES), p=[0.3, 0.12, 0.1, 0.12, 0.08, 0.08, 0.2]))
        pixels = printed.PICTURES[name](rng, colour)
        place = shader.node("TexCoord").outputs["Generated" if fitted else "Object"]
        scale = 1.0 if fitted else log_uniform(rng, 0.25, 2.0)
        surface = shader.picture(pixels, _map(rng, shader, place, scale, turned=not fitted))
    else:
        name = "plain" if kind == "plain" else choose(rng, PROCEDURAL)
        place = _map(rng, shader, shader.node("TexCoord").outputs["Object"], 1.0, turned=True)
        surface = BACKGROUNDS[name](rng, shader, to_linear(colour), place)
    shader.finish(surface, rng.uniform(0.4, 1.0), draw_gloss(rng, 0.3, 0.1), False)
    return shader.material, name


def paint_plain(rng: np.random.Generator, colour: RGB) -> bpy.types.Material:
    """A material of one colour, shining on some things."""
    shader = _new_shader()
    shader.finish(to_linear(colour), rng.uniform(0.2, 1.0), draw_gloss(rng, 0.4, 0.1), False)
    return shader.material


def _map(rng: np.random.Generator, shader: Shader, place: object, scale: float, *, turned: bool) -> object:
    inputs = {"Vector": place, "Scale": [scale] * 3}
    if turned:
        inputs |= {"Location": rng.uniform(-9, 9, 3), "Rotation": (0, 0, rng.uniform(0, 2 * np.pi))}
    return shader.node("Mapping", inputs).outputs[0]


def paint_object(rng: np.random.Generator, mesh: bpy.types.Object) -> tuple[RGB, str]:
    """Fill every material slot of the object anew; its mean colour, and the name of the main slot's pattern."""
    colour = draw_rgb(rng)
    mean, names = colour, []
    for i, slot in enumerate(mesh.material_slots):
        own = colour if i == 0 else draw_other_rgb(rng, colour, distance=40)
        slot.material = slot.material or bpy.data.materials.new(f"object {i}")
        shader = Shader(slot.material)
        if "along" in mesh.data.attributes:
            pixels, name = printed.paint_rope(rng, own)
            place = shader.node("Attribute", attribute_name="along").outputs["Vector"]
            surface, normal = shader.picture(pixels, place, repeat=False), None
        else:
            pixels, name = printed.paint_cloth(rng, own)
            surface, normal = _lay_cloth(rng, shader, pixels)
        if i == 0:
            mean = tuple(int(c) for c in pixels.mean(axis=(0, 1)))
        names.append(name)
        shader.finish(surface, rng.uniform(0.4, 1.0), draw_gloss(rng, 0.25, 0.1), True, normal)
    return mean, names[0]


def _lay_cloth(rng: np.random.Generator, shader: Shader, pixels: np.ndarray) -> tuple[object, object]:
    """The colour of both faces, and the normal of a pile or a weave, None for a smooth cloth."""
    place = shader.node("Attribute", attribute_name="face").outputs["Vector"]
    front = shader.picture(pixels, place, repeat=False)
    side = shader.node("NewGeometry").outputs["Backfacing"]
    kind = rng.random()
    if kind < 0.3:  # another face
        front = shader.mix(side, front, to_linear(draw_rgb(rng)))
    elif kind < 0.5:  # a print that hardly comes through
        white = (*[float(rng.uniform(0.4, 0.9))] * 3, 1.0)
        front = shader.mix(shader.math("MULTIPLY", side, rng.uniform(0.3, 0.8)), front, white)
    if rng.random() < 0.5:
        return front, None
    scale = log_uniform(rng, 40, 220)
    noise = shader.node("TexNoise", {"Vector": place, "Scale": scale, "Detail": 1.0}).outputs[0]
    relief = {"Height": noise, "Strength": rng.uniform(0.3, 1.0), "Distance": rng.uniform(0.3, 1.2) / scale}
    return front, shader.node("Bump", relief).outputs[0]
