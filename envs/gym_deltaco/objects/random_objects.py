"""Random objects: any number of solids of the ten shapes and eight colors.

An object depends only on its index. Its shape selects a family of profiles, from which its form is drawn. Its
color selects a range of paints, with bands, stripes or spots of other shades or of a second color. No random
object has both the shape and the color of a test object of scenario A. Lengths are in millimeters.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from types import MappingProxyType

import numpy as np

from gym_deltaco.objects.labels import RANDOM_SEED, random_label
from gym_deltaco.objects.objects import ObjectModel, ObjectRecipe, build_model
from gym_deltaco.objects.random_forms import FAMILIES, Form, ring_height
from gym_deltaco.objects.solids import Color, Loft, Paint, Row
from gym_deltaco.sim.workspace import CAMERA

_PALM_DISTANCE = 35.0  # largest distance of an object's top above its grasp height
_MIN_GRASP = 10.0  # lowest grasp height
_MAX_FACES = 250
_MAX_EXTRA_FACES = 64  # a handle has the most
_MAX_PART_POINTS = 24


@cache
def random_model(index: int) -> ObjectModel:
    """Returns the model of a random object; it is built on first use.

    Args:
        index: Index of the object, at least `FIRST_RANDOM_INDEX`.
    """
    label = random_label(index)
    rng = np.random.default_rng((RANDOM_SEED, 0, label.index))
    form = FAMILIES[label.shape](rng)
    return build_model(label, _recipe(form, label.color, rng))


def _width(row: Row) -> float:
    radius = row[0]
    return float(radius[0]) if isinstance(radius, tuple) else float(radius)


def _recipe(form: Form, color: str, rng: np.random.Generator) -> ObjectRecipe:
    grasp = form.height - rng.uniform(16, 30)
    grasp = float(np.clip(grasp, max(_MIN_GRASP, form.band[0] + 4), max(_MIN_GRASP, form.band[1] - 5)))
    solids, parts = _painted(form, color, rng), _parts(form)
    for _, extra_parts in form.extras:
        parts += extra_parts
    return ObjectRecipe(solids, parts, max(grasp, form.height - _PALM_DISTANCE), form.yaw)


# Collision parts


def _parts(form: Form) -> list[Loft]:
    """Cuts a form into convex parts at its waists."""
    max_rows = _MAX_PART_POINTS // len(form.part_outline)
    parts = []
    for piece in _cut_at_waists(form.outside):
        rows = _convex(piece)
        while len(rows) > max_rows:
            parts.append(rows[:max_rows])
            rows = rows[max_rows - 1 :]
        parts.append(rows)
    return [Loft(form.part_outline, rows) for rows in parts]


def _cut_at_waists(rows: Sequence[Row]) -> list[Sequence[Row]]:
    """Cuts a profile at the rings that are narrower than their neighbors below and above."""
    cuts = [0]
    for number in range(1, len(rows) - 1):
        before, here, after = (_width(row) for row in rows[number - 1 : number + 2])
        if here <= before and here <= after and max(before, after) > here:
            cuts.append(number)
    cuts.append(len(rows) - 1)
    return [rows[first : last + 1] for first, last in pairwise(cuts)]


def _convex(rows: Sequence[Row]) -> list[Row]:
    """Removes rings that lie within the convex hull of their neighbors."""
    convex: list[Row] = []
    for row in rows:
        while len(convex) > 1 and not _stands_out(convex[-2], convex[-1], row):
            convex.pop()
        convex.append(row)
    return convex


def _stands_out(below: Row, row: Row, above: Row) -> bool:
    fraction = (ring_height(row) - ring_height(below)) / (ring_height(above) - ring_height(below))
    return _width(row) > _width(below) + fraction * (_width(above) - _width(below)) + 0.1


# Paint: lowest and highest hue (degrees), saturation and value of each color
_HSV = MappingProxyType(
    {
        "brown": ((14, 34), (0.45, 0.8), (0.38, 0.72)),
        "blue": ((200, 238), (0.55, 1.0), (0.5, 1.0)),
        "gray": ((0, 360), (0.0, 0.07), (0.36, 0.66)),
        "white": ((0, 360), (0.0, 0.02), (0.95, 1.0)),
        "red": ((-3, 8), (0.9, 1.0), (0.7, 1.0)),
        "orange": ((24, 34), (0.9, 1.0), (0.9, 1.0)),
        "yellow": ((47, 56), (0.9, 1.0), (0.85, 1.0)),
    }
)
_ELEVATION = np.radians(-CAMERA.pitch)  # rad, of the camera, which stands in the direction of y
_TOWARDS_CAMERA = np.array([0.0, np.cos(_ELEVATION), np.sin(_ELEVATION)])
_BLACK, _WHITE = (1 / 15, 1 / 15, 1 / 15), (1.0, 1.0, 1.0)


def _painted(form: Form, color: str, rng: np.random.Generator) -> list[Loft]:
    """Returns the solids of a form, with paint that shows the color."""
    main, shade, dark = _palette(color, rng)
    others = [name for name in _HSV if name != color]
    accent = _palette(others[int(rng.integers(len(others)))], rng)[0] if rng.random() < 0.5 else shade
    if color == "black and white":
        textures = [*rng.permutation(["bands", "stripes", "spots"]).tolist(), "halves"]
    else:
        textures = [str(rng.permutation(["plain", "bands", "stripes", "spots", "label", "lid"])[0]), "plain"]
    for texture in textures:
        body = _body(form, texture, main, shade, accent, dark)
        if _shows(body, main, shade, dark):
            break
    return [body, *(make(shade) for make, _ in form.extras)]


def _body(form: Form, texture: str, main: Color, shade: Color, accent: Color, dark: Color) -> Loft:
    """Returns the main solid of a form, with a texture."""
    is_patterned = texture in ("bands", "stripes", "spots", "label")
    n_faces = _MAX_FACES - _MAX_EXTRA_FACES * len(form.extras)
    n_rings = n_faces // (2 * len(form.outline)) - len(form.inside) - (0 if form.is_ring else 1)
    outside = _refined(form.outside, n_rings if is_patterned else len(form.outside))
    rows: list[Row] = [
        (row[0], row[1], _paint_of(texture, number, len(outside), main, shade, accent))
        for number, row in enumerate(outside)
    ]
    rows += [(row[0], row[1], dark if number else shade) for number, row in enumerate(form.inside)]
    return Loft(form.outline, rows, closed=form.is_ring, crease=60 if form.is_ring else 40)


def _shows(body: Loft, main: Color, shade: Color, dark: Color) -> bool:
    """Returns whether the camera sees enough of a solid's color; of black and white, enough of each."""
    mesh = body.mesh()
    corners = mesh.triangles
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.maximum(normals @ _TOWARDS_CAMERA, 0.0)
    areas[np.isclose(mesh.colors, dark).all(axis=1)] = 0.0
    of_main, of_shade = (
        float(areas[np.isclose(mesh.colors, paint).all(axis=1)].sum() / areas.sum())
        for paint in (main, shade)
    )
    if {main, shade} == {_BLACK, _WHITE}:
        return min(of_main, of_shade) > 0.25
    return of_main > 0.75 if main == shade else of_main + of_shade > 0.75


