"""Random objects: any number of solids of the ten shapes and eight colors.

An object is a function of its index. Its shape selects a family of profiles, from which its form is drawn.
Its color selects a range of paints, with bands, stripes or spots of other shades or of a second color. No
random object has both the shape and the color of a test object of scenario A. Forms follow the rules of
`gym_deltaco.objects`: objects are at most 46 mm wide between the fingers, with vertical sides at the grasp
height. Lengths in this module are in millimeters.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from types import MappingProxyType

import numpy as np

from gym_deltaco.objects import ObjectModel, Recipe, build_model
from gym_deltaco.solids import (
    CIRCLE,
    HALVED_SQUARE,
    OCTAGON,
    ROUNDED,
    SQUARE,
    Color,
    Loft,
    Paint,
    Row,
    pointed_oval,
    polygon,
)
from gym_deltaco.tasks import COLOR_SHAPE_PAIRS, OBJECTS, ObjectLabel
from gym_deltaco.workspace import CAMERA

FIRST_INDEX = len(OBJECTS)
_SEED = 2210_04476  # seed of all random objects

_MAX_RADIUS = 23.0  # half the width between the fingers
_PALM_DISTANCE = 35.0  # largest distance of an object's top above its grasp height
_MIN_GRASP = 10.0  # lowest grasp height
_MIN_FOOT = 0.35  # smallest radius of a foot, relative to the height
_MAX_FACES = 250
_MAX_EXTRA_FACES = 64  # a handle has the most
_MAX_PART_POINTS = 24


@cache
def random_label(index: int) -> ObjectLabel:
    """Returns the label of a random object; no instruction uses its name.

    Successive indices run through all of `COLOR_SHAPE_PAIRS`, again and again, each time in a new order.

    Args:
        index: At least `FIRST_INDEX`.

    Raises:
        ValueError: The index is too small, or not an integer.
    """
    if not isinstance(index, (int, np.integer)) or index < FIRST_INDEX:
        raise ValueError(
            f"A random object's index must be an integer of at least {FIRST_INDEX}. Got {index!r}."
        )
    turn, position = divmod(int(index) - FIRST_INDEX, len(COLOR_SHAPE_PAIRS))
    order = np.random.default_rng((_SEED, turn)).permutation(len(COLOR_SHAPE_PAIRS))
    color, shape = COLOR_SHAPE_PAIRS[order[position]]
    return ObjectLabel(int(index), f"object {index}", shape, color)


@cache
def random_model(index: int) -> ObjectModel:
    """Returns the model of a random object; it is built on first use.

    Args:
        index: At least `FIRST_INDEX`.

    Raises:
        ValueError: The index is too small, or not an integer.
    """
    label = random_label(index)
    rng = np.random.default_rng((_SEED, 0, label.index))
    form = _FAMILIES[label.shape](rng)
    return build_model(label, _recipe(form, label.color, rng))


@dataclass(frozen=True, eq=False)
class _Form:
    """Form of an object, without its colors. Radii and centers are those of `Loft`.

    Attributes:
        outline: Outline of the visible solid.
        part_outline: Outline of the collision parts, with fewer corners.
        outside: Rings of the outside, from the bottom to the top.
        band: Lowest and highest height of the vertical, widest sides, within which the object may be held.
        inside: Rings of the inside of a hollow object, from the top down.
        is_ring: Whether the hole goes through the bottom.
        yaw: Largest rotation about z to either side, rad.
        extras: Further solids, as functions of their paint, with their collision parts.
    """

    outline: np.ndarray
    part_outline: np.ndarray
    outside: Sequence[Row]
    band: tuple[float, float]
    inside: Sequence[Row] = ()
    is_ring: bool = False
    yaw: float = np.pi
    extras: Sequence[tuple[Callable[[Paint], Loft], Sequence[Loft]]] = ()

    @property
    def height(self) -> float:
        """Height of the highest ring."""
        return max(_height(row) for row in self.outside)


def _height(row: Row) -> float:
    center = row[1]
    return float(center[2]) if isinstance(center, tuple) else float(center)


def _width(row: Row) -> float:
    radius = row[0]
    return float(radius[0]) if isinstance(radius, tuple) else float(radius)


def _recipe(form: _Form, color: str, rng: np.random.Generator) -> Recipe:
    grasp = form.height - rng.uniform(16, 30)
    grasp = float(np.clip(grasp, max(_MIN_GRASP, form.band[0] + 4), max(_MIN_GRASP, form.band[1] - 5)))
    solids, parts = _painted(form, color, rng), _parts(form)
    for _, extra_parts in form.extras:
        parts += extra_parts
    return Recipe(solids, parts, max(grasp, form.height - _PALM_DISTANCE), form.yaw)


# Collision parts


def _parts(form: _Form) -> list[Loft]:
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
    """Removes the rings that lie within the convex hull of their neighbors."""
    kept: list[Row] = []
    for row in rows:
        while len(kept) > 1 and not _stands_out(kept[-2], kept[-1], row):
            kept.pop()
        kept.append(row)
    return kept


def _stands_out(below: Row, row: Row, above: Row) -> bool:
    fraction = (_height(row) - _height(below)) / (_height(above) - _height(below))
    return _width(row) > _width(below) + fraction * (_width(above) - _width(below)) + 0.1


# Forms: each function draws one of its shape

_HEXAGON = polygon(6)


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return round(float(rng.uniform(low, high)), 1)


def _pick[T](rng: np.random.Generator, options: Sequence[T]) -> T:
    return options[int(rng.integers(len(options)))]


def _round_outlines(rng: np.random.Generator, is_tall: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Draws a round outline, and that of its parts; no hexagon if it is tall, since it would fall over."""
    fluted = polygon(16, (1.0, 0.92))
    outlines = [(CIRCLE, OCTAGON), (CIRCLE, OCTAGON), (OCTAGON, OCTAGON), (fluted, OCTAGON)]
    return _pick(rng, outlines if is_tall else [*outlines, (_HEXAGON, _HEXAGON)])


