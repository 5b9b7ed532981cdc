"""The arm's kinematics are the published ones, and the simulated arm follows its commands."""

import numpy as np
import pybullet
import pytest

from gym_deltaco import kinematics as kin
from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import Stage, expert_episode
from gym_deltaco.simulation import Simulation

# Limits of the end effector (m) and the published joint limits (degrees).
LOW, HIGH = np.array([0.4, -0.2, -0.34]), np.array([0.8, 0.4, -0.1])
SHOULDER_LIMITS, ELBOW_LIMITS, WRIST_LIMITS = (-108, 114), (-92, 123), (-123, 100)
# The shoulder's joint: the base at (.6, 0, -.4), the waist .0716 above it, the shoulder .03865 above that.
SHOULDER = np.array([0.6, 0.0, -0.28975])
HAND = 0.065 + 0.043  # m, from the wrist to the end effector, straight down
REACH = np.hypot(0.04975, 0.25) + 0.175 + 0.075  # m, of the stretched arm's wrist from the shoulder
END_EFFECTOR_LINK, LEFT_FINGER, RIGHT_FINGER = 5, 6, 7
OPEN, CLOSED = 1.0, -1.0


def box_points(low_y):
    """A grid over the limits of the end effector, (P, 3), and whether the arm reaches each point, (P,)."""
    axes = (np.linspace(0.4, 0.8, 9), np.linspace(low_y, 0.4, 9), np.linspace(-0.34, -0.1, 7))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    wrists = points + [0, 0, HAND]
    from_axis = np.hypot(*(points - SHOULDER)[:, :2].T)
    return points, (np.linalg.norm(wrists - SHOULDER, axis=1) < 0.998 * REACH) & (from_axis > 0.031)


