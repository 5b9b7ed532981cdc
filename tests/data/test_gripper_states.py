"""Which dimensions of the state are the gripper's, on recordings like those of common robots."""

import numpy as np
import pytest
import torch

from lerobot_deltaco.data.gripper_states import find_gripper_states, find_positions

LIBERO = ["x", "y", "z", "rx", "ry", "rz", "finger_1", "finger_2"]
SO101 = [
    f"{name}.pos" for name in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
]


def path(*points, frames):
    """Moves through points (n, dims), in some frames for each leg."""
    legs = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(points, points[1:], frames, strict=False)]
    return np.concatenate([*legs, points[-1:]])


def late(values, lag, speed):
    """Follows values after a lag, at a limited speed."""
    followed = [values[0]]
    for value in np.concatenate([np.full(lag, values[0]), values])[1 : len(values)]:
        followed.append(followed[-1] + np.clip(value - followed[-1], -speed, speed))
    return np.array(followed)


def concatenated(episodes):
    """Returns the states, commands and spans of episodes."""
    starts = np.cumsum([0, *(len(states) for states, _ in episodes)]).tolist()
    spans = [(start, end - 1) for start, end in zip(starts, starts[1:], strict=False)]
    states, commands = (np.concatenate(parts) for parts in zip(*episodes, strict=True))
    return torch.from_numpy(states).float(), torch.from_numpy(commands).float(), spans


def pick_and_place(n_episodes, lag=1, speed=0.1, noise=0.0):
    """Yields the hand's position, the gripper's binary command, its opening, and noise, of each episode.

    The hand is low when the gripper closes, and low again when it opens, above a box. Objects hold the
    gripper open by their width.
    """
    rng = np.random.default_rng(0)
    for _ in range(n_episodes):
        pick, place = rng.uniform(-0.2, 0.2, 2), rng.uniform(-0.02, 0.02, 2) + [0, 0.26]
        low = rng.uniform(0.01, 0.06)
        points = [(0, 0, 0.2), (*pick, 0.14), (*pick, low), (*pick, low), (*pick, 0.3), (*place, 0.3)]
        points += [(*place, 0.15), (*place, 0.15), (*place, 0.25)]
        frames = [20, 15, 8 + lag, 12, 20, 10, 6 + lag, 8]
        hand = path(*np.array(points), frames=frames)
        hand = hand + rng.normal(0, noise, hand.shape)
        times = np.cumsum([0, *frames])
        command = np.ones(len(hand))
        command[times[2] : times[6]] = -1
        opening = np.maximum(late(command, lag, 2 * speed) / 2 + 0.5, rng.uniform(0.2, 0.6))
        yield hand, command, opening, rng


def test_names_decide_what_levels_would_not():
    episodes = []
    for hand, command, opening, rng in pick_and_place(20):
        turn = np.tile(rng.normal(0, 0.5, 3), (len(hand), 1))
        fingers = np.stack([0.04 * opening, -0.04 * opening], axis=1)
        episodes.append((np.concatenate([hand, turn, fingers], axis=1), command))
    states, commands, spans = concatenated(episodes)
    # The arm is low when the gripper closes: a level does not tell them apart.
    assert abs(np.corrcoef(states[:, 2], commands)[0, 1]) > 0.15
    for names in (LIBERO, None):
        found = find_gripper_states(states, commands, spans, names)
        assert found.is_gripper.nonzero().flatten().tolist() == [6, 7]
        assert not found.doubts
    assert "by name" in find_gripper_states(states, commands, spans, LIBERO).reason


def test_an_arm_that_is_low_exactly_while_the_gripper_is_closed_is_not_the_gripper():
    """z follows the command closely in level, but moves on its own as well."""
    episodes = []
    for _, command, opening, rng in pick_and_place(20):
        closed = np.flatnonzero(command < 0)
        z = np.full(len(command), 0.2)
        z[closed[0] - 10 : closed[-1] + 10] = 0.02
        z = late(z + rng.normal(0, 0.002, len(z)), 0, 0.02)
        episodes.append((np.stack([z, 0.04 * opening], axis=1), command))
    states, commands, spans = concatenated(episodes)
    assert abs(np.corrcoef(states[:, 0], commands)[0, 1]) > 0.7
    assert find_gripper_states(states, commands, spans).is_gripper.tolist() == [False, True]


