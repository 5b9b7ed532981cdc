"""The only module that uses PyBullet.

Bodies are made from arrays instead of asset files: triangle meshes with one color per face are rendered,
boxes and convex hulls collide. Scenes are rebuilt for every episode, since a world that is restored from a
saved state is not reproducible to the last bit.
"""

from __future__ import annotations

import functools
import math
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.util import Finalize
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from gym_deltaco.objects.solids import Mesh
from gym_deltaco.sim.camera import Camera, HandCamera

# Optional, because many systems have to compile it: tasks, layouts, datasets and policies do not need it.
_import_error: ImportError | None = None
try:
    import pybullet
except ImportError as error:
    _import_error = error

TIME_STEP = 1 / 240  # s
GRAVITY = -10.0  # m/s²
# All meshes share one texture, which holds every color of 16 levels in each channel.
_COLOR_LEVELS = 16
_TEXTURE_WIDTH = _TEXTURE_HEIGHT = 64
_NO_SHAPE = -1
_ANGULAR_DAMPING = 0.9  # 1/s, of free bodies; without it, round ones rock on their rims for seconds
_BASE = -1
_CONTACT_NORMAL = 7  # field of a contact point
# Depths that differ by less may be equal up to rounding. Depth is 0 at the near plane and 1 at the far plane;
# in the scenes, the tolerance is a few micrometers.
_DEPTH_TOLERANCE = 2e-6
_MAX_BACKGROUNDS = 64


class Box(NamedTuple):
    """A collision box, aligned with the axes of a body's frame."""

    center: tuple[float, float, float]  # m
    half_extents: tuple[float, float, float]  # m


class Contact(NamedTuple):
    """Surface properties of a body; PyBullet multiplies those of two bodies in contact."""

    lateral_friction: float = 1.0
    spinning_friction: float = 0.0  # m
    rolling_friction: float = 0.0  # m


_DEFAULT_CONTACT = Contact()


class Pose(NamedTuple):
    """Pose and speed of a body in the world."""

    position: NDArray[np.float64]  # (3,), m
    rotation: NDArray[np.float64]  # (3, 3)
    linear_speed: float  # m/s
    angular_speed: float  # rad/s


class _Background(NamedTuple):
    """Image of the static bodies."""

    pixels: NDArray[np.uint8]  # (size, size, 3)
    depths: NDArray[np.float32]  # (size, size)


@dataclass(frozen=True)
class Link:
    """A link of an articulated body, with a joint at its origin.

    Attributes:
        name: Name of the link.
        parent: Index of the parent link, -1 for the base.
        origin: Origin of the joint in the parent's frame, m.
        axis: Axis of the joint in the link's frame.
        is_prismatic: Whether the joint slides (in m) instead of turning (in rad).
        is_rolled: Whether the link's frame is rolled by pi about the parent's x axis.
        mass: Mass, kg.
        inertia: Diagonal of the inertia tensor, kg m².
        mesh: Visible surface.
        boxes: Collision boxes, if any.
        limits: Lowest and highest position of the joint, m or rad; None for no limits.
    """

    name: str
    parent: int
    origin: tuple[float, float, float]
    axis: tuple[float, float, float]
    mass: float
    inertia: tuple[float, float, float]
    mesh: Mesh
    is_prismatic: bool = False
    is_rolled: bool = False
    boxes: tuple[Box, ...] = ()
    limits: tuple[float, float] | None = None


_Matrices = tuple[Sequence[float], Sequence[float]]  # view and projection


def check_simulator() -> None:
    """Checks that PyBullet is installed.

    Raises:
        ImportError: PyBullet is not installed. The message says what to install.
    """
    if _import_error is not None:
        raise ImportError(
            f"The environment needs PyBullet, which cannot be imported: {_import_error}. Install it with "
            '`pip install "lerobot_policy_deltaco[sim]"`; it needs a C++ compiler where there is no wheel.',
            name="pybullet",
        ) from _import_error


@functools.cache
def camera_matrices(camera: Camera) -> _Matrices:
    """Returns the view and projection matrices of a camera, 16 numbers each in column-major order."""
    view = pybullet.computeViewMatrixFromYawPitchRoll(
        camera.target, camera.distance, camera.yaw, camera.pitch, roll=0, upAxisIndex=2
    )
    return view, _projection(camera)