def _foot(radius: float, height: float) -> float:
    """Returns a radius that is large enough for an object to stay upright when it is dropped."""
    return round(max(radius, _MIN_FOOT * height), 1)


def _vase(rng: np.random.Generator) -> _Form:
    outlines = _round_outlines(rng, is_tall=True)
    foot, belly = _between(rng, 14, 18), _between(rng, 19, _MAX_RADIUS)
    variant = _pick(rng, ("necked", "necked", "tall", "flared", "dome"))
    if variant == "tall":
        height = _between(rng, 48, 66)
        foot = _foot(foot, height)
        waist = round(height * 0.45, 1)
        outside = [(foot, 0), (belly - 1.5, waist), (belly, height - 18), (belly, height)]
        return _Form(*outlines, outside, (height - 18, height), [(belly - 3.5, height), (foot - 4, 20)])
    if variant == "flared":
        height, neck = _between(rng, 42, 58), _between(rng, 13, 16)
        foot = _foot(foot, height)
        outside = [(foot, 0), (foot + 1.5, 10), (neck, height - 14), (belly, height - 10), (belly, height)]
        return _Form(*outlines, outside, (height - 10, height), [(neck - 3, height), (neck - 5, height - 20)])
    height = _between(rng, 42, 64)
    foot = _foot(foot, height)
    middle = max(_between(rng, 0.3, 0.5) * height, height - 32)
    low, high = round(middle - 6, 1), round(middle + 6, 1)
    if variant == "dome":
        top = _between(rng, 7, 10)
        outside = [
            (foot + 2, 0),
            (belly, low),
            (belly, high),
            (0.5 * (belly + top) + 2, high + 9),
            (top, height),
        ]
        return _Form(*outlines, outside, (low, high), [(top - 3, height), (top - 4, height - 7)])
    neck = _between(rng, 7, 11)
    lip = _between(rng, neck + 1.5, 15)
    outside = [
        (foot, 0),
        (belly, low),
        (belly, high),
        (neck, round(height - (height - high) * 0.4, 1)),
        (lip, height),
    ]
    return _Form(*outlines, outside, (low, high), [(lip - 3, height), (neck - 3, height - 9)])


def _chalice(rng: np.random.Generator) -> _Form:
    outlines = _round_outlines(rng)
    foot, top = _between(rng, 17, _MAX_RADIUS), _between(rng, 20, _MAX_RADIUS)
    height, stem = _between(rng, 38, 58), _between(rng, 5, 14)
    base, rim = _between(rng, 3, 8), _between(rng, 9, 15)
    low, high = round(base + 0.2 * height, 1), round(height - rim - 0.15 * height, 1)
    outside = [
        (foot, 0),
        (foot, base),
        (stem, min(low, high - 1)),
        (stem, high),
        (top, height - rim),
        (top, height),
    ]
    inside = [(top - 3, height), (top * 0.4, height - rim)] if rng.random() < 0.6 else []
    return _Form(*outlines, outside, (height - rim, height), inside)


