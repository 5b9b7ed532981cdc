"""Geometry of the 32 objects: visible meshes, collision parts and grasp heights.

The authors' meshes are not public. These parametric solids resemble the objects in figures 4 to 6 of the
paper in name, shape and color. Their labels are in `gym_deltaco.objects.labels`.

Recipes are in millimeters, with the table at z = 0 and the fingers closing along x. Models are in meters,
with the origin in the center of the bounding box. The gripper opens to 74 mm and arrives with an error of
about 10 mm, so that objects are at most 46 mm wide between the fingers. The collision parts have vertical
sides at the grasp height and a foot wide enough to land on; they differ from the mesh by up to 3 mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from types import MappingProxyType

import numpy as np

from gym_deltaco.objects.labels import OBJECTS, ObjectLabel
from gym_deltaco.objects.solids import (
    CIRCLE,
    HALVED_SQUARE,
    OCTAGON,
    ROUNDED,
    SQUARE,
    Color,
    Loft,
    Mesh,
    Row,
    merged,
    pointed_oval,
    polygon,
)


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """Geometry of one object, upright, with the origin in the center of its bounding box.

    Attributes:
        label: Name, shape and color of the object.
        mesh: Visible surface, m.
        parts: Corners of the convex collision parts, (P, 3) each, m. Their union approximates the mesh.
        grasp_height: Height of the finger pads' center above the object's base, m.
        yaw_range: Lowest and highest rotation about z at which it fits between the fingers, rad.
    """

    label: ObjectLabel
    mesh: Mesh
    parts: tuple[np.ndarray, ...]
    grasp_height: float
    yaw_range: tuple[float, float]

    @cached_property
    def half_extents(self) -> np.ndarray:
        """Half the size of the mesh's bounding box, (3,), m."""
        return self.mesh.vertices.max(axis=0)

    @property
    def height(self) -> float:
        """Height of the object, m."""
        return 2.0 * float(self.half_extents[2])

    @cached_property
    def radius(self) -> float:
        """Radius of the upright cylinder around the origin that contains the object, m."""
        points = np.concatenate([self.mesh.vertices, self.hull_points])
        return float(np.hypot(points[:, 0], points[:, 1]).max())

    @cached_property
    def hull_points(self) -> np.ndarray:
        """Corners of all collision parts, (P, 3), m."""
        return np.concatenate(self.parts)

    def footprint(self, yaw: float) -> np.ndarray:
        """Returns half extents in x and y, (2,), m, of the object rotated about z by `yaw` (rad)."""
        cosine, sine = np.cos(yaw), np.sin(yaw)
        return np.abs(self.hull_points[:, :2] @ np.array([[cosine, sine], [-sine, cosine]])).max(axis=0)


@dataclass(frozen=True, eq=False)
class ObjectRecipe:
    """Solids of an object, in millimeters and radians.

    Attributes:
        solids: Visible solids.
        parts: Convex solids for collisions.
        grasp: Grasp height above the table.
        yaw: Largest rotation about z to either side.
    """

    solids: Sequence[Loft]
    parts: Sequence[Loft]
    grasp: float
    yaw: float = np.pi


@cache
def object_model(index: int) -> ObjectModel:
    """Returns the model of one of the paper's objects; it is built on first use.

    Args:
        index: Index into `OBJECTS`, 0..31.
    """
    return build_model(OBJECTS[index], _RECIPES[OBJECTS[index].name])


def build_model(label: ObjectLabel, recipe: ObjectRecipe) -> ObjectModel:
    """Builds a model, in meters, from a recipe."""
    mesh = merged(solid.mesh() for solid in recipe.solids)
    center = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2.0
    parts = tuple((part.points() - center) * _MILLIMETER for part in recipe.parts)
    for part in parts:
        part.setflags(write=False)
    return ObjectModel(
        label=label,
        mesh=mesh.moved(-center, _MILLIMETER),
        parts=parts,
        grasp_height=recipe.grasp * _MILLIMETER,
        yaw_range=(-recipe.yaw, recipe.yaw),
    )


_MILLIMETER = 1e-3


def _rgb(code: str) -> Color:
    """Parses a color of three hexadecimal digits: the simulation renders 16 levels of each channel."""
    red, green, blue = (int(digit, 16) / 15.0 for digit in code)
    return red, green, blue