def rotation_about(axis, angle):
    """Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def published_forward(joints):
    """The chain of the specification, with 4 x 4 transforms: (origin, rolled by pi, axis) of each joint."""
    x, y, z = np.eye(3)
    chain = [
        ((0, 0, 0.0716), False, z),
        ((0, 0, 0.03865), False, y),
        ((0.04975, 0, 0.25), True, y),
        ((0.175, 0, 0), False, x),
        ((0.075, 0, 0), False, y),
        ((0.065, 0, 0), True, x),
    ]
    pose = np.eye(4)
    pose[:3, 3] = [0.6, 0, -0.4]
    for (origin, is_rolled, axis), angle in zip(chain, joints, strict=True):
        joint = np.eye(4)
        joint[:3, 3] = origin
        joint[:3, :3] = rotation_about(x, np.pi if is_rolled else 0) @ rotation_about(axis, angle)
        pose = pose @ joint
    return pose[:3, 3] + pose[:3, 0] * 0.043, pose[:3, :3]


# Kinematics


def test_the_rest_pose_is_where_the_published_origins_put_it():
    joints = [1.57, -0.6, -0.6, 0, -1.57, 0]
    np.testing.assert_array_equal(kin.REST_JOINTS, joints)
    position, rotation = kin.forward(joints)
    # By hand: the upper arm leans back by .6 rad, the forearm is level, the hand hangs down.
    out = 0.04975 * np.cos(0.6) - 0.25 * np.sin(0.6) + 0.25
    up = 0.04975 * np.sin(0.6) + 0.25 * np.cos(0.6) - HAND
    np.testing.assert_allclose(position, SHOULDER + [0, out, up], atol=2e-4)
    np.testing.assert_allclose(position, [0.6001, 0.1500, -0.1633], atol=1e-4)
    np.testing.assert_allclose(rotation[:, 0], [0, 0, -1], atol=1e-3)
    np.testing.assert_allclose(np.abs(rotation[:, 1]), [1, 0, 0], atol=1e-3)


def test_forward_follows_the_published_chain():
    for joints in np.random.default_rng(0).uniform(-2, 2, (50, 6)):
        for ours, published in zip(kin.forward(joints), published_forward(joints), strict=True):
            np.testing.assert_allclose(ours, published, atol=1e-12)


def test_inverse_is_the_inverse_of_forward_wherever_the_arm_reaches():
    points, is_reached = box_points(low_y=-0.2)
    assert is_reached.mean() > 0.9
    for point in points[is_reached]:
        position, rotation = kin.forward(kin.inverse(point))
        np.testing.assert_allclose(position, point, atol=1e-9)
        np.testing.assert_allclose(rotation[:, 0], [0, 0, -1], atol=1e-9)  # the gripper points down
        np.testing.assert_allclose(np.abs(rotation[:, 1]), [1, 0, 0], atol=1e-9)  # the fingers move along x


def test_joints_stay_within_the_published_limits_in_front_of_the_base():
    points, is_reached = box_points(low_y=0.0)
    joints = np.degrees([kin.inverse(point) for point in points[is_reached]])
    for column, (low, high) in ((1, SHOULDER_LIMITS), (2, ELBOW_LIMITS), (4, WRIST_LIMITS)):
        assert joints[:, column].min() >= low
        assert joints[:, column].max() <= high
    assert np.abs(joints[:, [0, 5]]).max() <= 180 + 1e-9
    np.testing.assert_array_equal(joints[:, 3], 0)  # the forearm never rolls


def test_joints_do_not_jump_on_the_way():
    turn = np.linspace(0, 2 * np.pi, 200)
    circle = SHOULDER + np.stack([0.15 * np.cos(turn), 0.15 * np.sin(turn), np.full(200, 0.1)], axis=-1)
    across = np.linspace([0.42, 0.3, -0.2], [0.78, 0.1, -0.3], 100)
    for path in (circle, across):
        joints = kin.inverse(path[0])
        for point in path[1:]:
            following = kin.inverse(point, near=joints)
            assert np.abs(following - joints).max() < 0.1
            np.testing.assert_allclose(kin.forward(following)[0], point, atol=1e-9)
            joints = following


@pytest.mark.parametrize(
    "point", [(0.4, 0.4, -0.1), (0.8, 0.4, -0.1), (0.8, 0.4, -0.12), (0.6, 0.9, -0.3), (3, 4, 5)]
)
def test_a_point_out_of_reach_is_replaced_by_the_nearest_one_towards_the_shoulder(point):
    wrist = np.array(point) + [0, 0, HAND] - SHOULDER
    assert np.linalg.norm(wrist) > REACH
    position, rotation = kin.forward(kin.inverse(point))
    reached = position + [0, 0, HAND] - SHOULDER
    np.testing.assert_allclose(np.cross(reached, wrist), 0, atol=1e-9)
    assert reached @ wrist > 0
    assert 0.995 * REACH < np.linalg.norm(reached) <= REACH
    np.testing.assert_allclose(rotation[:, 0], [0, 0, -1], atol=1e-9)


def test_a_point_on_the_axis_of_the_waist_has_finite_joints_that_do_not_turn():
    joints = kin.inverse([0.6, 0.0, -0.2])
    assert np.isfinite(joints).all()
    assert joints[0] == kin.REST_JOINTS[0]
    position = kin.forward(joints)[0]
    assert position[2] == pytest.approx(-0.2)
    assert np.linalg.norm(position[:2] - [0.6, 0]) < 0.031


# In the simulation


@pytest.fixture(scope="module")
def shared_env():
    env = PickPlaceEnv(4, image_size=8)
    yield env
    env.close()


@pytest.fixture
def env(shared_env):
    shared_env.reset(seed=0)
    return shared_env


def link_pose(env, link):
    """Position and rotation of a link's frame, from PyBullet."""
    simulation = env.unwrapped.scene._simulation
    state = pybullet.getLinkState(
        env.scene.arm.body, link, computeForwardKinematics=1, physicsClientId=simulation._client
    )
    return np.array(state[4]), np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)


def finger_positions(env):
    """Of the left and the right finger along their axis, m, from PyBullet."""
    client = env.scene._simulation._client
    return [
        pybullet.getJointState(env.scene.arm.body, finger, physicsClientId=client)[0]
        for finger in (LEFT_FINGER, RIGHT_FINGER)
    ]