def _freeform(rng: np.random.Generator) -> _Form:
    if rng.random() < 0.6:  # irregular stack
        outline = polygon(10, rng.uniform(0.84, 1.0, 10).round(2).tolist())
        n_bulges, height = int(rng.integers(1, 4)), _between(rng, 38, 70)
        widest = _between(rng, 19, 21.5)
        heights = np.linspace(0, height - 12, 2 * n_bulges).round(1)
        outside: list[Row] = [(_foot(_between(rng, 17, 20), height), 0)]
        for number, z in enumerate(heights[1:], start=1):
            radius = _between(rng, 12.5, 15) if number % 2 else _between(rng, 17, 19)
            outside.append((radius, (_between(rng, -1.5, 1.5), _between(rng, -1.5, 1.5), float(z))))
        outside += [(widest, height - 10), (widest, height)]
        return _Form(outline, OCTAGON, outside, (height - 10, height))
    # Block that leans and narrows above its seat
    depth, seat = _between(rng, 14, 24), _between(rng, 20, 26)
    height = _between(rng, seat + 12, min(seat + 24, 52))
    lean = _between(rng, 6, 11) * _pick(rng, (-1, 1))
    slim = _between(rng, 6, 10)
    outside = [
        ((20, depth), 0),
        ((20, depth), seat),
        ((slim + 4, depth), (lean * 0.8, 0, seat + 4)),
        ((slim, depth * _between(rng, 0.6, 1.0)), (lean, 0, height)),
    ]
    return _Form(SQUARE, SQUARE, outside, (0, seat), yaw=0.25)


def _bottle(rng: np.random.Generator) -> _Form:
    outlines = _round_outlines(rng, is_tall=True)
    height, body = _between(rng, 54, 71), _between(rng, 19.5, 21.5)
    neck = _between(rng, 7, 10)
    shoulder = round(max(_between(rng, 0.45, 0.6) * height, height - 28), 1)
    slope = _between(rng, 6, 14)
    if rng.random() < 0.4:  # with a waist
        outside: list[Row] = [
            (body, 0),
            (body, shoulder * 0.35),
            (body - 3, shoulder * 0.5),
            (body, shoulder - 14),
        ]
    else:
        outside = [(body - 1, 0), (body, 4)]
    outside += [(body, shoulder), (neck, min(shoulder + slope, height - 8)), (neck, height)]
    return _Form(*outlines, outside, (shoulder - 12, shoulder))


def _canoe(rng: np.random.Generator) -> _Form:
    lift = _between(rng, 1, 6)
    half_width, half_length = _between(rng, 15, 21.5), _between(rng, 34, 42)
    height = _between(rng, 17, 21)
    floor = _between(rng, 5, 8)
    low, high = (half_width, half_length * 0.95), (half_width, half_length)
    keel = (half_width * _between(rng, 0.7, 0.85), half_length * _between(rng, 0.7, 0.85))
    extras = []
    for y in np.linspace(-0.5, 0.5, int(rng.integers(0, 4))) * half_length:
        seat, xy = (half_width * 0.8, 3.0), (0.0, float(y))
        extras.append((lambda paint, seat=seat, xy=xy: _bench(seat, xy, height, paint), ()))
    return _Form(
        pointed_oval(16, lift),
        pointed_oval(8, lift),
        [(keel, 0), (low, 9), (high, height)],
        (9, height),
        [((half_width - 3, half_length - 4), height), ((keel[0] - 2, keel[1] - 2), floor)],
        yaw=0.3,
        extras=extras,
    )


def _bench(half: tuple[float, float], xy: tuple[float, float], top: float, paint: Paint) -> Loft:
    return Loft(SQUARE, [(half, (*xy, top - 4), paint), (half, (*xy, top - 1))])


