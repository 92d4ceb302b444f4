"""Simple solids as vertices and faces: what distractors and surfaces are put together from. Metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mmgsd.scene.geometry import grid_faces, spin


@dataclass(frozen=True)
class Solid:
    """A closed surface; ``smooth`` ones are shaded as round."""

    vertices: np.ndarray  # (V, 3) m
    faces: np.ndarray  # (F, 4)
    smooth: bool = False


def make_box(size: np.ndarray | tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0)) -> Solid:
    """A box of the given size (3,) about a centre (3,)."""
    square = ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
    corners = np.array([[x, y, z] for z in (-0.5, 0.5) for x, y in square])
    faces = np.array([[3, 2, 1, 0], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
    return Solid(corners * size + centre, faces)


def make_lathe(profile: np.ndarray) -> Solid:
    """A surface of revolution about z of a profile (R, 2) of radius and height, from the bottom outside to the top."""
    angle = 2 * np.pi * np.arange(28) / 28
    radius, height = np.asarray(profile, float).T[..., None]  # (R, 1) each
    rings = np.stack([radius * np.cos(angle), radius * np.sin(angle), height + 0 * angle], axis=-1)  # (R, 28, 3)
    return Solid(rings.reshape(-1, 3), grid_faces(len(rings), 28, closed=True))


def make_tube(path: np.ndarray, radius: np.ndarray | float, *, sides: int = 10) -> Solid:
    """A round tube along a path (R, 3), of one radius or one a point (R,), closed at both ends."""
    path = np.asarray(path, float)
    radius = np.broadcast_to(np.asarray(radius, float), len(path)).copy()
    path = np.concatenate([path[:1], path, path[-1:]])
    radius = np.concatenate([[1e-5], radius, [1e-5]])
    tangent = np.gradient(path, axis=0)
    tangent[[0, -1]] = tangent[[1, -2]]
    steep = np.abs(tangent[:, 2]).max() > 0.9 * np.linalg.norm(tangent, axis=1).max()
    aside = np.array([0.31, 0.95, 0.05] if steep else [0.0, 0.0, 1.0])
    first = np.cross(aside, tangent)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(tangent, first)
    second /= np.maximum(np.linalg.norm(second, axis=1, keepdims=True), 1e-12)
    angle = 2 * np.pi * np.arange(sides)[None, :, None] / sides
    rings = path[:, None] + radius[:, None, None] * (np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None])
    return Solid(rings.reshape(-1, 3), grid_faces(len(path), sides, closed=True), True)


def make_capsule(start: np.ndarray, end: np.ndarray, radius: float, tip: float | None = None) -> Solid:
    """A rod with round ends between two points (3,), ``tip`` wide at its end where that differs."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    tip, axis = radius if tip is None else tip, (end - start) / np.linalg.norm(end - start)
    angles = np.linspace(0, np.pi / 2, 5)
    head = start - np.outer(radius * np.cos(angles), axis)
    tail = end + np.outer(tip * np.sin(angles), axis)
    radii = np.concatenate([radius * np.sin(angles), tip * np.cos(angles)]) + 1e-5
    return make_tube(np.concatenate([head, tail]), radii)


def make_walls(outline: np.ndarray, bottom: float, top: float) -> Solid:
    """The walls of a tray: a box along each edge of a polygon (N, 2), 12 mm thick."""
    parts = []
    for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        edge = end - start
        box = make_box((np.linalg.norm(edge) + 0.012, 0.012, top - bottom))
        parts.append(move(box, np.arctan2(edge[1], edge[0]), (*(start + end) / 2, (bottom + top) / 2)))
    return merge(parts)


def make_textile(width: float, length: float, ripple: np.ndarray) -> Solid:
    """A rectangle of cloth with waves of heights given at a grid (n, n) of its own, smoothly in between."""
    v, u = np.mgrid[0:1:25j, 0:1:25j]
    knots = np.linspace(0, 1, len(ripple))
    rows = np.stack([np.interp(u[0], knots, line) for line in ripple])  # (n, 25)
    height = np.stack([np.interp(v[:, 0], knots, column) for column in rows.T], axis=1)
    vertices = np.stack([(u - 0.5) * width, (v - 0.5) * length, height], axis=-1).reshape(-1, 3)
    return Solid(vertices, grid_faces(25, 25), True)


def merge(parts: list[Solid]) -> Solid:
    """One solid of several."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
    return Solid(np.concatenate([part.vertices for part in parts]), faces, parts[0].smooth)


def move(solid: Solid, turn: float, place: tuple[float, float, float], *, lean: float = 0.0) -> Solid:
    """A solid that leans (rad) from z towards x, turned (rad) about z, then shifted to a place (3,) m."""
    tilt = np.array([[np.cos(lean), 0, np.sin(lean)], [0, 1, 0], [-np.sin(lean), 0, np.cos(lean)]])
    return Solid(solid.vertices @ (spin(turn) @ tilt).T + place, solid.faces, solid.smooth)