BLACK, CHARCOAL, PEWTER = _rgb("111"), _rgb("333"), _rgb("777")
ASH, IVORY, WHITE = _rgb("bbb"), _rgb("eee"), _rgb("fff")
IRON, IRON_DARK = _rgb("555"), _rgb("333")
STEEL, STEEL_DARK = _rgb("777"), _rgb("555")
SLATE, SLATE_DARK = _rgb("667"), _rgb("444")
SILVER, SILVER_DARK = _rgb("bbb"), _rgb("888")
ZINC, ZINC_DARK = _rgb("999"), _rgb("777")
FROST, FROST_LIGHT = _rgb("899"), _rgb("abb")
SKY, SKY_DARK = _rgb("59f"), _rgb("37c")
NAVY, NAVY_DARK = _rgb("12b"), _rgb("115")
ICE, ICE_DARK = _rgb("7bf"), _rgb("49d")
AZURE, COBALT, PICKLE = _rgb("28f"), _rgb("05b"), _rgb("893")
RED, CRIMSON = _rgb("e11"), _rgb("b11")
SCARLET, MAROON = _rgb("d21"), _rgb("711")
ORANGE, TANGERINE, RUST = _rgb("f80"), _rgb("f92"), _rgb("d60")
YELLOW, GOLD, MUSTARD = _rgb("fd1"), _rgb("db0"), _rgb("870")
SAND, SAND_DARK = _rgb("db7"), _rgb("a74")
PINE, PINE_LIGHT, PINE_DARK = _rgb("b84"), _rgb("c95"), _rgb("753")
BRICK, BRICK_LIGHT, BRICK_DARK = _rgb("954"), _rgb("a65"), _rgb("532")
OCHRE, OCHRE_LIGHT, OCHRE_DARK = _rgb("a61"), _rgb("c83"), _rgb("530")
HIVE, HIVE_DARK = _rgb("864"), _rgb("642")
UMBER, UMBER_DARK = _rgb("952"), _rgb("531")
OLIVE, OLIVE_DARK = _rgb("861"), _rgb("430")
FAWN, FAWN_LIGHT, FAWN_DARK = _rgb("a75"), _rgb("b86"), _rgb("743")
BARK, BARK_LIGHT, BARK_DARK = _rgb("532"), _rgb("864"), _rgb("321")
CREAM, CREAM_DARK = _rgb("ec8"), _rgb("a74")
MAHOGANY, MAHOGANY_LIGHT = _rgb("532"), _rgb("743")

_TRIANGLE = polygon(3)


def _round(*profile: Row) -> Loft:
    return Loft(CIRCLE, profile)


def _round_part(*profile: Row) -> Loft:
    return Loft(OCTAGON, profile)


def _block(low: Sequence[float], high: Sequence[float], paint: Color = WHITE) -> Loft:
    """Returns a box between two corners."""
    (x, y, z), (half_x, half_y, half_z) = np.add(low, high) / 2.0, np.subtract(high, low) / 2.0
    half = (float(half_x), float(half_y))
    return Loft(SQUARE, [(half, (x, y, z - half_z), paint), (half, (x, y, z + half_z))])


def _mottled(shift: int, *colors: Color) -> tuple[Color, ...]:
    """Returns colors that alternate around a band, shifted so that bands do not line up."""
    shift %= len(colors)
    return colors[shift:] + colors[:shift]


def _speckles(shift: int) -> tuple[Color, ...]:
    return _mottled(shift, BLACK, WHITE, WHITE, BLACK, WHITE)


def _bark(shift: int) -> tuple[Color, ...]:
    return _mottled(shift, BARK, BARK_DARK, BARK, BARK_LIGHT, BARK)


def _strut(turn: float, radii: tuple[float, float], heights: tuple[float, float], paint: Color) -> Loft:
    """Returns a thin bar of an openwork stand, between two distances from the axis and two heights.

    Args:
        turn: Rotation about z, degrees.
        radii: Distances of its ends from the axis, mm.
        heights: Heights of its ends, mm.
        paint: Color.
    """
    rows = [(3, (radius, 0, height), paint) for radius, height in zip(radii, heights, strict=True)]
    return Loft(_TRIANGLE, rows, turn=turn)


def _thwart(y: float, half_width: float, z: float, paint: Color) -> Loft:
    """Returns the seat of a canoe."""
    return _block((-half_width, y - 3, z - 3), (half_width, y + 3, z), paint)


