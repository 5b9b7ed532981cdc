"""The arm's kinematics are the published ones, and the simulated arm follows its commands."""

import numpy as np
import pybullet
import pytest

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import Stage, expert_episode
from gym_deltaco.robot import kinematics as kin
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.sim.simulation import Simulation

# Limits of the end effector (m) and the published joint limits (degrees)
LOW, HIGH = np.array([0.4, -0.2, -0.34]), np.array([0.8, 0.4, -0.1])
SHOULDER_LIMITS, ELBOW_LIMITS, WRIST_LIMITS = (-108, 114), (-92, 123), (-123, 100)
SHOULDER = np.array([0.6, 0.0, -0.4 + 0.0716 + 0.03865])  # m
HAND = 0.065 + 0.043  # m, from the wrist down to the end effector
REACH = np.hypot(0.04975, 0.25) + 0.175 + 0.075  # m, from the shoulder to the wrist of the stretched arm
END_EFFECTOR_LINK, LEFT_FINGER, RIGHT_FINGER = 5, 6, 7
OPEN, CLOSED = 1.0, -1.0


def grid_points(low_y):
    """Returns a grid over the limits of the end effector, (P, 3), and whether the arm reaches the points."""
    axes = (np.linspace(0.4, 0.8, 9), np.linspace(low_y, 0.4, 9), np.linspace(-0.34, -0.1, 7))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    wrists = points + [0, 0, HAND]
    from_axis = np.hypot(*(points - SHOULDER)[:, :2].T)
    return points, (np.linalg.norm(wrists - SHOULDER, axis=1) < 0.998 * REACH) & (from_axis > 0.031)


def rotation_about(axis, angle):
    """Returns a rotation matrix, by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def published_forward(joints):
    """Computes the pose of the end effector along the published chain of joints."""
    x, y, z = np.eye(3)
    # Origin, whether rolled by pi, and axis of each joint
    chain = [((0, 0, 0.0716), False, z), ((0, 0, 0.03865), False, y), ((0.04975, 0, 0.25), True, y)]
    chain += [((0.175, 0, 0), False, x), ((0.075, 0, 0), False, y), ((0.065, 0, 0), True, x)]
    pose = np.eye(4)
    pose[:3, 3] = [0.6, 0, -0.4]
    for (origin, is_rolled, axis), angle in zip(chain, joints, strict=True):
        joint = np.eye(4)
        joint[:3, 3] = origin
        joint[:3, :3] = rotation_about(x, np.pi if is_rolled else 0) @ rotation_about(axis, angle)
        pose = pose @ joint
    return pose[:3, 3] + pose[:3, 0] * 0.043, pose[:3, :3]


def test_forward_follows_the_published_chain():
    for joints in np.random.default_rng(0).uniform(-2, 2, (50, 6)):
        for ours, published in zip(kin.forward(joints), published_forward(joints), strict=True):
            np.testing.assert_allclose(ours, published, atol=1e-12)


def test_inverse_inverts_forward_within_reach():
    points, is_reached = grid_points(low_y=-0.2)
    assert is_reached.mean() > 0.9
    for point in points[is_reached]:
        position, rotation = kin.forward(kin.inverse(point))
        np.testing.assert_allclose(position, point, atol=1e-9)
        np.testing.assert_allclose(rotation[:, 0], [0, 0, -1], atol=1e-9)  # the gripper points down
        np.testing.assert_allclose(np.abs(rotation[:, 1]), [1, 0, 0], atol=1e-9)  # fingers move along x


def test_joints_stay_within_the_published_limits_in_front_of_the_base():
    points, is_reached = grid_points(low_y=0.0)
    joints = np.degrees([kin.inverse(point) for point in points[is_reached]])
    for column, (low, high) in ((1, SHOULDER_LIMITS), (2, ELBOW_LIMITS), (4, WRIST_LIMITS)):
        assert low <= joints[:, column].min() <= joints[:, column].max() <= high
    assert np.abs(joints[:, [0, 5]]).max() <= 180 + 1e-9
    assert (joints[:, 3] == 0).all()


def test_joints_do_not_jump_along_a_path():
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


def test_position_out_of_reach_is_moved_towards_the_shoulder():
    for point in ((0.4, 0.4, -0.1), (0.8, 0.4, -0.12), (0.6, 0.9, -0.3), (3, 4, 5)):
        wrist = np.array(point) + [0, 0, HAND] - SHOULDER
        position, rotation = kin.forward(kin.inverse(point))
        reached = position + [0, 0, HAND] - SHOULDER
        np.testing.assert_allclose(np.cross(reached, wrist), 0, atol=1e-9)
        assert reached @ wrist > 0
        assert 0.995 * REACH < np.linalg.norm(reached) <= REACH
        np.testing.assert_allclose(rotation[:, 0], [0, 0, -1], atol=1e-9)
    # On the axis of the waist, it keeps the waist.
    joints = kin.inverse([0.6, 0.0, -0.2])
    assert joints[0] == kin.REST_JOINTS[0]
    position = kin.forward(joints)[0]
    assert position[2] == pytest.approx(-0.2)
    assert np.linalg.norm(position[:2] - [0.6, 0]) < 0.031


@pytest.fixture(scope="module")
def shared_env():
    env = PickPlaceEnv(4, SceneConfig(image_size=8, episode_length=60))
    yield env
    env.close()


@pytest.fixture
def env(shared_env):
    shared_env.reset(seed=0)
    return shared_env


def link_pose(env, link):
    """Returns position and rotation of a link's frame, from PyBullet."""
    client = env.scene._simulation._client
    state = pybullet.getLinkState(
        env.scene.arm.body, link, computeForwardKinematics=1, physicsClientId=client
    )
    return np.array(state[4]), np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)