def _projection(camera: Camera | HandCamera) -> Sequence[float]:
    return pybullet.computeProjectionMatrixFOV(camera.fov, aspect=1, nearVal=camera.near, farVal=camera.far)


class Simulation:
    """A PyBullet world without a window.

    The constructor connects a client, which takes about 48 MB until `close`.
    """

    def __init__(self) -> None:
        # PyBullet reads textures and unions of hulls from files.
        self._files = Path(tempfile.mkdtemp(prefix="gym_deltaco_"))
        self._texture_file = self._files / "colors.png"
        _color_texture().save(self._texture_file)
        self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise RuntimeError("PyBullet has no free client left. Close environments that you no longer use.")
        # Unlike `weakref.finalize`, this also runs at the end of processes that `multiprocessing` forks.
        self._release = Finalize(self, _release, (self._client, self._files), exitpriority=0)
        self._hull_files: dict[object, str] = {}
        self._texture = -1
        # Visible parts, as body and link. Static parts have their mesh and position, as keys of backgrounds.
        self._static_parts: dict[tuple[int, int], tuple[object, ...]] = {}
        self._moving_parts: list[tuple[int, int]] = []
        self._shown = (True, True)  # static and moving parts
        self._backgrounds: dict[object, _Background] = {}

    def close(self) -> None:
        """Disconnects the client. Closing twice is harmless."""
        self._release()

    def __reduce__(self) -> NoReturn:
        raise TypeError("A simulation cannot be copied or pickled, because it owns a PyBullet client.")

    def reset(self) -> None:
        """Empties the world."""
        pybullet.resetSimulation(physicsClientId=self._client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP,
            # The threshold ends iterations early once contacts have converged, which halves the time.
            numSolverIterations=50,
            solverResidualThreshold=1e-4,
            deterministicOverlappingPairs=1,
            enableFileCaching=0,
            physicsClientId=self._client,
        )
        pybullet.setGravity(0, 0, GRAVITY, physicsClientId=self._client)
        self._texture = pybullet.loadTexture(str(self._texture_file), physicsClientId=self._client)
        self._static_parts, self._moving_parts, self._shown = {}, [], (True, True)

    def step(self) -> None:
        """Advances the world by `TIME_STEP`."""
        pybullet.stepSimulation(physicsClientId=self._client)

    # Bodies

    def add_static_body(
        self,
        mesh: Mesh,
        boxes: Sequence[Box],
        position: ArrayLike = (0, 0, 0),
        contact: Contact = _DEFAULT_CONTACT,
    ) -> int:
        """Adds a static body with collision boxes, and returns its id."""
        body = self._add_body(mesh, self._boxes(boxes), position, yaw=0.0, mass=0.0, contact=contact)
        self._register_static_part(body, mesh, position)
        return body

    def add_free_body(
        self,
        mesh: Mesh,
        hulls: Sequence[NDArray[np.float64]],
        position: ArrayLike,
        yaw: float,
        mass: float,
        contact: Contact = _DEFAULT_CONTACT,
    ) -> int:
        """Adds a body that moves freely and collides as a union of convex hulls.

        Args:
            mesh: Visible surface, in the body's frame.
            hulls: Vertices of the hulls, (P, 3) each, m, in the body's frame.
            position: Position of the body's origin and center of mass, (3,), m.
            yaw: Angle about the vertical axis, rad.
            mass: Mass, kg.
            contact: Properties of its surface.

        Returns:
            Id of the body.
        """
        body = self._add_body(mesh, self._hulls(mesh, hulls), position, yaw, mass, contact)
        self._show()
        self._moving_parts.append((body, _BASE))
        return body

    def add_articulated_body(
        self, base: Mesh, links: Sequence[Link], position: ArrayLike, contact: Contact
    ) -> int:
        """Adds a tree of links on a fixed base, where joint i moves link i, and returns its id."""
        body = pybullet.createMultiBody(
            baseMass=0,
            baseVisualShapeIndex=self._visual_shape(base),
            basePosition=position,
            linkMasses=[link.mass for link in links],
            linkCollisionShapeIndices=[
                self._boxes(link.boxes) if link.boxes else _NO_SHAPE for link in links
            ],
            linkVisualShapeIndices=[self._visual_shape(link.mesh) for link in links],
            linkPositions=[link.origin for link in links],
            linkOrientations=[(1, 0, 0, 0) if link.is_rolled else (0, 0, 0, 1) for link in links],
            linkInertialFramePositions=[(0, 0, 0)] * len(links),
            linkInertialFrameOrientations=[(0, 0, 0, 1)] * len(links),
            linkParentIndices=[link.parent + 1 for link in links],
            linkJointTypes=[
                pybullet.JOINT_PRISMATIC if link.is_prismatic else pybullet.JOINT_REVOLUTE for link in links
            ],
            linkJointAxis=[link.axis for link in links],
            physicsClientId=self._client,
        )
        self._paint(body, _BASE)
        self._register_static_part(body, base, position)
        self._moving_parts += [(body, link) for link in range(len(links))]
        for index, link in enumerate(links):
            self._paint(body, index)
            limits = {}
            if link.limits is not None:
                limits = dict(zip(("jointLowerLimit", "jointUpperLimit"), link.limits, strict=True))
            pybullet.changeDynamics(
                body,
                index,
                localInertiaDiagonal=link.inertia,
                jointDamping=0,
                linearDamping=0,
                angularDamping=0,
                **limits,
                physicsClientId=self._client,
            )
            self._set_contact(body, index, contact)
        return body

    def _add_body(
        self, mesh: Mesh, shape: int, position: ArrayLike, yaw: float, mass: float, contact: Contact
    ) -> int:
        body = pybullet.createMultiBody(
            baseMass=mass,
            baseCollisionShapeIndex=shape,
            baseVisualShapeIndex=self._visual_shape(mesh),
            basePosition=position,
            baseOrientation=(0, 0, np.sin(yaw / 2), np.cos(yaw / 2)),
            physicsClientId=self._client,
        )
        self._paint(body, _BASE)
        self._set_contact(body, _BASE, contact)
        pybullet.changeDynamics(
            body, _BASE, linearDamping=0.04, angularDamping=_ANGULAR_DAMPING, physicsClientId=self._client
        )
        return body

    def _visual_shape(self, mesh: Mesh) -> int:
        vertices, normals, uvs, indices = _visual_arrays(mesh)
        return pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            vertices=vertices,
            normals=normals,
            uvs=uvs,
            indices=indices,
            rgbaColor=(1, 1, 1, 1),
            specularColor=(0, 0, 0),
            physicsClientId=self._client,
        )

    def _paint(self, body: int, link: int) -> None:
        pybullet.changeVisualShape(body, link, textureUniqueId=self._texture, physicsClientId=self._client)

    def _set_contact(self, body: int, link: int, contact: Contact) -> None:
        pybullet.changeDynamics(
            body,
            link,
            lateralFriction=contact.lateral_friction,
            spinningFriction=contact.spinning_friction,
            rollingFriction=contact.rolling_friction,
            restitution=0.0,
            physicsClientId=self._client,
        )

    def _boxes(self, boxes: Sequence[Box]) -> int:
        return pybullet.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] * len(boxes),
            halfExtents=[box.half_extents for box in boxes],
            collisionFramePositions=[box.center for box in boxes],
            physicsClientId=self._client,
        )

    def _hulls(self, key: object, hulls: Sequence[NDArray[np.float64]]) -> int:
        if key not in self._hull_files:
            path = self._files / f"hulls_{len(self._hull_files)}.obj"
            path.write_text(_obj_text(hulls))
            self._hull_files[key] = str(path)
        return pybullet.createCollisionShape(
            pybullet.GEOM_MESH, fileName=self._hull_files[key], physicsClientId=self._client
        )

    # State

    def pose(self, body: int) -> Pose:
        """Returns the pose and speed of a body."""
        position, quaternion = pybullet.getBasePositionAndOrientation(body, physicsClientId=self._client)
        linear, angular = pybullet.getBaseVelocity(body, physicsClientId=self._client)
        rotation = np.array(pybullet.getMatrixFromQuaternion(quaternion)).reshape(3, 3)
        return Pose(np.array(position), rotation, math.hypot(*linear), math.hypot(*angular))

    def touch(self, body: int, other: int) -> bool:
        """Returns whether two bodies were in contact in the last step."""
        return bool(pybullet.getContactPoints(body, other, physicsClientId=self._client))

    def presses(self, body: int, other: int, other_link: int, axis: int) -> bool:
        """Returns whether a body and a link of another one press on each other along an axis of the world."""
        contacts = pybullet.getContactPoints(body, other, linkIndexB=other_link, physicsClientId=self._client)
        return any(abs(contact[_CONTACT_NORMAL][axis]) > math.sqrt(0.5) for contact in contacts)

    def joint_positions(self, body: int, joints: Sequence[int]) -> NDArray[np.float64]:
        """Returns positions of joints, (len(joints),), rad or m."""
        states = pybullet.getJointStates(body, joints, physicsClientId=self._client)
        return np.array([state[0] for state in states])

    def set_joint_positions(self, body: int, positions: ArrayLike) -> None:
        """Sets the positions of all joints of a body, rad or m, at rest."""
        for joint, position in enumerate(np.asarray(positions)):
            pybullet.resetJointState(body, joint, position, physicsClientId=self._client)

    def drive_joints(
        self,
        body: int,
        joints: Sequence[int],
        positions: Sequence[float],
        max_forces: Sequence[float],
        gains: Sequence[float],
    ) -> None:
        """Sets the targets of the joints' motors from the next step on.

        Args:
            body: Id of the articulated body.
            joints: Indices of the joints.
            positions: Target positions, rad or m.
            max_forces: Largest torques or forces, N m or N.
            gains: Fraction of the position error that a motor corrects in one step, 0..1.
        """
        pybullet.setJointMotorControlArray(
            body,
            joints,
            pybullet.POSITION_CONTROL,
            targetPositions=positions,
            forces=max_forces,
            positionGains=gains,
            physicsClientId=self._client,
        )

    def mirror_joints(self, body: int, joints: tuple[int, int], axis: ArrayLike, max_force: float) -> None:
        """Couples two joints so that both keep the same distance from zero."""
        constraint = pybullet.createConstraint(
            body,
            joints[0],
            body,
            joints[1],
            pybullet.JOINT_GEAR,
            axis,
            (0, 0, 0),
            (0, 0, 0),
            physicsClientId=self._client,
        )
        pybullet.changeConstraint(
            constraint, gearRatio=1, erp=0.5, maxForce=max_force, physicsClientId=self._client
        )

    # Images

    def render(self, camera: Camera, size: int) -> NDArray[np.uint8]:
        """Renders an image, (size, size, 3) uint8, in software (the same on every machine).

        Static bodies take two thirds of the time. They are rendered once; moving bodies are then composed
        with this background by the depth of each pixel. The result is the image of all bodies, to the last
        bit: where two depths are too close to compare, all bodies are rendered together.
        """
        background = self._background(camera, size)
        self._show(static=False)
        pixels, depths = self._image(camera, size)
        difference = depths - background.depths  # negative where a moving body is nearer
        is_covered = depths < 1 - _DEPTH_TOLERANCE
        if (is_covered & (np.abs(difference) < _DEPTH_TOLERANCE)).any():
            self._show()
            return np.ascontiguousarray(self._image(camera, size)[0])
        image = background.pixels.copy()
        np.copyto(image, pixels, where=(is_covered & (difference < 0))[..., None])
        return image

    def render_hand(
        self, camera: HandCamera, position: NDArray[np.float64], rotation: NDArray[np.float64], size: int
    ) -> NDArray[np.uint8]:
        """Renders the image of a camera that moves with the hand, (size, size, 3) uint8.

        Args:
            camera: The camera.
            position: Position of the end effector, (3,), m.
            rotation: Rotation of the end effector, (3, 3).
            size: Height and width of the image, px.
        """
        eye, target = (position + rotation @ point for point in (camera.eye, camera.target))
        view = pybullet.computeViewMatrix(eye.tolist(), target.tolist(), (rotation @ camera.up).tolist())
        self._show()
        return np.ascontiguousarray(self._image((view, _projection(camera)), size)[0])

    def _background(self, camera: Camera, size: int) -> _Background:
        key = (camera, size, *self._static_parts.values())
        if key not in self._backgrounds:
            if len(self._backgrounds) == _MAX_BACKGROUNDS:
                self._backgrounds.clear()
            self._show(moving=False)
            pixels, depths = self._image(camera, size)
            self._backgrounds[key] = _Background(np.ascontiguousarray(pixels), depths)
        return self._backgrounds[key]

    def _register_static_part(self, body: int, mesh: Mesh, position: ArrayLike) -> None:
        self._show()
        self._static_parts[body, _BASE] = (mesh, *np.asarray(position, dtype=np.float64).tolist())

    def _show(self, static: bool = True, moving: bool = True) -> None:
        """Shows or hides all static and all moving parts. The renderer skips fully transparent ones."""
        kinds = (self._static_parts, self._moving_parts)
        for parts, was_visible, is_visible in zip(kinds, self._shown, (static, moving), strict=True):
            if was_visible != is_visible:
                color = (1, 1, 1, float(is_visible))
                for body, link in parts:
                    pybullet.changeVisualShape(body, link, rgbaColor=color, physicsClientId=self._client)
        self._shown = static, moving

    def _image(self, camera: Camera | _Matrices, size: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Renders colors, (size, size, 3), and depths, (size, size), of the visible parts."""
        view, projection = camera_matrices(camera) if isinstance(camera, Camera) else camera
        _, _, pixels, depths, _ = pybullet.getCameraImage(
            size,
            size,
            view,
            projection,
            lightDirection=(0.3, 1.0, 1.8),
            lightColor=(1, 1, 1),
            lightAmbientCoeff=0.6,
            lightDiffuseCoeff=0.5,
            lightSpecularCoeff=0.05,
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._client,
        )
        # PyBullet returns tuples if it was built without NumPy.
        image = np.asarray(pixels, dtype=np.uint8).reshape(size, size, 4)
        return image[..., :3], np.asarray(depths, dtype=np.float32).reshape(size, size)


def _release(client: int, files: Path) -> None:
    """Disconnects the client of a simulation, and removes its files."""
    shutil.rmtree(files, ignore_errors=True)
    pybullet.disconnect(physicsClientId=client)


def _color_texture() -> Image.Image:
    """Draws a texture of all colors of 16 levels in each channel, 64 x 64 px."""
    code = np.arange(_COLOR_LEVELS**3)
    levels = np.stack(
        [code // _COLOR_LEVELS**2, code // _COLOR_LEVELS % _COLOR_LEVELS, code % _COLOR_LEVELS], axis=-1
    )
    pixels = (levels * 255 // (_COLOR_LEVELS - 1)).astype(np.uint8)
    return Image.fromarray(pixels.reshape(_TEXTURE_HEIGHT, _TEXTURE_WIDTH, 3))


def _texture_coordinates(colors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns coordinates, (N, 2) in 0..1, of the texture's colors that are nearest to `colors`, (N, 3)."""
    levels = np.rint(np.asarray(colors) * (_COLOR_LEVELS - 1)).astype(int)
    code = levels @ (_COLOR_LEVELS**2, _COLOR_LEVELS, 1)
    row, column = np.divmod(code, _TEXTURE_WIDTH)
    return np.stack([(column + 0.5) / _TEXTURE_WIDTH, 1 - (row + 0.5) / _TEXTURE_HEIGHT], axis=-1)


# At 254 kB each, thousands of random objects would take gigabytes in each process.
@functools.lru_cache(maxsize=1000)
def _visual_arrays(mesh: Mesh) -> tuple[list, list, list, list]:
    """Returns vertices, normals, texture coordinates and indices for PyBullet; faces share no vertices."""
    corners = mesh.faces.reshape(-1)
    uvs = np.repeat(_texture_coordinates(mesh.colors), 3, axis=0)
    return (
        mesh.vertices[corners].tolist(),
        mesh.normals[corners].tolist(),
        uvs.tolist(),
        list(range(len(corners))),
    )


def _obj_text(hulls: Sequence[NDArray[np.float64]]) -> str:
    """Formats convex hulls as groups of a Wavefront file; PyBullet uses the vertices of their faces."""
    lines = []
    first = 1
    for index, points in enumerate(hulls):
        lines.append(f"o hull{index}")
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points]
        lines += [f"f {first} {first + i} {first + i + 1}" for i in range(1, len(points) - 1)]
        first += len(points)
    return "\n".join(lines) + "\n"
