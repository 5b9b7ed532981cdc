"""Images are put together from what moves and what does not, and equal those of all bodies at once."""

from contextlib import closing

import numpy as np
import pybullet
import pytest

from gym_deltaco.camera import Camera
from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.simulation import Box, Simulation
from gym_deltaco.solids import shaded
from gym_deltaco.workspace import CAMERA

ABOVE = Camera(target=(0.6, 0.2, -0.35), distance=0.5, yaw=30, pitch=-85)


def box(size, color):
    """The mesh of a cube."""
    corners = size / 2 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return shaded(corners[np.array(faces)], np.array([color] * len(faces), dtype=float), crease=30.0)


@pytest.fixture
def simulation():
    with closing(Simulation()) as simulation:
        simulation.reset()
        yield simulation


def together(simulation, camera, size):
    """The image that PyBullet renders of all bodies at once."""
    simulation._show()
    return simulation._image(camera, size)[0]


@pytest.mark.parametrize("settings", [{}, {"ambiguity": "object", "objects": "random:40"}])
def test_images_of_episodes_are_those_of_all_bodies_at_once(settings):
    with closing(PickPlaceEnv(**settings)) as env:
        for task_id in (4, 60, 155, 250):
            for step in expert_episode(env, task_id, seed=task_id):
                simulation = env.scene._simulation
                if step.stage.name in ("GRASP", "LOWER", "RELEASE", "REST"):
                    for camera, size in ((CAMERA, 48), (ABOVE, 33)):
                        image = simulation.render(camera, size)
                        assert image.dtype == np.uint8
                        assert image.flags.c_contiguous
                        np.testing.assert_array_equal(image, together(simulation, camera, size))


def test_surfaces_at_the_same_depth_are_rendered_together(simulation, monkeypatch):
    """Which of them is seen is decided by their order, as if nothing were put together."""
    for where, color in (((0.0, 0.0, 0.0), (1, 0, 0)), ((0.05, 0.0, 0.0), (0, 1, 0))):
        mesh = box(0.1, color)
        if color[0]:
            simulation.add_static_body(mesh, [Box((0, 0, 0), (0.05, 0.05, 0.05))], where)
        else:
            simulation.add_free_body(mesh, [mesh.vertices], where, yaw=0.0, mass=0.01)
    shown = []
    show = Simulation._show
    monkeypatch.setattr(Simulation, "_show", lambda self, **kinds: (shown.append(kinds), show(self, **kinds)))
    camera = Camera(target=(0, 0, 0), distance=0.4, yaw=20, pitch=-40)
    image = simulation.render(camera, 64)
    assert shown[-1] == {}  # all together, since both have the same upper face
    np.testing.assert_array_equal(image, together(simulation, camera, 64))


def test_what_is_added_later_is_seen(simulation):
    camera = Camera(target=(0, 0, 0), distance=0.6, yaw=20, pitch=-40)
    images = [simulation.render(camera, 32)]
    for number in range(4):
        mesh = box(0.06, (0.2, 0.2, 0.9))
        position = (0.1 * number - 0.15, 0.0, 0.0)
        if number % 2:
            simulation.add_static_body(mesh, [Box((0, 0, 0), (0.03, 0.03, 0.03))], position)
        else:
            simulation.add_free_body(mesh, [mesh.vertices], position, yaw=0.0, mass=0.01)
        images.append(simulation.render(camera, 32))
        np.testing.assert_array_equal(images[-1], together(simulation, camera, 32))
        assert not np.array_equal(images[-1], images[-2])
    simulation.reset()
    np.testing.assert_array_equal(simulation.render(camera, 32), images[0])


@pytest.mark.parametrize(
    ("name", "n_calls"),
    [*(("getCameraImage", n) for n in range(2)), *(("changeVisualShape", n) for n in range(8))],
)
def test_an_image_that_is_interrupted_does_not_change_later_ones(simulation, monkeypatch, name, n_calls):
    camera = Camera(target=(0, 0, 0), distance=0.6, yaw=20, pitch=-40)
    for where in (-0.1, 0.1):
        mesh = box(0.1, (0.2, 0.2, 0.9))
        simulation.add_static_body(mesh, [Box((0, 0, 0), (0.05, 0.05, 0.05))], (where, 0.0, 0.0))
        simulation.add_free_body(mesh, [mesh.vertices], (where, 0.15, 0.0), yaw=0.0, mass=0.01)
    expected = simulation.render(camera, 32)
    np.testing.assert_array_equal(expected, together(simulation, camera, 32))
    simulation.render(camera, 32)
    function, calls = getattr(pybullet, name), []

    def interrupted(*args, **kwargs):
        calls.append(name)
        if len(calls) == n_calls + 1:
            raise KeyboardInterrupt
        return function(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(pybullet, name, interrupted)
        with pytest.raises(KeyboardInterrupt):
            simulation.render(camera, 16)  # its background is new
    for _ in range(2):
        np.testing.assert_array_equal(simulation.render(camera, 32), expected)
    np.testing.assert_array_equal(together(simulation, camera, 32), expected)


def test_a_camera_that_sees_nothing_sees_white(simulation):
    assert (simulation.render(CAMERA, 8) == 255).all()
