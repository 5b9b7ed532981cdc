"""The paper's objects and random ones: their meshes, colors, collision parts and stability."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pybullet
import pytest
from matplotlib.colors import rgb_to_hsv

from gym_deltaco.objects import objects
from gym_deltaco.objects.labels import (
    COLOR_SHAPE_PAIRS,
    FIRST_RANDOM_INDEX,
    OBJECTS,
    SCENARIO_A_TEST,
    find_label,
    random_label,
)
from gym_deltaco.objects.models import find_model
from gym_deltaco.objects.object_sets import FOLDS, MAX_OBJECTS, OBJECT_SETS, select_objects
from gym_deltaco.objects.objects import object_model
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.sim.simulation import _obj_text
from gym_deltaco.tasks import TASK_SETS, get_task

# Lengths in m
GRIPPER_OPENING = 0.074
GRASP_ERROR = 0.01
COLLISION_TOLERANCE = 0.004
PAD_REACH = 0.02  # half the extent in y that comes between the fingers

# Lowest and highest hue (degrees), saturation and value of the mean visible color
HSV_RANGES = {
    "brown": ((10, 46), (0.35, 0.9), (0.25, 0.8)),
    "blue": ((195, 245), (0.4, 1.0), (0.4, 1.0)),
    "gray": ((-60, 300), (0.0, 0.15), (0.25, 0.72)),
    "white": ((-60, 300), (0.0, 0.05), (0.85, 1.0)),
    "red": ((-5, 10), (0.85, 1.0), (0.6, 1.0)),
    "orange": ((22, 36), (0.85, 1.0), (0.85, 1.0)),
    "yellow": ((45, 58), (0.85, 1.0), (0.75, 1.0)),
}


# A fifth of the first random objects, which all differ in shape or color
SOME_RANDOM = range(FIRST_RANDOM_INDEX, FIRST_RANDOM_INDEX + len(COLOR_SHAPE_PAIRS), 5)
MODELS = [*range(len(OBJECTS)), *SOME_RANDOM]


@pytest.fixture(params=MODELS, ids=[find_label(index).name for index in MODELS])
def model(request):
    return find_model(request.param)


def test_every_label_has_one_read_only_model():
    assert tuple(object_model(index).label for index in range(len(OBJECTS))) == OBJECTS
    assert list(objects._RECIPES) == [label.name for label in OBJECTS]
    model = object_model(4)
    assert object_model(4) is model
    for array in (model.mesh.vertices, model.mesh.colors, model.parts[0]):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


def test_mesh_is_closed_and_faces_outward(model):
    mesh = model.mesh
    # Hard edges have duplicate vertices: join them by position.
    points = np.unique(mesh.vertices.round(8), axis=0, return_inverse=True)[1].ravel()[mesh.faces]
    edges = np.concatenate([points[:, [0, 1]], points[:, [1, 2]], points[:, [2, 0]]])
    forth, forth_count = np.unique(edges, axis=0, return_counts=True)
    back, back_count = np.unique(edges[:, ::-1], axis=0, return_counts=True)
    np.testing.assert_array_equal(forth, back)
    np.testing.assert_array_equal(forth_count, back_count)

    faces = doubled_areas(mesh)
    assert np.linalg.norm(faces, axis=1).min() > 1e-8
    assert np.einsum("fi,fi->", mesh.triangles[:, 0], faces) / 6 > 1e-6  # volume, m³
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-9)
    assert np.einsum("fi,fci->fc", faces, mesh.normals[mesh.faces]).min() > 0
    assert 12 <= len(mesh.faces) <= 260, "light enough to render"
    assert mesh.colors.shape == mesh.faces.shape
    assert 0 <= mesh.colors.min() <= mesh.colors.max() <= 1


def test_colors_have_16_levels_and_fit_into_one_palette():
    colors = np.concatenate([object_model(index).mesh.colors for index in range(len(OBJECTS))])
    assert len(np.unique(colors, axis=0)) <= 200
    np.testing.assert_allclose(15 * colors, (15 * colors).round(), atol=1e-9)


def doubled_areas(mesh) -> np.ndarray:
    """Returns normals of the faces, as long as their doubled areas, (F, 3)."""
    corners = mesh.triangles
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def test_object_shows_the_color_of_its_label(model):
    # As seen from the front and 40 degrees above, without occlusion.
    towards_camera = np.array([0.0, np.cos(np.radians(40)), np.sin(np.radians(40))])
    areas, colors = np.maximum(doubled_areas(model.mesh) @ towards_camera, 0), model.mesh.colors
    if model.label.color == "black and white":
        brightness = colors.mean(axis=1)
        assert areas[brightness < 0.2].sum() > 0.15 * areas.sum()
        assert areas[brightness > 0.8].sum() > 0.15 * areas.sum()
        return
    low, high = np.transpose(HSV_RANGES[model.label.color])
    if model.label.index < FIRST_RANDOM_INDEX:
        hsv = rgb_to_hsv(np.average(colors, axis=0, weights=areas))
    else:  # most faces, which may be darker; not the inside, and bands or a label in another color
        hsv = rgb_to_hsv(colors)
        low, high = low - (4, 0.1, 0.35), high + (4, 0.1, 1)
    hsv[..., 0] = (360 * hsv[..., 0] + 60) % 360 - 60  # red lies about zero
    has_color = ((low <= hsv) & (hsv <= high + 1e-9)).all(axis=-1)
    assert (has_color * areas).sum() > 0.5 * areas.sum()


def test_origin_and_size(model):
    low, high = model.mesh.vertices.min(axis=0), model.mesh.vertices.max(axis=0)
    np.testing.assert_allclose(low, -high, atol=1e-9)
    np.testing.assert_allclose(model.half_extents, high)
    assert model.height == pytest.approx(high[2] - low[2])
    assert 0.018 <= model.height <= 0.0751
    assert (2 * model.half_extents[:2] <= 0.0851).all()
    assert np.linalg.norm(model.half_extents[:2]) >= model.radius - 0.003
    assert model.radius >= model.half_extents[:2].max() - 1e-9
    np.testing.assert_allclose(model.footprint(0.0), np.abs(model.hull_points[:, :2]).max(axis=0))
    np.testing.assert_allclose(model.footprint(np.pi / 2), model.footprint(0.0)[::-1])
    assert (model.footprint(0.3) <= model.radius + 1e-9).all()
    base = model.mesh.vertices[model.mesh.vertices[:, 2] < low[2] + 5e-4, :2]
    assert np.ptp(base, axis=0).min() >= 0.0239 or model.height < 0.03


def test_fits_between_the_open_fingers(model):
    corners = model.mesh.triangles
    fractions = np.linspace(0, 1, 25)[:, None, None, None]
    edges = np.roll(corners, -1, axis=1) - corners
    outline = (corners + fractions * edges).reshape(-1, 3)  # points along all edges

    for yaw in np.linspace(*model.yaw_range, 9):
        cosine, sine = np.cos(yaw), np.sin(yaw)
        turned = outline @ np.array([(cosine, sine, 0), (-sine, cosine, 0), (0, 0, 1)])
        width = np.ptp(turned[np.abs(turned[:, 1]) <= PAD_REACH, 0])
        assert width <= GRIPPER_OPENING - 2 * GRASP_ERROR


def _slice_extent(part: np.ndarray, height: float) -> tuple[float, float]:
    """Returns the lowest and highest x of a convex part at a height; (inf, -inf) above and below it."""
    first, second = (part[list(index)] for index in zip(*combinations(range(len(part)), 2), strict=True))
    rise = second[:, 2] - first[:, 2]
    crosses = (first[:, 2] - height) * (second[:, 2] - height) <= 0
    crosses &= rise != 0
    if not crosses.any():
        return np.inf, -np.inf
    fraction = (height - first[crosses, 2]) / rise[crosses]
    x = first[crosses, 0] + fraction * (second[crosses, 0] - first[crosses, 0])
    return x.min(), x.max()


def test_pads_hold_vertical_sides(model):
    # On both sides, a vertical band within reach of the pads touches the fingers first.
    assert model.grasp_height >= 0.01
    assert model.height - model.grasp_height <= 0.037  # clear of the palm
    lowest = model.grasp_height - 0.006  # half a pad
    heights = np.arange(lowest, model.height, 0.0005)
    extents = np.array([[_slice_extent(p, z - model.height / 2) for p in model.parts] for z in heights])
    for reach in (-extents[..., 0].min(axis=1), extents[..., 1].max(axis=1)):
        touching = heights[reach > reach.max() - 0.0008]
        assert np.ptp(touching) >= 0.007
    assert (extents[..., 1].max(axis=1) - extents[..., 0].min(axis=1)).max() <= 0.0475


def test_collision_parts_approximate_the_mesh(model):
    assert 1 <= len(model.parts) <= 4
    assert all(4 <= len(part) <= 24 for part in model.parts)
    directions = np.concatenate([np.eye(3), -np.eye(3), np.random.default_rng(0).normal(size=(594, 3))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    reach_of_mesh = (model.mesh.vertices @ directions.T).max(axis=0)
    reach_of_parts = np.array([(part @ directions.T).max(axis=0) for part in model.parts])
    np.testing.assert_allclose(reach_of_parts.max(axis=0), reach_of_mesh, atol=COLLISION_TOLERANCE)
    # Every vertex lies in some part, or very close to it.
    outside = (model.mesh.vertices @ directions.T)[:, None] - reach_of_parts  # (V, parts, directions)
    assert outside.max(axis=2).min(axis=1).max() <= COLLISION_TOLERANCE


@pytest.fixture(scope="module")
def tilts(tmp_path_factory):
    """Returns the tilts of objects after a fall of 5 cm, degrees, (objects, yaws)."""
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -10, physicsClientId=client)
    plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    pybullet.createMultiBody(0, plane, physicsClientId=client)
    bodies = []
    for row, model in enumerate(map(find_model, MODELS)):
        path = tmp_path_factory.mktemp("parts") / "parts.obj"
        path.write_text(_obj_text(model.parts))
        shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, fileName=str(path), physicsClientId=client)
        for column, yaw in enumerate(np.linspace(*model.yaw_range, 5)):
            position = (0.2 * row, 0.2 * column, model.height / 2 + 0.05)
            turn = (0, 0, np.sin(yaw / 2), np.cos(yaw / 2))
            bodies.append(pybullet.createMultiBody(0.05, shape, -1, position, turn, physicsClientId=client))
    for _ in range(240):
        pybullet.stepSimulation(physicsClientId=client)
    turns = [pybullet.getBasePositionAndOrientation(body, physicsClientId=client)[1] for body in bodies]
    upright = np.array([pybullet.getMatrixFromQuaternion(turn)[8] for turn in turns])
    pybullet.disconnect(client)
    return np.degrees(np.arccos(np.clip(upright, -1, 1))).reshape(len(MODELS), -1)


def test_stands_after_a_drop(model, tilts):
    assert tilts[MODELS.index(model.label.index)].max() < 5


def test_random_objects_run_through_all_pairs_but_those_of_test_objects():
    labels = [random_label(index) for index in range(FIRST_RANDOM_INDEX, FIRST_RANDOM_INDEX + 144)]
    first, second = ([(label.color, label.shape) for label in part] for part in (labels[:72], labels[72:]))
    assert set(first) == set(second) == set(COLOR_SHAPE_PAIRS)
    assert first != second
    assert len(SCENARIO_A_TEST) == 8
    assert not {(label.color, label.shape) for label in SCENARIO_A_TEST} & set(first)
    # Those of the same color and shape differ.
    pairs = [
        (random_label(index).color, random_label(index).shape) for index in range(FIRST_RANDOM_INDEX, 400)
    ]
    red_cups = [FIRST_RANDOM_INDEX + number for number, pair in enumerate(pairs) if pair == ("red", "cup")]
    meshes = {find_model(index).mesh.vertices.tobytes() for index in red_cups}
    assert len(red_cups) == len(meshes) == 5


def test_sets_of_random_objects_include_the_training_objects_and_smaller_sets():
    fewer, more = select_objects("random:100"), select_objects("random:400")
    assert (len(set(fewer)), len(set(more))) == (100, 400)
    assert more[:100] == fewer
    assert fewer[:24] == OBJECT_SETS["scenario_a_train"] == select_objects("random:24")
    assert [find_label(label.index) for label in more] == list(more)


def test_unknown_set_is_an_error_that_names_the_valid_ones():
    for name in ("random:23", f"random:{MAX_OBJECTS + 1}", "random:", "random:-1", "some", 24, None, ["all"]):
        with pytest.raises(ValueError, match="`objects` must be .*random:N"):
            select_objects(name)


@pytest.mark.parametrize("fold", range(3))
def test_folds_hold_out_their_objects(fold):
    assert sorted(index for each in FOLDS for index in each) == list(range(24))
    held_out, labels = set(FOLDS[fold]), select_objects(f"fold_{fold}:400")
    pairs = {(OBJECTS[index].color, OBJECTS[index].shape) for index in held_out}
    assert {label.index for label in labels if label.index < 24} == set(range(24)) - held_out
    assert 340 < len(labels) < 392
    assert not any((label.color, label.shape) in pairs for label in labels if label.index >= 24)
    train, validation = (TASK_SETS[f"scenario_a_fold_{fold}_{kind}"] for kind in ("train", "validation"))
    SceneConfig(objects=f"fold_{fold}:400").check_tasks(train)
    SceneConfig(objects="scenario_a_train").check_tasks(validation)
    assert set(train) < set(TASK_SETS["random_train"])
    assert all(held_out & set(get_task(index).targets) for index in validation)
    by_name = {index % 50 for index in validation if get_task(index).kind == "name"}
    assert by_name == held_out
    assert not by_name & {index % 50 for index in train if get_task(index).kind == "name"}
