"""Composed images of static and moving bodies are equal to images of all bodies."""

from contextlib import closing

import numpy as np
import pytest

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.objects.solids import SQUARE, Loft
from gym_deltaco.scene_config import DEFAULT_SCENE, SceneConfig
from gym_deltaco.sim.camera import Camera
from gym_deltaco.sim.simulation import Box, Simulation
from gym_deltaco.sim.workspace import CAMERA

ABOVE = Camera(target=(0.6, 0.2, -0.35), distance=0.5, yaw=30, pitch=-85)
FRONT = Camera(target=(0, 0, 0), distance=0.6, yaw=20, pitch=-40)


def add_cube(simulation, position, color, is_static):
    """Adds a cube with sides of 0.1 m."""
    mesh = Loft(SQUARE, [(0.05, -0.05, color), (0.05, 0.05)]).mesh()
    if is_static:
        simulation.add_static_body(mesh, [Box((0, 0, 0), (0.05, 0.05, 0.05))], position)
    else:
        simulation.add_free_body(mesh, [mesh.vertices], position, yaw=0.0, mass=0.01)


@pytest.fixture
def simulation():
    with closing(Simulation()) as simulation:
        simulation.reset()
        yield simulation


def render_together(simulation, camera, size):
    """Returns the image that PyBullet renders of all bodies at once."""
    simulation._show()
    return simulation._image(camera, size)[0]


@pytest.mark.parametrize("scene", [DEFAULT_SCENE, SceneConfig("object", "random:40")])
def test_images_of_episodes_show_all_bodies(scene):
    with closing(PickPlaceEnv(scene=scene)) as env:
        for task_id in (4, 60, 155, 250):
            for step in expert_episode(env, task_id, seed=task_id):
                simulation = env.scene._simulation
                if step.stage.name in ("GRASP", "LOWER", "RELEASE", "REST"):
                    for camera, size in ((CAMERA, 48), (ABOVE, 33)):
                        image = simulation.render(camera, size)
                        assert image.dtype == np.uint8
                        assert image.flags.c_contiguous
                        np.testing.assert_array_equal(image, render_together(simulation, camera, size))


def test_surfaces_at_equal_depth_are_rendered_together(simulation):
    add_cube(simulation, (0.0, 0.0, 0.0), (1, 0, 0), is_static=True)
    add_cube(simulation, (0.05, 0.0, 0.0), (0, 1, 0), is_static=False)  # its top is in the same plane
    image = simulation.render(FRONT, 64)
    np.testing.assert_array_equal(image, render_together(simulation, FRONT, 64))


def test_bodies_added_later_are_seen(simulation):
    images = [simulation.render(FRONT, 32)]
    assert (images[0] == 255).all(), "an empty world is white"
    for number in range(4):
        add_cube(simulation, (0.13 * number - 0.2, 0.0, 0.0), (0.2, 0.2, 0.9), is_static=number % 2 == 1)
        images.append(simulation.render(FRONT, 32))
        np.testing.assert_array_equal(images[-1], render_together(simulation, FRONT, 32))
        assert not np.array_equal(images[-1], images[-2])
    simulation.reset()
    np.testing.assert_array_equal(simulation.render(FRONT, 32), images[0])