def test_a_leader_arm_moves_joints_and_gripper_at_any_time():
    """An SO-101: commands are positions, and the object holds the jaw open."""
    episodes = []
    for hand, command, _, rng in pick_and_place(20, noise=0.002):
        joints = np.concatenate([hand, hand[:, :2] ** 2], axis=1) * 300
        leader = late(50 + 45 * command, 0, 6) + rng.normal(0, 0.3, len(hand))
        width = rng.uniform(15, 30)
        jaw = np.maximum(late(leader, 2, 9), width)
        episodes.append((np.concatenate([joints, jaw[:, None]], axis=1), leader))
    states, commands, spans = concatenated(episodes)
    for names in ([*SO101, "gripper.pos"], None):
        found = find_gripper_states(states, commands, spans, names)
        assert found.is_gripper.tolist() == [False] * 5 + [True]
        assert not found.doubts


def test_an_opening_may_follow_many_frames_late():
    """As in Meta-World: six frames after the command, it begins to close slowly."""
    episodes = []
    for hand, command, opening, _ in pick_and_place(20, lag=6, speed=0.08):
        episodes.append((np.concatenate([hand, opening[:, None]], axis=1), command))
    states, commands, spans = concatenated(episodes)
    assert find_gripper_states(states, commands, spans).is_gripper.tolist() == [False] * 3 + [True]


def test_names_of_the_arm_are_never_silently_the_grippers():
    states, commands, spans = concatenated(
        [(opening[:, None], command) for _, command, opening, _ in pick_and_place(5)]
    )
    for name in ("z", "end_effector_z", "gripper_x", "joint_7", "wrist_roll.pos", "tcp.ry"):
        found = find_gripper_states(states, commands, spans, [name])
        assert not found.is_gripper.any()
        assert f"`{name}` follows the gripper's commands" in found.doubts[0]
    for name in ("gripper_open", "left_gripper/position", "panda_finger_joint1", "Jaw"):
        found = find_gripper_states(states, commands, spans, [name])
        assert found.is_gripper.all()
        assert not found.doubts
        still = find_gripper_states(torch.zeros_like(states), commands, spans, [name])
        assert "does not follow its commands" in still.doubts[0]
    assert find_gripper_states(states, commands, spans, ["motor_7"]).is_gripper.all()


def test_a_state_may_follow_with_either_sign_and_any_scale():
    generator = torch.Generator().manual_seed(0)
    gripper = torch.randn(60, generator=generator).sign()
    arm = torch.randn(60, generator=generator)
    opening = torch.cat([gripper.new_ones(1), 0.02 + 0.5 * gripper[:-1]])
    late = torch.cat([gripper.new_ones(3), gripper[:-3]])
    states = torch.stack([arm, opening, torch.full((60,), 7.0), -opening, late], dim=1)
    found = find_gripper_states(states, gripper, [(0, 29), (30, 59)])
    assert found.is_gripper.tolist() == [False, True, False, True, True]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["x", "y", "z", "rx", "ry", "rz", "finger_1", "finger_2"], [0, 1, 2]),
        (["ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz", "ee.gripper_pos"], [0, 1, 2]),
        (["joint.1", "eef.pos.x", "eef.pos.y", "eef.pos.z", "eef.quat.x", "eef.quat.y"], [1, 2, 3]),
        (["left.x", "left.y", "left.z", "right.x", "right.y", "right.z"], None),
        (["shoulder_pan.pos", "elbow_flex.pos", "gripper.pos"], None),
        ([], None),
    ],
)
def test_positions_are_found_by_name(names, expected):
    assert find_positions(names) == expected
