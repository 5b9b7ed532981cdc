"""A task's scene: positions, the robot's state, actions and success. Only this file knows robosuite."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from lerobot_env_libero_pro.installation import load_libero
from lerobot_env_libero_pro.suites import Task

CONTROL_FPS = 20  # actions a second
SETTLING_STEPS = 10  # of LIBERO's protocol, before the first action of an episode
LIFTED = 0.04  # m above its height at first, from which on an object counts as lifted
# Displacement of the hand in units of 0.05 m, rotation in units of 0.5 rad, and a velocity of the fingers:
# the gripper closes at 1 and opens at -1, over about seven actions.
ACTION_NAMES = ("dx", "dy", "dz", "drx", "dry", "drz", "gripper")
NO_ACTION = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)
# Position of the point between the fingertips, m; the hand's axis times angle, rad, continuous around
# (pi, 0, 0), where it points downwards; both fingers' positions, m.
STATE_NAMES = ("x", "y", "z", "rx", "ry", "rz", "finger_1", "finger_2")


class Scene:
    """The scene of a task. It is built once, in seconds; a reset takes 20 ms.

    Args:
        task: The task.

    Attributes:
        task: The task.
        model: Model of MuJoCo, the same for the whole life of the scene.
        data: Data of MuJoCo.
    """

    def __init__(self, task: Task) -> None:
        load_libero()
        from libero.libero.envs.env_wrapper import ControlEnv

        self.task = task
        # Else robosuite refuses actions after its own horizon. No cameras: see cameras.py.
        self._env = ControlEnv(
            bddl_file_name=str(task.bddl),
            control_freq=CONTROL_FPS,
            ignore_done=True,
            hard_reset=False,
            use_camera_obs=False,
            has_offscreen_renderer=False,
        )
        self._inner = self._env.env
        self._inner._observables.clear()  # the simulator would update all of them 500 times a second
        self.model: Any = self._inner.sim.model._model
        self.data: Any = self._inner.sim.data._data
        self._heights: dict[str, float] = {}

    def reset(
        self, seed: int, state: np.ndarray | None = None, poses: dict[str, np.ndarray] | None = None
    ) -> None:
        """Puts the scene into a state, and lets it settle.

        Args:
            seed: Seed of what LIBERO draws: places in the regions of the BDDL file. A state overrides those
                of movable objects, but leaves those of fixtures.
            state: A state of `Task.initial_states`.
            poses: Positions and quaternions, (7,), of movable objects that stand elsewhere than in the state.
        """
        with _seeded(seed):
            self._inner.reset()
        # Which robosuite forgets: what the fingers did last in the episode before.
        self._inner.robots[0].gripper.current_action[:] = 0
        if state is not None:
            self._env.set_state(state)
        for name, pose in (poses or {}).items():
            self._inner.sim.data.set_joint_qpos(self._joint(name), pose)
        self._inner.sim.forward()
        for _ in range(SETTLING_STEPS):
            self.step(NO_ACTION)
        self._heights = {name: self.position(name)[2] for name in self.task.objects}

    def step(self, action: np.ndarray) -> None:
        """Carries out an action, (7,), within [-1, 1]: `ACTION_NAMES`."""
        self._inner.step(np.asarray(action, np.float64))

    def robot_state(self) -> np.ndarray:
        """Returns the robot's state, (8,) float32: `STATE_NAMES`."""
        return self.robot_state_at(self.hand_position())

    def robot_state_at(self, position: np.ndarray, turn: float = 0) -> np.ndarray:
        """Returns the robot's state, (8,) float32, if its hand was elsewhere.

        Args:
            position: Position of the point between the fingertips, (3,), m.
            turn: Angle around the vertical by which the hand is turned, rad.
        """
        robot = self._inner.robots[0]
        w, x, y, z = self.data.body(robot.robot_model.eef_name).xquat
        cos, sin = np.cos(turn / 2), np.sin(turn / 2)
        w, *vector = cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w
        # The quaternion's sign is kept: its angle then runs through pi without a jump.
        axis_angle = 2 * np.arccos(np.clip(w, -1, 1)) * np.array(vector) / max(np.linalg.norm(vector), 1e-8)
        fingers = self.data.qpos[robot._ref_gripper_joint_pos_indexes]
        return np.concatenate([position, axis_angle, fingers]).astype(np.float32)

    def hand_position(self) -> np.ndarray:
        """Returns the position of the point between the fingertips: (3,), m."""
        return self.data.site_xpos[self._inner.robots[0].eef_site_id].copy()

    def hand_rotation(self) -> np.ndarray:
        """Returns the hand's rotation, (3, 3): fingers move along axis 0 and point along axis 2."""
        return self.data.site_xmat[self._inner.robots[0].eef_site_id].reshape(3, 3).copy()

    def base_position(self) -> np.ndarray:
        """Returns the position of the robot's base: (3,), m."""
        return self.data.body("robot0_base").xpos.copy()

    def position(self, name: str) -> np.ndarray:
        """Returns the position of an object's or a fixture's origin, or of a region's center: (3,), m."""
        if name in self._inner.obj_body_id:
            return self.data.xpos[self._inner.obj_body_id[name]].copy()
        return self.data.site(name).xpos.copy()

    def owner(self, place: str) -> str | None:
        """Returns what a region belongs to, or the object itself. None for regions of the table."""
        if place in self._inner.obj_body_id:
            return place
        return getattr(self._inner.object_sites_dict[place], "parent_name", None)

    def pose(self, name: str) -> np.ndarray:
        """Returns the position and quaternion, (7,), of a movable object."""
        return self._inner.sim.data.get_joint_qpos(self._joint(name)).copy()

    @property
    def state_size(self) -> int:
        """Number of values of a state of `Task.initial_states`."""
        return 1 + self.model.nq + self.model.nv  # the time, positions and velocities

    def positions_in(self, states: np.ndarray, name: str) -> np.ndarray:
        """Returns the positions, (n, 3) m, of a movable object in states (n, state size)."""
        first = 1 + self.model.joint(self._joint(name)).qposadr[0]
        return states[:, first : first + 3]

    def vertices(self, name: str) -> np.ndarray:
        """Returns the vertices of what is seen of an object or a fixture: (n, 3), m."""
        return np.concatenate([self._geom_vertices(geom) for geom in self._geoms(name, group=1)])

    def solids(self, name: str) -> list[np.ndarray]:
        """Returns the convex parts of an object that collide, by their corners: (n, 3) each, m."""
        return [self._geom_vertices(geom) for geom in self._geoms(name, group=0)]

    def fixture_points(self, spacing: float = 0.015) -> list[np.ndarray]:
        """Returns points, (n, 3) m each, of the boxes that fixtures consist of, where they collide."""
        geoms = [geom for name in self._inner.fixtures_dict for geom in self._geoms(name, group=0)]
        return [self._box_points(geom, spacing) for geom in geoms]

    def lifted(self) -> tuple[str, ...]:
        """Returns the names of the movable objects that are higher than at first, by more than `LIFTED`."""
        return tuple(
            name for name, height in self._heights.items() if self.position(name)[2] > height + LIFTED
        )

    def holds(self, predicate: tuple[str, ...]) -> bool:
        """Tells whether a predicate holds now, such as ("in", "milk_1", "basket_1_contain_region")."""
        return bool(self._inner._eval_predicate(predicate))

    def is_success(self) -> bool:
        """Tells whether the goal holds now."""
        return all(self.holds(predicate) for predicate in self.task.goal)

    def close(self) -> None:
        """Frees the simulator."""
        self._env.close()

    def _joint(self, name: str) -> str:
        return self._inner.objects_dict[name].joints[0]

    def _geoms(self, name: str, group: int) -> list[int]:
        """Returns the geoms of an object or a fixture: group 1 is what is seen, group 0 what collides."""
        root = self._inner.obj_body_id[name]
        bodies = [body for body in range(self.model.nbody) if root in self._ancestors(body)]
        is_part = np.isin(self.model.geom_bodyid, bodies) & (self.model.geom_group == group)
        return np.flatnonzero(is_part).tolist()

    def _ancestors(self, body: int) -> set[int]:
        """Returns a body and all those that carry it, without the world."""
        found = set()
        while body:
            found.add(body)
            body = self.model.body_parentid[body]
        return found

    def _geom_vertices(self, geom: int) -> np.ndarray:
        mesh = self.model.geom_dataid[geom]
        if mesh >= 0:
            start, count = self.model.mesh_vertadr[mesh], self.model.mesh_vertnum[mesh]
            points = self.model.mesh_vert[start : start + count]
        else:  # a box, or what fills one
            corners = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3)
            points = corners * self.model.geom_size[geom]
        return self._to_world(geom, points)

    def _box_points(self, geom: int, spacing: float) -> np.ndarray:
        axes = [np.linspace(-size, size, 2 + int(2 * size / spacing)) for size in self.model.geom_size[geom]]
        return self._to_world(geom, np.stack(np.meshgrid(*axes), -1).reshape(-1, 3))

    def _to_world(self, geom: int, points: np.ndarray) -> np.ndarray:
        return points @ self.data.geom_xmat[geom].reshape(3, 3).T + self.data.geom_xpos[geom]


@contextlib.contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Seeds NumPy's global generator, from which LIBERO draws, and gives it back as it was."""
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed % 2**32)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002