def command(env, goal, gripper=OPEN):
    """One step towards a position, (3,), m. Returns what was asked for, clipped to the limits."""
    arm = env.scene.arm
    motion = np.clip((np.asarray(goal) - arm.position) / 0.1, -1, 1)
    goal = np.clip(arm.position + 0.1 * motion, LOW, HIGH)
    env.step(np.array([*motion, gripper]))
    return goal


def move(env, goal, gripper=OPEN, n_steps=8):
    for _ in range(n_steps):
        command(env, goal, gripper)


def test_the_simulated_links_are_where_the_kinematics_put_them(env):
    rng = np.random.default_rng(0)
    for _ in range(20):
        command(env, rng.uniform([0.4, 0.05, -0.22], [0.8, 0.35, -0.1]), rng.choice([OPEN, CLOSED]))
        arm = env.scene.arm
        joints = [
            pybullet.getJointState(arm.body, joint, physicsClientId=env.scene._simulation._client)[0]
            for joint in range(6)
        ]
        np.testing.assert_array_equal(arm.joints, joints)
        position, rotation = published_forward(joints)
        link_position, link_rotation = link_pose(env, END_EFFECTOR_LINK)
        np.testing.assert_allclose(link_rotation, rotation, atol=1e-5)
        np.testing.assert_allclose(link_position + link_rotation @ [0.043, 0, 0], position, atol=1e-5)
        np.testing.assert_allclose(arm.position, position, atol=1e-5)
        for finger, distance in zip((LEFT_FINGER, RIGHT_FINGER), finger_positions(env), strict=True):
            finger_position = position + rotation @ [0, distance, 0]
            np.testing.assert_allclose(link_pose(env, finger)[0], finger_position, atol=1e-5)


def test_an_episode_starts_at_rest_with_the_gripper_open(env):
    np.testing.assert_allclose(env.scene.arm.joints, [1.57, -0.6, -0.6, 0, -1.57, 0], atol=0.002)
    assert env.scene.arm.is_open
    np.testing.assert_allclose(finger_positions(env), [0.037, -0.037], atol=0.001)


def test_the_arm_tracks_commands_above_the_objects(env):
    rng = np.random.default_rng(1)
    for _ in range(60):
        goal = command(
            env, rng.uniform([0.4, 0.05, -0.22], [0.8, 0.35, -0.1]), rng.choice([OPEN, CLOSED], p=[0.8, 0.2])
        )
        assert np.abs(env.scene.arm.position - goal).max() < 0.002


def test_the_arm_holds_its_position_for_an_episode(env):
    start = env.scene.arm.position
    for _ in range(30):
        env.step(np.array([0, 0, 0, OPEN]))
    assert np.abs(env.scene.arm.position - start).max() < 0.002


def test_the_gripper_keeps_pointing_down_with_its_fingers_along_x(env):
    rng = np.random.default_rng(2)
    for _ in range(20):
        command(env, rng.uniform([0.4, 0.05, -0.22], [0.8, 0.35, -0.1]))
        _, rotation = link_pose(env, END_EFFECTOR_LINK)
        np.testing.assert_allclose(rotation[:, 0], [0, 0, -1], atol=0.01)
        np.testing.assert_allclose(np.abs(rotation[:, 1]), [1, 0, 0], atol=0.01)


@pytest.mark.parametrize(
    ("goal", "limited"),
    [
        ((0.0, 0.2, -0.2), (0.4, 0.2, -0.2)),
        ((2.0, 0.2, -0.2), (0.8, 0.2, -0.2)),
        ((0.6, 2.0, -0.2), (0.6, 0.4, -0.2)),
        ((0.6, 0.2, 2.0), (0.6, 0.2, -0.1)),
    ],
)
def test_the_end_effector_stays_within_its_limits(env, goal, limited):
    move(env, limited)
    for _ in range(3):
        command(env, goal)
        np.testing.assert_allclose(env.scene.arm.position, limited, atol=0.002)


def test_the_end_effector_reaches_the_back_of_its_limits(env):
    # Behind and beside the base, where neither the tray nor its walls are in the way: only the table.
    for corner in ((0.42, -0.19), (0.78, -0.19)):
        move(env, (corner[0], 0.05, -0.15))
        for _ in range(6):
            command(env, (corner[0], -1.0, -0.15))
        assert env.scene.arm.position[1] == pytest.approx(-0.2, abs=0.002)
        move(env, (corner[0], 0.1, -0.15))


