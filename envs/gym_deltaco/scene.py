"""A scene in the simulation: the arm, a table with a tray and containers, and objects."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gym_deltaco.layout import Layout
from gym_deltaco.robot.arm import Arm
from gym_deltaco.robot.kinematics import forward
from gym_deltaco.sim.fixtures import (
    CONTAINER_BOXES,
    TABLE_BOXES,
    TRAY_BOXES,
    container_mesh,
    table_mesh,
    tray_mesh,
)
from gym_deltaco.sim.simulation import Contact, Pose, Simulation
from gym_deltaco.sim.workspace import (
    CAMERA,
    CONTAINER_FLOOR,
    CONTAINER_HALF_EXTENTS,
    DROP_HEIGHT,
    TRAY_CENTER,
    TRAY_FLOOR,
    WRIST_CAMERA,
)

OBJECT_MASS = 0.012  # kg
_OBJECT_SURFACE = Contact(lateral_friction=1.0, spinning_friction=0.002, rolling_friction=0.0005)
_FIXTURE_SURFACE = Contact(lateral_friction=0.6)

# An object below these limits lies at rest in a container
_STANDING_TOLERANCE = 0.012  # m, lowest point above the container's floor
_MAX_LINEAR_SPEED = 0.05  # m/s
_MAX_ANGULAR_SPEED = 2.0  # rad/s

_SETTLING_STEPS = 120  # largest number of physics steps after objects are dropped
_SETTLING_CHECK = 10  # physics steps between checks whether all objects are at rest
_SETTLED_SPEED = 0.005  # m/s


class Scene:
    """One scene, built in a simulation that is emptied first.

    Attributes:
        layout: Layout from which it was built.
        arm: The arm.
        bodies: Ids of the objects in the simulation.
    """

    def __init__(self, simulation: Simulation, layout: Layout) -> None:
        self.layout = layout
        self._simulation = simulation
        self._container_centers = np.array([item.quadrant.container_center for item in layout.containers])
        simulation.reset()
        # From front to back: the renderer skips hidden pixels.
        self.arm = Arm(simulation)
        self.bodies = [
            simulation.add_free_body(
                item.model.mesh,
                item.model.parts,
                (*item.xy, DROP_HEIGHT),
                item.yaw,
                OBJECT_MASS,
                _OBJECT_SURFACE,
            )
            for item in layout.objects
        ]
        for container, center in zip(layout.containers, self._container_centers, strict=True):
            simulation.add_static_body(
                container_mesh(container.color), CONTAINER_BOXES, (*center, TRAY_FLOOR), _FIXTURE_SURFACE
            )
        simulation.add_static_body(tray_mesh(), TRAY_BOXES, (*TRAY_CENTER, TRAY_FLOOR), _FIXTURE_SURFACE)
        simulation.add_static_body(table_mesh(), TABLE_BOXES, contact=_FIXTURE_SURFACE)
        self._settle()

    def _settle(self) -> None:
        for _ in range(_SETTLING_STEPS // _SETTLING_CHECK):
            for _ in range(_SETTLING_CHECK):
                self._simulation.step()
            self._read()
            if all(pose.linear_speed < _SETTLED_SPEED for pose in self._poses):
                return

    def _read(self) -> None:
        self._poses = [self._simulation.pose(body) for body in self.bodies]

    def command(self, position: NDArray[np.float64], is_open: bool) -> None:
        """Runs one control step of the arm.

        Args:
            position: Target of the end effector, (3,), m.
            is_open: Target state of the gripper.
        """
        self.arm.command(position, is_open)
        self._read()

    def command_joints(self, joints: NDArray[np.float64], opening: float) -> None:
        """Runs one control step with joint control.

        Args:
            joints: Target angles of the six joints, (6,), rad.
            opening: Target opening of the gripper, 0..1.
        """
        self.arm.command_joints(joints, opening)
        self._read()

    def render(self, size: int) -> NDArray[np.uint8]:
        """Returns the image of the benchmark's camera, (size, size, 3) uint8."""
        return self._simulation.render(CAMERA, size)

    def render_wrist(self, size: int) -> NDArray[np.uint8]:
        """Returns the image of the camera on the wrist, (size, size, 3) uint8."""
        return self._simulation.render_hand(WRIST_CAMERA, *forward(self.arm.joints), size)

    def object_pose(self, index: int) -> Pose:
        """Returns the pose and speed of the center of an object."""
        return self._poses[index]

    def object_span(self, index: int) -> tuple[float, float]:
        """Returns the heights of the lowest and the highest point of an object, m."""
        pose = self._poses[index]
        heights = self.layout.objects[index].model.hull_points @ pose.rotation[2] + pose.position[2]
        return float(heights.min()), float(heights.max())

    def is_grasped(self, index: int) -> bool:
        """Returns whether the gripper is closed and holds an object between its fingers."""
        return not self.arm.is_open and all(
            self._simulation.presses(self.bodies[index], self.arm.body, finger, axis=0)  # they close along x
            for finger in self.arm.finger_links
        )

    @property
    def held_object(self) -> int:
        """Number of the object that the gripper holds; -1 for none."""
        return max(filter(self.is_grasped, range(len(self.bodies))), default=-1)

    def container_around(self, index: int) -> int:
        """Returns the container whose floor an object is low enough to stand on; -1 for none."""
        offsets = np.abs(self._poses[index].position[:2] - self._container_centers)
        inside = np.flatnonzero((offsets < CONTAINER_HALF_EXTENTS).all(axis=1))
        if not len(inside) or self.object_span(index)[0] > CONTAINER_FLOOR + _STANDING_TOLERANCE:
            return -1
        return int(inside[0])

    def container_of(self, index: int) -> int:
        """Returns the container in which an object lies, released and at rest; -1 for none."""
        container, pose = self.container_around(index), self._poses[index]
        is_at_rest = pose.linear_speed < _MAX_LINEAR_SPEED and pose.angular_speed < _MAX_ANGULAR_SPEED
        if container < 0 or not is_at_rest or self._simulation.touch(self.bodies[index], self.arm.body):
            return -1
        return container