def _cup(rng: np.random.Generator) -> _Form:
    outlines = _round_outlines(rng, is_tall=True)
    top, height = _between(rng, 19, _MAX_RADIUS), _between(rng, 34, 62)
    foot = _foot(max(_between(rng, 0.68, 0.98) * top, 14), height)
    variant = _pick(rng, ("plain", "plain", "handle", "lid"))
    if variant == "handle":
        top, height = min(top, 20.5), min(height, 48.0)
        foot = min(max(foot, 0.42 * height), top)  # its handle would pull it over
    outside = [(foot, 0), (top, height - 12), (top, height)]
    band = (height - 12, height)
    inside = [(top - 3, height), (foot - 3, 6)]
    if variant == "lid":
        outside[-1:] = [(top, height - 2), (top - 3, height + 3)]
        return _Form(*outlines, outside, (height - 12, height - 2))
    if variant == "plain":
        return _Form(*outlines, outside, band, inside)
    middle, turn = height / 2, 35.0
    offset = (top - 2) * np.array([-np.sin(np.radians(turn)), np.cos(np.radians(turn))])

    def handle(paint: Paint) -> Loft:
        profile: list[Row] = [(12, -3, paint), (12, 3), (8, 3), (8, -3)]
        return Loft(
            OCTAGON,
            profile,
            closed=True,
            tilt=90,
            turn=turn,
            offset=(float(offset[0]), float(offset[1]), middle),
        )

    part = Loft(SQUARE, [((3, 6), (0, top + 4, middle - 10)), ((3, 6), (0, top + 4, middle + 10))], turn=turn)
    return _Form(CIRCLE, OCTAGON, outside, band, inside, yaw=0.25, extras=[(handle, [part])])


def _bowl(rng: np.random.Generator) -> _Form:
    variant = _pick(rng, ("shallow", "deep", "oblong", "footed"))
    if variant == "oblong":
        x, y, height = _between(rng, 18, 22.5), _between(rng, 27, 42), _between(rng, 20, 38)
        foot = _between(rng, 0.65, 0.85)
        outside: list[Row] = [((x * foot, y * foot), 0), ((x, y), height - 12), ((x, y), height)]
        inside: list[Row] = [((x - 4, y - 5), height), ((x * 0.5, y * 0.6), 8)]
        yaw = 0.2 if y > 33 else 0.3
        return _Form(ROUNDED, ROUNDED, outside, (height - 12, height), inside, yaw=yaw)
    outlines = _round_outlines(rng)
    top = _between(rng, 21, _MAX_RADIUS)
    if variant == "shallow":
        height = _between(rng, 19, 28)
        outside = [(top - _between(rng, 1, 5), 0), (top, 6), (top, height)]
        return _Form(*outlines, outside, (6, height), [(top - 3, height), (top - 5, 5)])
    height = _between(rng, 34, 50)
    foot = _between(rng, 14, 18)
    inside = [(top - 3, height), (foot - 4, height * 0.4)]
    if variant == "deep":
        outside = [(foot, 0), (top, height - 16), (top, height)]
        return _Form(*outlines, outside, (height - 16, height), inside)
    waist = _between(rng, 8, 12)
    outside = [(foot, 0), (waist, height * 0.3), (top, height - 14), (top, height)]
    return _Form(*outlines, outside, (height - 14, height), [(top - 3, height), (8, height * 0.5)])


def _trapezoidal_prism(rng: np.random.Generator) -> _Form:
    x, aspect = _between(rng, 16.5, 20.5), _pick(rng, (1.0, 1.25, 1.6, 2.05))
    y = round(min(x * aspect, 42.0), 1)
    height = _between(rng, 20, 30) if aspect > 1.5 else _between(rng, 30, 64)
    narrow = max(_between(rng, 0.7, 0.88), 12.2 / x)
    small = (round(x * narrow, 1), round(y * narrow, 1))
    yaw = 0.3 if aspect == 1.0 or x < 18 else 0.2
    if height < 40 and rng.random() < 0.35:  # wider at the bottom
        outside: list[Row] = [((x, y), 0), ((x, y), 15), (small, height)]
        return _Form(SQUARE, SQUARE, outside, (0, 15), yaw=yaw)
    outside = [(small, 0), ((x, y), height - 11), ((x, y), height)]
    inside: list[Row] = []
    if rng.random() < 0.7:
        inside = [((x - 3, y - 3), height), ((small[0] - 3, small[1] - 4), 7)]
    return _Form(HALVED_SQUARE, SQUARE, outside, (height - 11, height), inside, yaw=yaw)


