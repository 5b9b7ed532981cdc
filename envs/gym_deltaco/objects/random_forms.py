"""Forms of random objects: a family of profiles for each of the ten shapes.

Forms follow the rules of `gym_deltaco.objects.objects`: objects are at most 46 mm wide between the fingers,
with vertical sides at the grasp height. Lengths are in millimeters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from gym_deltaco.objects.solids import (
    CIRCLE,
    HALVED_SQUARE,
    OCTAGON,
    ROUNDED,
    SQUARE,
    Loft,
    Paint,
    Row,
    pointed_oval,
    polygon,
)

_MAX_RADIUS = 23.0  # half the width between the fingers
_MIN_FOOT = 0.35  # smallest radius of a foot, relative to the height
_HEXAGON = polygon(6)


@dataclass(frozen=True, eq=False)
class Form:
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
        return max(ring_height(row) for row in self.outside)


def ring_height(row: Row) -> float:
    """Returns the height of a ring's center."""
    center = row[1]
    return float(center[2]) if isinstance(center, tuple) else float(center)


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return round(float(rng.uniform(low, high)), 1)


def _pick[T](rng: np.random.Generator, options: Sequence[T]) -> T:
    return options[int(rng.integers(len(options)))]


def _round_outlines(rng: np.random.Generator, is_tall: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Draws a round outline, and one for its parts; no hexagon if it is tall, since it would fall over."""
    fluted = polygon(16, (1.0, 0.92))
    outlines = [(CIRCLE, OCTAGON), (CIRCLE, OCTAGON), (OCTAGON, OCTAGON), (fluted, OCTAGON)]
    return _pick(rng, outlines if is_tall else [*outlines, (_HEXAGON, _HEXAGON)])


def _foot(radius: float, height: float) -> float:
    """Returns a radius that is large enough for an object to stay upright when it is dropped."""
    return round(max(radius, _MIN_FOOT * height), 1)


def _vase(rng: np.random.Generator) -> Form:
    outlines = _round_outlines(rng, is_tall=True)
    foot, belly = _between(rng, 14, 18), _between(rng, 19, _MAX_RADIUS)
    variant = _pick(rng, ("necked", "necked", "tall", "flared", "dome"))
    if variant == "tall":
        height = _between(rng, 48, 66)
        foot = _foot(foot, height)
        waist = round(height * 0.45, 1)
        outside = [(foot, 0), (belly - 1.5, waist), (belly, height - 18), (belly, height)]
        return Form(*outlines, outside, (height - 18, height), [(belly - 3.5, height), (foot - 4, 20)])
    if variant == "flared":
        height, neck = _between(rng, 42, 58), _between(rng, 13, 16)
        foot = _foot(foot, height)
        outside = [(foot, 0), (foot + 1.5, 10), (neck, height - 14), (belly, height - 10), (belly, height)]
        return Form(*outlines, outside, (height - 10, height), [(neck - 3, height), (neck - 5, height - 20)])
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
        return Form(*outlines, outside, (low, high), [(top - 3, height), (top - 4, height - 7)])
    neck = _between(rng, 7, 11)
    lip = _between(rng, neck + 1.5, 15)
    outside = [
        (foot, 0),
        (belly, low),
        (belly, high),
        (neck, round(height - (height - high) * 0.4, 1)),
        (lip, height),
    ]
    return Form(*outlines, outside, (low, high), [(lip - 3, height), (neck - 3, height - 9)])


def _chalice(rng: np.random.Generator) -> Form:
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
    return Form(*outlines, outside, (height - rim, height), inside)


def _freeform(rng: np.random.Generator) -> Form:
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
        return Form(outline, OCTAGON, outside, (height - 10, height))
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
    return Form(SQUARE, SQUARE, outside, (0, seat), yaw=0.25)


def _bottle(rng: np.random.Generator) -> Form:
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
    return Form(*outlines, outside, (shoulder - 12, shoulder))


def _canoe(rng: np.random.Generator) -> Form:
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
    return Form(
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


def _cup(rng: np.random.Generator) -> Form:
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
        return Form(*outlines, outside, (height - 12, height - 2))
    if variant == "plain":
        return Form(*outlines, outside, band, inside)
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
    return Form(CIRCLE, OCTAGON, outside, band, inside, yaw=0.25, extras=[(handle, [part])])


def _bowl(rng: np.random.Generator) -> Form:
    variant = _pick(rng, ("shallow", "deep", "oblong", "footed"))
    if variant == "oblong":
        x, y, height = _between(rng, 18, 22.5), _between(rng, 27, 42), _between(rng, 20, 38)
        foot = _between(rng, 0.65, 0.85)
        outside: list[Row] = [((x * foot, y * foot), 0), ((x, y), height - 12), ((x, y), height)]
        inside: list[Row] = [((x - 4, y - 5), height), ((x * 0.5, y * 0.6), 8)]
        yaw = 0.2 if y > 33 else 0.3
        return Form(ROUNDED, ROUNDED, outside, (height - 12, height), inside, yaw=yaw)
    outlines = _round_outlines(rng)
    top = _between(rng, 21, _MAX_RADIUS)
    if variant == "shallow":
        height = _between(rng, 19, 28)
        outside = [(top - _between(rng, 1, 5), 0), (top, 6), (top, height)]
        return Form(*outlines, outside, (6, height), [(top - 3, height), (top - 5, 5)])
    height = _between(rng, 34, 50)
    foot = _between(rng, 14, 18)
    inside = [(top - 3, height), (foot - 4, height * 0.4)]
    if variant == "deep":
        outside = [(foot, 0), (top, height - 16), (top, height)]
        return Form(*outlines, outside, (height - 16, height), inside)
    waist = _between(rng, 8, 12)
    outside = [(foot, 0), (waist, height * 0.3), (top, height - 14), (top, height)]
    return Form(*outlines, outside, (height - 14, height), [(top - 3, height), (8, height * 0.5)])


def _trapezoidal_prism(rng: np.random.Generator) -> Form:
    x, aspect = _between(rng, 16.5, 20.5), _pick(rng, (1.0, 1.25, 1.6, 2.05))
    y = round(min(x * aspect, 42.0), 1)
    height = _between(rng, 20, 30) if aspect > 1.5 else _between(rng, 30, 64)
    narrow = max(_between(rng, 0.7, 0.88), 12.2 / x)
    small = (round(x * narrow, 1), round(y * narrow, 1))
    yaw = 0.3 if aspect == 1.0 or x < 18 else 0.2
    if height < 40 and rng.random() < 0.35:  # wider at the bottom
        outside: list[Row] = [((x, y), 0), ((x, y), 15), (small, height)]
        return Form(SQUARE, SQUARE, outside, (0, 15), yaw=yaw)
    outside = [(small, 0), ((x, y), height - 11), ((x, y), height)]
    inside: list[Row] = []
    if rng.random() < 0.7:
        inside = [((x - 3, y - 3), height), ((small[0] - 3, small[1] - 4), 7)]
    return Form(HALVED_SQUARE, SQUARE, outside, (height - 11, height), inside, yaw=yaw)


def _cylinder(rng: np.random.Generator) -> Form:
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
    return Form(outline, part_outline, outside, (0, height), inside)


def _round_hole(rng: np.random.Generator) -> Form:
    sides = int(_pick(rng, (8, 12, 16)))
    outline = polygon(sides, (1.0, 0.92) if sides == 16 and rng.random() < 0.6 else (1.0,))
    if rng.random() < 0.4:  # tube, or lampshade
        radius, wall = _between(rng, 18, 21), _between(rng, 4, 8)
        height = _between(rng, 24, 44)
        top = radius if rng.random() < 0.5 else _between(rng, 0.6, 0.85) * radius
        outside: list[Row] = [(radius, 0), (radius, 16), (top, height)]
        inside: list[Row] = [(top - wall, height), (radius - wall - 2, 0)]
        band = (0.0, height if top == radius else 16.0)
        return Form(outline, OCTAGON, outside, band, inside, is_ring=True)
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
    return Form(
        outline, OCTAGON, outside, (0, max(side, 12.0)), inside, is_ring=True, yaw=np.pi if x == y else 0.3
    )


FAMILIES: Mapping[str, Callable[[np.random.Generator], Form]] = MappingProxyType(
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