def finger_positions(env):
    """Returns the positions of the left and the right finger, m."""
    return env.scene._simulation.joint_positions(env.scene.arm.body, [LEFT_FINGER, RIGHT_FINGER])


def command(env, goal, gripper=OPEN):
    """Takes one step towards a position, and returns its target."""
    arm = env.scene.arm
    motion = np.clip((np.asarray(goal) - arm.position) / 0.1, -1, 1)
    goal = np.clip(arm.position + 0.1 * motion, LOW, HIGH)
    env.step(np.array([*motion, gripper]))
    return goal


def move(env, goal):
    for _ in range(8):
        command(env, goal)


def test_simulated_links_are_where_the_kinematics_put_them(env):
    rng = np.random.default_rng(0)
    np.testing.assert_allclose(env.scene.arm.joints, [1.57, -0.6, -0.6, 0, -1.57, 0], atol=0.002)
    for _ in range(20):
        command(env, rng.uniform([0.4, 0.05, -0.22], [0.8, 0.35, -0.1]), rng.choice([OPEN, CLOSED]))
        arm = env.scene.arm
        position, rotation = published_forward(arm.joints)
        link_position, link_rotation = link_pose(env, END_EFFECTOR_LINK)
        np.testing.assert_allclose(link_rotation, rotation, atol=1e-5)
        np.testing.assert_allclose(link_position + link_rotation @ [0.043, 0, 0], position, atol=1e-5)
        np.testing.assert_allclose(arm.position, position, atol=1e-5)
        np.testing.assert_allclose(rotation[:, 0], [0, 0, -1], atol=0.01)
        np.testing.assert_allclose(np.abs(rotation[:, 1]), [1, 0, 0], atol=0.01)
        for finger, distance in zip((LEFT_FINGER, RIGHT_FINGER), finger_positions(env), strict=True):
            finger_position = position + rotation @ [0, distance, 0]
            np.testing.assert_allclose(link_pose(env, finger)[0], finger_position, atol=1e-5)


def test_arm_tracks_commands_and_holds_its_position(env):
    rng = np.random.default_rng(1)
    for _ in range(40):
        gripper = rng.choice([OPEN, CLOSED], p=[0.8, 0.2])
        goal = command(env, rng.uniform([0.4, 0.05, -0.22], [0.8, 0.35, -0.1]), gripper)
        assert np.abs(env.scene.arm.position - goal).max() < 0.002
    for _ in range(20):
        env.step(np.array([0, 0, 0, OPEN]))
    assert np.abs(env.scene.arm.position - goal).max() < 0.002


def test_end_effector_stays_within_its_limits(env):
    for goal in ((0.0, 0.2, -0.2), (2.0, 0.2, -0.2), (0.6, 2.0, -0.2), (0.6, 0.2, 2.0), (0.42, -1.0, -0.15)):
        limited = np.clip(goal, LOW, HIGH)
        # The table is free behind the base, the way around it is not.
        move(env, (limited[0], max(limited[1], 0.05), limited[2]))
        for _ in range(6):
            command(env, goal)
        np.testing.assert_allclose(env.scene.arm.position, limited, atol=0.002)
        move(env, (0.6, 0.15, -0.15))


def test_gripper_obeys_an_absolute_command_with_threshold_0(env):
    for gripper, is_open in ((0.0, False), (1e-3, True), (-1e-3, False), (-1.0, False), (1.0, True)):
        env.step(np.array([0, 0, 0, gripper]))
        left, right = finger_positions(env)
        assert env.scene.arm.is_open == is_open
        if is_open:
            np.testing.assert_allclose([left, right], [0.037, -0.037], atol=0.001)
        else:
            assert 0 <= left - right <= 0.005


def test_fingers_stay_symmetric_and_within_their_stops(env):
    gaps = []
    # In the last three episodes, an open finger comes down on the edge of an object.
    for task_id, seed in ((4, 0), (4, 1), (4, 2), (29, 47), (71, 53), (127, 61)):
        for step in expert_episode(env, task_id, seed):
            left, right = finger_positions(env)
            assert -0.04 <= right <= 0 <= left <= 0.04
            if step.stage is Stage.CARRY and task_id == 4:
                assert left == pytest.approx(-right, abs=0.002)
                gaps.append(left - right)
    assert 0.006 < min(gaps) <= max(gaps) < 0.074, "an object is held"


def test_physics_is_as_specified(env, spy):
    parameters = pybullet.getPhysicsEngineParameters(physicsClientId=env.scene._simulation._client)
    assert parameters["fixedTimeStep"] == 1 / 240
    assert [parameters[f"gravityAcceleration{axis}"] for axis in "XYZ"] == [0, 0, -10]
    times, counts = [], []
    spy(Simulation, "step", times.append)
    for gripper in (OPEN, OPEN, CLOSED, CLOSED, OPEN, OPEN):
        times.clear()
        env.step(np.array([0.1, 0, 0, gripper]))
        counts.append(len(times))
    assert counts == [10, 10, 75, 10, 75, 10]