def _paint_of(texture: str, number: int, n_rows: int, main: Color, shade: Color, accent: Color) -> Paint:
    """Returns the paint of a ring; rings are counted from the bottom."""
    if texture == "bands":
        return main if number % 2 else shade
    if texture == "halves":
        return main if number < n_rows / 2 else shade
    if texture == "stripes":
        return (main, main, shade, shade) if shade == _WHITE else (main, shade)
    if texture == "spots":
        spots = (main, shade, main, main, shade)
        return spots[2 * number % 5 :] + spots[: 2 * number % 5]
    if texture == "label" and number == n_rows // 2:
        return (main, main, accent)
    if texture == "lid" and number == n_rows - 1:
        return accent
    return main


def _palette(color: str, rng: np.random.Generator) -> tuple[Color, Color, Color]:
    """Draws a color, a shade of it, and a darker one for the inside."""
    if color == "black and white":
        return _BLACK, _WHITE, (0.4, 0.4, 0.4)
    (hue, saturation, value) = (float(rng.uniform(*limits)) for limits in _HSV[color])
    darker = rng.uniform(0.78, 0.9)
    main, shade, dark = (
        _snapped(colorsys.hsv_to_rgb(hue % 360 / 360, saturation, value * brightness))
        for brightness in (1.0, darker, 0.68)
    )
    return main, shade, dark


def _snapped(rgb: Sequence[float]) -> Color:
    """Returns the nearest color that the simulation renders: it has 16 levels of each channel."""
    red, green, blue = (round(15 * channel) / 15 for channel in rgb)
    return red, green, blue


def _refined(rows: Sequence[Row], n_rows: int) -> list[Row]:
    """Adds rings to a profile where they are farthest apart, until it has `n_rows`."""
    refined = list(rows)
    while len(refined) < n_rows:
        gaps = [ring_height(above) - ring_height(below) for below, above in pairwise(refined)]
        number = int(np.argmax(gaps))
        if gaps[number] < 7:
            break
        below, above = refined[number : number + 2]
        middle = (np.array(_as_ring(below)) + np.array(_as_ring(above))) / 2
        x, y, *center = middle.round(2).tolist()
        refined.insert(number + 1, ((x, y), tuple(center)))
    return refined


def _as_ring(row: Row) -> tuple[float, ...]:
    radius, center = row[:2]
    return (
        *(radius if isinstance(radius, tuple) else (radius, radius)),
        *(center if isinstance(center, tuple) else (0.0, 0.0, center)),
    )