def _cylinder(rng: np.random.Generator) -> _Form:
    outline, part_outline = _pick(
        rng,
        [
            (CIRCLE, OCTAGON),
            (CIRCLE, OCTAGON),
            (OCTAGON, OCTAGON),
            (polygon(20, (1.0, 0.92)), OCTAGON),
        ],
    )
    radius, height = _between(rng, 17, 22), _between(rng, 32, 62)
    outside: list[Row] = [(radius, 0), (radius, height)]
    inside: list[Row] = []
    top = _pick(rng, ("flat", "hollow", "rounded", "knob"))
    if top == "hollow":
        inside = [(radius - 3, height), (radius - 3, 6)]
    elif top == "rounded":
        outside += [(radius - 4, height + 4)]
    elif top == "knob":
        outside += [(radius * 0.4, height + 3), (radius * 0.4, height + 8)]
    return _Form(outline, part_outline, outside, (0, height), inside)


def _round_hole(rng: np.random.Generator) -> _Form:
    sides = int(_pick(rng, (8, 12, 16)))
    outline = polygon(sides, (1.0, 0.92) if sides == 16 and rng.random() < 0.6 else (1.0,))
    if rng.random() < 0.4:  # tube, or lampshade
        radius, wall = _between(rng, 18, 21), _between(rng, 4, 8)
        height = _between(rng, 24, 44)
        top = radius if rng.random() < 0.5 else _between(rng, 0.6, 0.85) * radius
        outside: list[Row] = [(radius, 0), (radius, 16), (top, height)]
        inside: list[Row] = [(top - wall, height), (radius - wall - 2, 0)]
        band = (0.0, height if top == radius else 16.0)
        return _Form(outline, OCTAGON, outside, band, inside, is_ring=True)
    x, height = _between(rng, 20, 22), _between(rng, 18.5, 24)
    y = x if rng.random() < 0.5 else _between(rng, x + 3, 36)
    hole = _between(rng, 0.4, 0.58)
    side, crown = round(height * 0.6, 1), 4.0
    outside = [((x, y), 0), ((x, y), max(side, 12.0)), ((x - crown, y - crown), height)]
    inside = [
        ((x * hole + crown, y * hole + crown), height),
        ((x * hole, y * hole), max(side, 12.0)),
        ((x * hole, y * hole), 0),
    ]
    return _Form(
        outline, OCTAGON, outside, (0, max(side, 12.0)), inside, is_ring=True, yaw=np.pi if x == y else 0.3
    )


_FAMILIES: Mapping[str, Callable[[np.random.Generator], _Form]] = MappingProxyType(
    {
        "vase": _vase,
        "chalice": _chalice,
        "freeform": _freeform,
        "bottle": _bottle,
        "canoe": _canoe,
        "cup": _cup,
        "bowl": _bowl,
        "trapezoidal prism": _trapezoidal_prism,
        "cylinder": _cylinder,
        "round hole": _round_hole,
    }
)

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


def _painted(form: _Form, color: str, rng: np.random.Generator) -> list[Loft]:
    """Returns the solids of a form, with paint that shows the color."""
    main, shade, dark = _palette(color, rng)
    others = [name for name in _HSV if name != color]
    accent = _palette(_pick(rng, others), rng)[0] if rng.random() < 0.5 else shade
    if color == "black and white":
        textures = [*rng.permutation(["bands", "stripes", "spots"]).tolist(), "halves"]
    else:
        textures = [str(rng.permutation(["plain", "bands", "stripes", "spots", "label", "lid"])[0]), "plain"]
    for texture in textures:
        body = _body(form, texture, main, shade, accent, dark)
        if _shows(body, main, shade, dark):
            break
    return [body, *(make(shade) for make, _ in form.extras)]


def _body(form: _Form, texture: str, main: Color, shade: Color, accent: Color, dark: Color) -> Loft:
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
    """Returns the nearest color of those that the simulation renders: 16 levels of each channel."""
    red, green, blue = (round(15 * channel) / 15 for channel in rgb)
    return red, green, blue


def _refined(rows: Sequence[Row], n_rows: int) -> list[Row]:
    """Adds rings to a profile where they are farthest apart, up to a number of rings."""
    refined = list(rows)
    while len(refined) < n_rows:
        gaps = [_height(above) - _height(below) for below, above in pairwise(refined)]
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