# fmt: off
_SOFA = (
    _block((-15, -20, 0), (15, 21, 17), MAHOGANY_LIGHT),
    _block((-15, -24, 0), (15, -12, 32), MAHOGANY),
    _block((-22, -24, 0), (-14, 24, 27), MAHOGANY),
    _block((14, -24, 0), (22, 24, 27), MAHOGANY),
)

_RECIPES: Mapping[str, ObjectRecipe] = MappingProxyType({
    "conic cup": ObjectRecipe(
        [_round((16, 0, WHITE), (17, 38), (17.5, 43, ASH), (18.5, 49, PEWTER), (19.5, 58, CHARCOAL),
                (21.5, 58, BLACK), (21.5, 67), (19, 71))],
        parts=[_round_part((19, 0), (19, 57)), _round_part((22.5, 57), (22.5, 68), (20, 71))],
        grasp=60,
    ),
    "fountain vase": ObjectRecipe(
        [Loft(OCTAGON, [(16, 0, SAND_DARK), (23, 6, SAND), (23, 12), (18, 13, SAND_DARK), (18, 20, SAND),
                        (12, 23), (10, 34, SAND_DARK), (11, 43), (15, 47, SAND), (15, 56), (11, 56),
                        (8, 46, SAND_DARK)])],
        parts=[_round_part((18, 0), (23, 6), (23, 13)), _round_part((18, 13), (18, 20), (12, 25)),
               _round_part((11, 25), (11, 45)), _round_part((16, 45), (16, 56))],
        grasp=49,
    ),
    "circular table": ObjectRecipe(
        [_round((23, 0, SKY_DARK), (23, 5, SKY), (8, 8), (4, 20, SKY_DARK), (4.5, 30), (10, 40),
                (23, 43), (23, 49, SKY))],
        parts=[_round_part((23, 0), (23, 6)), _round_part((8.5, 6), (4.5, 22)),
               _round_part((4.5, 22), (9, 41)), _round_part((23, 41), (23, 49))],
        grasp=42,
    ),
    "hex deep bowl": ObjectRecipe(
        [Loft(polygon(6), [(16, 0, PINE), (23, 17, (PINE, PINE_LIGHT)), (23, 46, (PINE_LIGHT, PINE)),
                           (19, 46, PINE_LIGHT), (13, 14, PINE_DARK)], turn=30)],
        parts=[Loft(polygon(6), [(18.5, 0), (23, 17), (23, 46)], turn=30)],
        grasp=34,
    ),
    "smushed dumbbell": ObjectRecipe(
        [_round((22, 0, _speckles(0)), (23, 8, _speckles(1)), (17.5, 14, _speckles(3)),
                (14.5, 20, _speckles(0)), (17.5, 26, _speckles(2)), (23, 32, _speckles(4)),
                (22.5, 40, _speckles(1)), (14, 39, _speckles(3)), (7, 36, _speckles(2)))],
        parts=[_round_part((22, 0), (23, 8), (14.5, 20)), _round_part((14.5, 20), (22.5, 30), (22.5, 40))],
        grasp=31,
    ),
    "square prism bin": ObjectRecipe(
        [Loft(HALVED_SQUARE, [(14, 0, BRICK), (15, 17, (BRICK, BRICK_LIGHT)),
                              (16, 33, (BRICK_LIGHT, BRICK)), (17.5, 50, (BRICK, BRICK_LIGHT)),
                              (18.5, 66, (BRICK_LIGHT, BRICK)), (15.5, 66, BRICK_LIGHT),
                              (12, 30, BRICK_DARK)])],
        parts=[Loft(SQUARE, [(16.5, 0), (18.5, 42), (18.5, 66)])],
        grasp=54,
        yaw=0.3,
    ),
    "narrow tray": ObjectRecipe(
        [Loft(SQUARE, [((13.5, 34), 0, OCHRE), ((17.5, 42.5), 22), ((14.5, 39), 22, OCHRE_LIGHT),
                       ((11, 33), 7, OCHRE_DARK)])],
        parts=[Loft(SQUARE, [((16, 36), 0), ((17.5, 40), 9), ((17.5, 42.5), 22)])],
        grasp=13,
        yaw=0.3,
    ),
    "colunnade top": ObjectRecipe(
        [_round((22, 0, IRON), (22, 7), (9, 12), (16, 21, (IRON, IRON_DARK)), (16, 31, (IRON, IRON_DARK)),
                (10, 38, (IRON, IRON_DARK)), (23, 44, IRON), (23, 51), (18, 51), (9, 46, IRON_DARK))],
        parts=[_round_part((22, 0), (22, 8)), _round_part((9, 8), (16, 20), (16, 30)),
               _round_part((16, 30), (9.5, 43)), _round_part((23, 43), (23, 51))],
        grasp=43,
    ),
    "stalagcite chunk": ObjectRecipe(
        [Loft(polygon(10, (1.0, 0.9, 0.97, 1.0, 0.88, 1.0, 0.94, 1.0, 0.9, 1.0)),
              [(20, 0, WHITE), (20, 7), (15, 9, IVORY), ((20, 18), 19, WHITE), (14.5, 25, IVORY),
               (18, (1, 0, 34), WHITE), (13.5, (1, 1, 41), IVORY), ((17, 16), (-1, 0, 51), WHITE),
               (13.5, 57, IVORY), (20, 66, WHITE), (20, 74)])],
        parts=[_round_part((20, 0), (18, 20)), _round_part((16, 20), (16, 62)),
               _round_part((18, 62), (20, 65), (20, 74))],
        grasp=65,
    ),
    "bongo drum bowl": ObjectRecipe(
        [Loft(polygon(10), [(11, 23, SCARLET), (19, 35), (23, 45), (23, 58), (20, 58), (10, 38, MAROON)]),
         Loft(OCTAGON, [(18.5, 0, SCARLET), (17.5, 4), (14, 3)], closed=True),
         *(_strut(turn, radii=(16.5, 10.5), heights=(2, 25), paint=SCARLET) for turn in range(18, 360, 60))],
        parts=[_round_part((18, 0), (12, 26)), _round_part((12, 26), (23, 45), (23, 58))],
        grasp=50,
    ),
    "pacifier vase": ObjectRecipe(
        [_round((14.5, 0, WHITE), (17, 6), (18, 16), (17, 34), (15.5, 43, IVORY), (23, 46), (23, 51, WHITE),
                (13, 51), (10, 30, ASH))],
        parts=[_round_part((17.5, 0), (18.5, 8), (18.5, 20)), _round_part((18.5, 20), (16, 43)),
               _round_part((23, 43), (23, 51))],
        grasp=44,
    ),
    "beehive funnel": ObjectRecipe(
        [_round((18, 0, HIVE_DARK), (22, 8), (23, 18, HIVE), (22.5, 28, HIVE_DARK), (21, 38, HIVE),
                (18, 47, HIVE_DARK), (13.5, 56, HIVE), (9, 62, HIVE_DARK), (6, 62), (5, 54, BARK_DARK))],
        parts=[_round_part((18, 0), (23, 12), (23, 32)), _round_part((23, 32), (18, 47), (9, 62))],
        grasp=27,
    ),
    "crooked lid trash can": ObjectRecipe(
        [Loft(polygon(20, (1.0, 0.9)), [(18.5, 0, STEEL), (20.5, 50, (STEEL, STEEL_DARK))]),
         Loft(CIRCLE, [(22, 0, STEEL_DARK), (22, 6, STEEL), (13, 9), (5, 9, STEEL_DARK), (5, 13, STEEL)],
              tilt=11, offset=(1, 0, 51))],
        parts=[_round_part((20, 0), (21.5, 36), (21.5, 57)), _round_part((21.5, 57), (6, 64))],
        grasp=46,
    ),
    "toilet bowl": ObjectRecipe(
        [Loft(ROUNDED, [((15, 20), 0, WHITE), ((14, 18), 10), ((20, 25), 22), ((20, 25), 31, IVORY),
                        ((23, 29), 33, WHITE), ((23, 29), 42), ((17, 22), 42), ((9, 13), 24, ASH)])],
        parts=[Loft(ROUNDED, [((17, 22), 0), ((16, 20), 11)]),
               Loft(ROUNDED, [((15, 19), 11), ((22, 27), 31)]),
               Loft(ROUNDED, [((23, 29), 31), ((23, 29), 42)])],
        grasp=35,
        yaw=0.3,
    ),
    "pepsi bottle": ObjectRecipe(
        [_round((18.5, 0, RED), (20.5, 4), (20.5, 21), (17.5, 27, CRIMSON), (20.5, 33), (20.5, 47, RED),
                (14, 58), (7, 64), (9, 66, CRIMSON), (9, 75))],
        parts=[_round_part((20.5, 0), (20.5, 22)), _round_part((18.5, 22), (20.5, 31), (20.5, 47)),
               _round_part((20.5, 47), (14, 58), (9, 64)), _round_part((9, 64), (9, 75))],
        grasp=40,
    ),
    "tongue chair": ObjectRecipe(
        [Loft(SQUARE, [((20, 19), (-2, 0, 0), CRIMSON), ((21, 20), (-1, 0, 7)), ((18, 20), (5, 0, 13), RED),
                       ((17.5, 20), (5, 0, 20)), ((15.5, 20), (2.5, 0, 24)), ((11, 20), (-3, 0, 27)),
                       ((8, 20), (-7, 0, 30)), ((7, 20), (-11, 0, 37)), ((7.5, 20), (-14.5, 0, 45)),
                       ((6, 18), (-16, 0, 52))])],
        parts=[_block((-22, -20, 0), (20, 20, 11)), _block((-12.5, -20, 11), (23, 20, 24)),
               Loft(SQUARE, [((8, 20), (-4.5, 0, 24)), ((9, 20), (-13, 0, 43)), ((7, 20), (-15, 0, 52))])],
        grasp=17,
        yaw=0.25,
    ),
    "modern canoe": ObjectRecipe(
        [Loft(pointed_oval(16, lift=4), [((12, 30), 0, RUST), ((17, 40), 9, ORANGE), ((18, 42.5), 20),
                                         ((15, 38), 20, TANGERINE), ((11.5, 33), 9, ORANGE)]),
         _thwart(-14, 13, 18, TANGERINE), _thwart(14, 13, 18, TANGERINE)],
        parts=[Loft(pointed_oval(8, lift=4), [((15, 32), 0), ((18, 40), 8), ((18, 42.5), 20)])],
        grasp=13,
        yaw=0.3,
    ),
    "pear ringed vase": ObjectRecipe(
        [_round((16, 0, ORANGE), (21, 8), (21, 12, RUST), (23, 20, ORANGE), (23, 25, RUST), (23, 34, ORANGE),
                (17, 43), (8, 49, RUST), (7, 58, ORANGE), (12, 67))],
        parts=[_round_part((19, 0), (23, 13), (23, 35)), _round_part((23, 35), (17, 43), (8, 49)),
               _round_part((8, 49), (8, 60)), _round_part((8, 60), (12, 67))],
        grasp=31,
    ),
    "short handle cup": ObjectRecipe(
        [_round((20, 0, NAVY), (20, 42), (17, 42), (16, 6, NAVY_DARK)),
         Loft(OCTAGON, [(12, -3, NAVY), (12, 3), (8, 3), (8, -3)], closed=True,
              tilt=90, turn=35, offset=(-10.3, 14.7, 21))],
        parts=[_round_part((20, 0), (20, 42)),
               Loft(SQUARE, [((3, 6), (0, 24, 11)), ((3, 6), (0, 24, 31))], turn=35)],
        grasp=30,
        yaw=0.25,
    ),
    "bullet vase": ObjectRecipe(
        [_round((15, 0, UMBER), (17.5, 8), (19, 20), (20.5, 38), (20.5, 68), (16.5, 68),
                (14, 44, UMBER_DARK))],
        parts=[_round_part((18.5, 0), (20.5, 26), (20.5, 68))],
        grasp=46,
    ),
    "glass half gallon": ObjectRecipe(
        [_round((19, 0, SILVER), (20, 3), (20, 42), (18, 48), (10, 60), (8, 66, SILVER_DARK),
                (9.5, 68, SILVER), (9.5, 75), (6, 75), (6, 70, STEEL_DARK))],
        parts=[_round_part((20.5, 0), (20.5, 43)), _round_part((20, 43), (18, 48), (10, 60)),
               _round_part((9.5, 60), (9.5, 75))],
        grasp=40,
    ),
    "flat bottom sack vase": ObjectRecipe(
        [_round((18, 0, OLIVE), (23, 8), (23, 18), (20, 27), (13, 35), (8.5, 41), (10, 46),
                (7, 46, OLIVE_DARK), (5, 38))],
        parts=[_round_part((18, 0), (23, 7), (23, 19)), _round_part((23, 19), (9.5, 46))],
        grasp=14,
    ),
    "trapezoidal bin": ObjectRecipe(
        [Loft(HALVED_SQUARE, [((15, 19), 0, FAWN), ((17, 22), 20, (FAWN, FAWN_LIGHT)),
                              ((19.5, 25), 40, (FAWN_LIGHT, FAWN)), ((16.5, 22), 40, FAWN_LIGHT),
                              ((13, 18), 8, FAWN_DARK)])],
        parts=[Loft(SQUARE, [((16.5, 20), 0), ((19.5, 24), 24), ((19.5, 25), 40)])],
        grasp=30,
        yaw=0.25,
    ),
    "vintage canoe": ObjectRecipe(
        [Loft(pointed_oval(16, lift=6), [((14, 33), 0, BARK_DARK), ((20, 40), 9, _bark(0)),
                                         ((21, 42.5), 18, _bark(2)), ((17.5, 39), 18, BARK_LIGHT),
                                         ((13, 33), 8, BARK_DARK)]),
         _thwart(-10, 17, 16, BARK_LIGHT), _thwart(10, 17, 16, BARK_LIGHT)],
        parts=[Loft(pointed_oval(8, lift=6), [((17.5, 33), 0), ((21, 40), 8), ((21, 42.5), 18)])],
        grasp=12,
        yaw=0.3,
    ),
    "bathtub": ObjectRecipe(
        [Loft(ROUNDED, [((15, 32), 0, ZINC), ((19, 38), 18), ((22, 41.5), 22), ((22, 42.5), 26),
                        ((17.5, 37), 26), ((12, 28), 7, ZINC_DARK)])],
        parts=[Loft(ROUNDED, [((16, 33), 0), ((20, 39), 17)]),
               Loft(ROUNDED, [((22, 42.5), 17), ((22, 42.5), 26)])],
        grasp=18,
        yaw=0.2,
    ),
    "flowery half donut": ObjectRecipe(
        [Loft(polygon(16, (1.0, 0.92)),
              [((23, 34), 0, FROST), ((23, 34), 10, (FROST, FROST_LIGHT)), ((19, 30), 18),
               ((13, 23), 18), ((9, 19), 10, FROST), ((9, 19), 0)],
              closed=True, crease=60)],
        parts=[Loft(OCTAGON, [((23, 34), 0), ((23, 34), 11), ((18, 29), 18)])],
        grasp=10,
        yaw=0.3,
    ),
    "t cup": ObjectRecipe(
        [_round((21, 0, ICE), (23, 4), (23, 24), (20, 30), (9, 34), (9, 45, ICE_DARK), (12, 50, ICE),
                (9, 50), (6, 38, ICE_DARK))],
        parts=[_round_part((21, 0), (23, 4), (23, 24)), _round_part((23, 24), (20, 30), (10, 34)),
               _round_part((9, 34), (11.5, 50))],
        grasp=17,
    ),
    "cookie circular lidless tin": ObjectRecipe(
        [_round((22, 0, CREAM), (23, 3), (23, 22), (20.5, 22), (20, 5, CREAM_DARK))],
        parts=[_round_part((22, 0), (23, 3), (23, 22))],
        grasp=12,
    ),
    "box sofa": ObjectRecipe(_SOFA, parts=_SOFA, grasp=18, yaw=0.2),
    "two layered lampshade": ObjectRecipe(
        [Loft(CIRCLE, [(15.5, 0, GOLD), (15, 25), (22, 27, MUSTARD), (23, 31, YELLOW), (13.5, 60),
                       (10.5, 60), (9, 0, MUSTARD)], closed=True)],
        parts=[_round_part((18.5, 0), (16, 27)), _round_part((23, 27), (23, 37), (15, 60))],
        grasp=31,
    ),
    "conic bin": ObjectRecipe(
        [_round((16, 0, SLATE), (22.5, 50), (19.5, 50), (14, 8, SLATE_DARK))],
        parts=[_round_part((18.5, 0), (22.5, 36), (22.5, 50))],
        grasp=41,
    ),
    "jar": ObjectRecipe(
        [_round((18, 0, PICKLE), (20.5, 4), (20.5, 12), (20.5, 18, AZURE), (20.5, 31, (AZURE, AZURE, WHITE)),
                (20.5, 38, AZURE), (18, 46, PICKLE), (20.5, 48, COBALT), (20.5, 60), (18, 62))],
        parts=[_round_part((18, 0), (20.5, 4), (20.5, 40)), _round_part((20.5, 40), (20.5, 60), (18, 62))],
        grasp=40,
    ),
})
# fmt: on