@pytest.mark.parametrize(("y", "floor"), [(0.15, -0.37), (0.05, -0.375)], ids=["tray", "table"])
def test_the_fingertips_stop_at_the_floor_before_the_bottom_of_the_limits(env, y, floor):
    move(env, (0.6, y, -0.2))
    for _ in range(8):
        command(env, (0.6, y, -1.0))
    goal, _ = kin.forward(env.scene.arm._joint_targets)
    assert goal[2] == pytest.approx(-0.34)
    assert env.scene.arm.position[2] == pytest.approx(floor + 0.05, abs=0.005)


def test_an_action_of_1_moves_the_end_effector_by_10_cm(env):
    for axis, sign in ((0, 1), (0, -1), (1, 1), (2, -1)):
        env.reset(seed=0)
        start = env.scene.arm.position
        action = np.array([0.0, 0.0, 0.0, OPEN])
        action[axis] = sign
        if axis == 2:
            action[axis] *= 0.5  # not as far as the objects
        env.step(action)
        moved = env.scene.arm.position - start
        np.testing.assert_allclose(moved, 0.1 * action[:3], atol=0.002)


def test_the_gripper_opens_and_closes_as_published(env):
    for gripper in (CLOSED, OPEN, CLOSED, OPEN):
        env.step(np.array([0, 0, 0, gripper]))
        left, right = finger_positions(env)
        assert env.scene.arm.is_open == (gripper == OPEN)
        if gripper == OPEN:
            np.testing.assert_allclose([left, right], [0.037, -0.037], atol=0.001)
        else:
            assert 0 <= left - right <= 0.005


@pytest.mark.parametrize(("gripper", "is_open"), [(1e-3, True), (1.0, True), (0.0, False), (-1e-3, False)])
def test_the_gripper_obeys_an_absolute_command_with_threshold_0(env, gripper, is_open):
    for _ in range(2):
        env.step(np.array([0, 0, 0, gripper]))
        assert env.scene.arm.is_open == is_open


@pytest.mark.parametrize("seed", range(5))
def test_the_fingers_stay_symmetric_around_what_they_carry(env, seed):
    gaps = []
    for step in expert_episode(env, task_id=4, seed=seed):
        left, right = finger_positions(env)
        if step.stage is Stage.CARRY:
            assert left == pytest.approx(-right, abs=0.002)
            gaps.append(left - right)
    # Something was held: the fingers neither met nor stayed open.
    assert gaps
    assert min(gaps) > 0.006
    assert max(gaps) < 0.074


# Episodes in which an open finger came down on the edge of an object.
@pytest.mark.parametrize(("task_id", "seed"), [(29, 47), (71, 53), (127, 61)])
def test_the_fingers_never_open_wider_than_their_stops(env, task_id, seed):
    for _ in expert_episode(env, task_id, seed):
        left, right = finger_positions(env)
        assert 0 <= left <= 0.04
        assert -0.04 <= right <= 0


def test_a_control_step_is_10_physics_steps_and_75_when_the_gripper_changes(env, monkeypatch):
    n_steps = 0
    advance = Simulation.step

    def counting(simulation):
        nonlocal n_steps
        n_steps += 1
        advance(simulation)

    monkeypatch.setattr(Simulation, "step", counting)
    counts = []
    for gripper in (OPEN, OPEN, CLOSED, CLOSED, OPEN, OPEN):
        n_steps = 0
        env.step(np.array([0.1, 0, 0, gripper]))
        counts.append(n_steps)
    assert counts == [10, 10, 75, 10, 75, 10]


def test_the_physics_are_as_specified(env):
    parameters = pybullet.getPhysicsEngineParameters(physicsClientId=env.scene._simulation._client)
    assert parameters["fixedTimeStep"] == 1 / 240
    assert (parameters["gravityAccelerationX"], parameters["gravityAccelerationY"]) == (0, 0)
    assert parameters["gravityAccelerationZ"] == -10
