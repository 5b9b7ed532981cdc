"""The WidowX 250 in the simulation: its links, collision boxes and motors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gym_deltaco.robot import kinematics as kin
from gym_deltaco.robot.arm_meshes import BASE_MESH, LINK_MESHES
from gym_deltaco.sim.simulation import TIME_STEP, Box, Contact, Link, Simulation

# Limits of the end effector's position
POSITION_LOW = np.array([0.4, -0.2, -0.34])  # m
POSITION_HIGH = np.array([0.8, 0.4, -0.1])  # m
FINGER_OPEN = 0.037  # m, distance of each finger from the middle
FINGER_CLOSED = 0.002  # m
FINGERTIP_OFFSET = 0.05  # m, from the end effector to the fingertips
FINGER_THICKNESS = 0.007  # m
FINGER_WIDTH = 0.024  # m

MOVE_STEPS = 10  # physics steps of a control step
GRIP_STEPS = 75  # physics steps of a control step in which the gripper opens or closes
_RAMP_STEPS = 10  # physics steps over which the joints' targets are interpolated
JOINT_STEPS = 8  # physics steps of a control step with joint control, 1/30 s
MAX_JOINT_SPEED = 3.0  # rad/s, with joint control
MAX_GRIPPER_SPEED = 2.5  # openings/s, with joint control
# Limits of the joints, with joint control
JOINT_LOW = np.array([-np.pi, -1.88, -1.6, -np.pi, -2.15, -np.pi])  # rad
JOINT_HIGH = np.array([np.pi, 1.99, 2.15, np.pi, 1.75, np.pi])  # rad

_ARM_JOINTS = list(range(6))
_FINGER_JOINTS = [6, 7]
_ARM_FORCES = [120.0, 120.0, 120.0, 60.0, 60.0, 60.0]  # N m
_ARM_GAINS = [0.9] * 6
_FINGER_FORCES = [12.0, 12.0]  # N
_FINGER_GAINS = [0.1, 0.1]
_FINGER_MASS = 0.02  # kg
_SURFACE = Contact(lateral_friction=2.0, spinning_friction=0.02)


def _finger(name: str, side: int) -> Link:
    # The box lies on the outer side of the pad, which is at the joint's position.
    middle = (FINGERTIP_OFFSET / 2, side * FINGER_THICKNESS / 2, 0.0)
    half_extents = (FINGERTIP_OFFSET / 2, FINGER_THICKNESS / 2, FINGER_WIDTH / 2)
    return Link(
        name,
        parent=5,
        origin=kin.END_EFFECTOR_OFFSET,
        axis=(0, 1, 0),
        is_prismatic=True,
        mass=_FINGER_MASS,
        inertia=(1e-4, 1e-4, 1e-4),
        mesh=LINK_MESHES[name],
        boxes=(Box(middle, half_extents),),
        limits=(0.0, FINGER_OPEN) if side > 0 else (-FINGER_OPEN, 0.0),
    )


_LINKS = (
    Link("waist", -1, kin.WAIST_ORIGIN, (0, 0, 1), 0.6, (2e-3,) * 3, LINK_MESHES["waist"]),
    Link("shoulder", 0, kin.SHOULDER_ORIGIN, (0, 1, 0), 0.7, (2e-3,) * 3, LINK_MESHES["shoulder"]),
    Link("elbow", 1, kin.ELBOW_ORIGIN, (0, 1, 0), 0.4, (1e-3,) * 3, LINK_MESHES["elbow"], is_rolled=True),
    Link(
        "forearm_roll", 2, kin.FOREARM_ROLL_ORIGIN, (1, 0, 0), 0.2, (5e-4,) * 3, LINK_MESHES["forearm_roll"]
    ),
    Link("wrist_angle", 3, kin.WRIST_ANGLE_ORIGIN, (0, 1, 0), 0.1, (3e-4,) * 3, LINK_MESHES["wrist_angle"]),
    Link(
        "wrist_rotate",
        4,
        kin.WRIST_ROTATE_ORIGIN,
        (1, 0, 0),
        0.2,
        (3e-4,) * 3,
        LINK_MESHES["wrist_rotate"],
        is_rolled=True,
        boxes=(Box((0.02, 0.0, 0.0), (0.018, 0.045, 0.012)),),
    ),
    _finger("left_finger", side=1),
    _finger("right_finger", side=-1),
)


class Arm:
    """The arm in one scene of a simulation.

    Only the gripper has collision boxes: while it points down, the links above it stay clear of the table.

    Attributes:
        body: Id of its body in the simulation.
        joints: Angles of its six joints, (6,), rad.
        position: Position of its end effector, (3,), m.
        is_open: State of its gripper, as commanded: whether it is more open than closed.
    """

    finger_links = (6, 7)

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self.body = simulation.add_articulated_body(BASE_MESH, _LINKS, kin.BASE_POSITION, _SURFACE)
        self._joint_targets = kin.REST_JOINTS.copy()
        self.is_open = True
        self._opening_target = 1.0
        simulation.set_joint_positions(self.body, [*kin.REST_JOINTS, FINGER_OPEN, -FINGER_OPEN])
        simulation.mirror_joints(self.body, (6, 7), axis=(0, 1, 0), max_force=200.0)
        self._drive_arm(kin.REST_JOINTS.tolist())
        self._drive_fingers(FINGER_OPEN)
        self._read()

    def command(self, position: ArrayLike, is_open: bool) -> None:
        """Runs one control step: moves the end effector, and opens or closes the gripper.

        Args:
            position: Target of the end effector, (3,), m; clipped to its limits.
            is_open: Target state of the gripper.
        """
        goal = kin.inverse(np.clip(position, POSITION_LOW, POSITION_HIGH), near=self._joint_targets)
        start, self._joint_targets = self._joint_targets, goal
        n_steps = MOVE_STEPS if is_open == self.is_open else GRIP_STEPS
        if is_open != self.is_open:
            self.is_open = is_open
            self._drive_fingers(FINGER_OPEN if is_open else FINGER_CLOSED)
        targets = (start + (goal - start) * _RAMP[:, None]).tolist()
        for step in range(n_steps):
            if step < _RAMP_STEPS:
                self._drive_arm(targets[step])
            self._simulation.step()
        self._read()

    def command_joints(self, joints: NDArray[np.float64], opening: float) -> None:
        """Runs one control step of 1/30 s: moves the joints and the fingers, no faster than they can.

        Args:
            joints: Target angles of the six joints, (6,), rad; clipped to their limits.
            opening: Target opening of the gripper; clipped to 0..1.
        """
        target = np.array([*np.clip(joints, JOINT_LOW, JOINT_HIGH), np.clip(opening, 0, 1)])
        start = np.array([*self._joint_targets, self._opening_target])
        goal = start + np.clip(target - start, -_MAX_MOTION, _MAX_MOTION)
        self._joint_targets, self._opening_target = goal[:6], float(goal[6])
        self.is_open = self._opening_target > 0.5
        for *angles, part in (start + (goal - start) * _PROGRESS[:, None]).tolist():
            self._drive_arm(angles)
            self._drive_fingers(FINGER_CLOSED + part * (FINGER_OPEN - FINGER_CLOSED))
            self._simulation.step()
        self._read()

    @property
    def opening(self) -> float:
        """Measured opening of the gripper: 0 closed, 1 open."""
        left, right = self._simulation.joint_positions(self.body, _FINGER_JOINTS)
        return float(((left - right) / 2 - FINGER_CLOSED) / (FINGER_OPEN - FINGER_CLOSED))

    def _read(self) -> None:
        """Updates `joints` and `position` from the simulation."""
        self.joints = self._simulation.joint_positions(self.body, _ARM_JOINTS)
        self.position = kin.forward(self.joints)[0]

    def _drive_arm(self, targets: list[float]) -> None:
        self._simulation.drive_joints(self.body, _ARM_JOINTS, targets, _ARM_FORCES, _ARM_GAINS)

    def _drive_fingers(self, width: float) -> None:
        self._simulation.drive_joints(
            self.body, _FINGER_JOINTS, [width, -width], _FINGER_FORCES, _FINGER_GAINS
        )


def _ramp(time: float) -> float:
    """Returns the fraction of a motion covered after a fraction of its duration.

    The motion starts and ends at rest, with minimal acceleration, so that a held object does not slip.
    """
    return 2 * time**2 if time < 0.5 else 1 - 2 * (1 - time) ** 2


_RAMP = np.array([_ramp(step / _RAMP_STEPS) for step in range(1, _RAMP_STEPS + 1)])
# Largest motion of the joints (rad) and of the gripper in a control step of joint control, and its progress
_MAX_MOTION = np.array([*[MAX_JOINT_SPEED] * 6, MAX_GRIPPER_SPEED]) * JOINT_STEPS * TIME_STEP
_PROGRESS = np.arange(1, JOINT_STEPS + 1) / JOINT_STEPS
