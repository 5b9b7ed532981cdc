"""Replaying demonstrated trajectories at other locations, on robots of a few lines."""

import numpy as np
import pytest
import torch

from lerobot_deltaco.data.grasps import Grasp
from lerobot_deltaco.policies.geometry.replay import Trajectory, TrajectoryReplay

N_DIMS, GRIPPER = 3, 3


class Robot:
    """A point in space, that is moved by displacements, or by targets that it approaches slowly."""

    def __init__(self, kind, start):
        self.kind, self.position, self.velocity, self.opening = kind, start.copy(), np.zeros(N_DIMS), 1.0

    @property
    def state(self):
        # With the velocity and with numbers that follow from the position, as joints beside an end effector.
        return np.r_[self.velocity, 0.5 * self.position**2, self.position, self.opening]

    def step(self, action):
        wanted = 0.1 * np.clip(action[:N_DIMS], -1, 1)
        if self.kind == "targets":
            wanted = 0.4 * (action[:N_DIMS] - self.position)
        self.velocity = wanted
        self.position = self.position + wanted
        self.opening = action[GRIPPER]


def controller(robot, goal, opening):
    """Returns an action towards a goal, at most 0.1 a step."""
    step = np.clip(goal - robot.position, -0.1, 0.1)
    motion = robot.position + step / 0.4 if robot.kind == "targets" else step / 0.1
    return np.r_[motion, opening]


def demonstrate(kind, start, pick, place):
    """Returns states and actions of an episode: above the object, down, and over to the place."""
    robot, states, actions = Robot(kind, start), [], []
    above = np.array([0, 0, 0.3])
    for goal, opening in ((pick + above, 1), (pick, 1), (pick, 0), (pick + above, 0), (place, 0), (place, 1)):
        for step in range(40):
            if np.abs(robot.position - goal).max() < 1e-3 and step > 2:
                break
            states.append(robot.state)
            actions.append(controller(robot, goal, opening))
            robot.step(actions[-1])
    closed = np.flatnonzero(np.array(actions)[:, GRIPPER] == 0)
    grasp = Grasp(closed[0] - 1, closed[0] + 1, closed[-1], closed[-1] + 1)
    states, actions = (torch.from_numpy(np.array(each)).float() for each in (states, actions))
    return Trajectory(states, actions, grasp, states[[grasp.grasp, grasp.release]])


def draw(rng):
    start, pick, place = rng.uniform(-0.5, 0.5, (3, N_DIMS))
    return start, pick * [1, 1, 0.1], place


@pytest.fixture(params=["displacements", "targets"])
def fitted(request):
    """Demonstrations of a robot, and a replay that knows how its actions move it."""
    rng = np.random.default_rng(0)
    moves = [draw(rng) for _ in range(20)]
    demonstrations = [demonstrate(request.param, *move) for move in moves]
    replay = TrajectoryReplay(10, 4)
    is_arm = torch.arange(10) < 9
    replay.fit([(each.states, each.actions) for each in demonstrations], is_arm, GRIPPER)
    return request.param, moves, demonstrations, replay


def test_only_positions_are_followed(fitted):
    _, _, _, replay = fitted
    assert replay.is_arm.nonzero().flatten().tolist() == [6, 7, 8]
    assert not replay.displacement_gain[:, GRIPPER].any()


def test_the_gripper_closes_and_opens_at_the_new_locations(fitted):
    kind, moves, demonstrations, replay = fitted
    rng = np.random.default_rng(1)
    news = [draw(rng) for _ in range(8)]
    robots = [Robot(kind, start) for start, _, _ in news]
    shown = demonstrations[: len(news)]
    displacements = torch.zeros(len(news), 2, 10)
    for n, ((_, pick, place), (_, shown_pick, shown_place)) in enumerate(zip(news, moves, strict=False)):
        displacements[n, :, 6:9] = torch.from_numpy(np.stack([pick - shown_pick, place - shown_place]))

    def states():
        return torch.from_numpy(np.stack([robot.state for robot in robots])).float()

    reference = replay.start(shown, states(), displacements)
    closed, opened = [None] * len(news), [None] * len(news)
    for _ in range(200):
        before = [robot.opening for robot in robots]
        reference, actions = replay.follow(reference, states())
        for n, (robot, action) in enumerate(zip(robots, actions.numpy(), strict=True)):
            if before[n] > 0.5 > action[GRIPPER] and closed[n] is None:
                closed[n] = robot.position
            if before[n] < 0.5 < action[GRIPPER]:
                opened[n] = robot.position
            robot.step(action)
    picks, places = (np.stack([new[part] for new in news]) for part in (1, 2))
    assert np.abs(np.stack(closed) - picks).max() < 0.01
    assert np.abs(np.stack(opened) - places).max() < 0.02


def test_a_demonstration_is_repeated_exactly_where_nothing_has_moved(fitted):
    kind, moves, (shown, *_), replay = fitted
    robot = Robot(kind, moves[0][0])
    reference = replay.start([shown], torch.from_numpy(robot.state).float()[None], torch.zeros(1, 2, 10))
    for state, action in zip(shown.states[1:], shown.actions[1:], strict=True):
        reference, replayed = replay.follow(reference, state[None])
        torch.testing.assert_close(replayed[0].clamp(-1, 1), action.clamp(-1, 1), atol=0.02, rtol=0)


def test_a_demonstration_is_repeated_where_it_goes_farther_than_the_training(fitted):
    kind, moves, _, replay = fitted
    start, pick, place = (4 * each for each in moves[0])
    shown, robot = demonstrate(kind, start, pick, place), Robot(kind, start)
    assert kind == "displacements" or shown.actions.abs().max() > 1.2
    reference = replay.start([shown], torch.from_numpy(robot.state).float()[None], torch.zeros(1, 2, 10))
    closed_at = None
    for _ in range(2 * len(shown.states)):
        reference, action = replay.follow(reference, torch.from_numpy(robot.state).float()[None])
        robot.step(action[0].numpy())
        if closed_at is None and action[0, GRIPPER] < 0.5:
            closed_at = robot.position.copy()
    assert np.abs(closed_at - pick).max() < 0.02
    assert np.abs(robot.position - place).max() < 0.02


def test_an_action_stays_within_those_of_the_training_and_of_the_demonstration(fitted):
    _, moves, (shown, *_), replay = fitted
    far = torch.zeros(1, 2, 10)
    far[..., 6:9] = 5
    reference = replay.start([shown], shown.states[:1], far)
    for _ in range(60):
        reference, action = replay.follow(reference, shown.states[:1])
        assert (action.abs() <= shown.actions.abs().amax().clamp_min(1)).all()


def test_pauses_are_not_repeated_but_the_gripper_gets_its_time(fitted):
    _, _, demonstrations, replay = fitted
    shown = demonstrations[0]
    opening = shown.actions[:, GRIPPER]
    (closing,) = (opening[1:] < opening[:-1]).nonzero().flatten().tolist()
    # It hesitates on the way, and waits after it has closed.
    repeats = torch.ones(len(opening), dtype=torch.int64)
    hesitates = closing // 2
    repeats[hesitates], repeats[closing + 2] = 30, 7
    states, slow_opening = (each.repeat_interleave(repeats, dim=0) for each in (shown.states, opening))
    # An arm that gives way a little while the fingers close has not left.
    little = 0.1 * replay.usual_step / replay._distance(torch.eye(10)[8])
    waiting = torch.arange(len(opening)).repeat_interleave(repeats) == closing + 2
    states[waiting.nonzero().flatten()[1:], 8] -= little
    kept = replay._moving(states, slow_opening)
    original = torch.arange(len(opening)).repeat_interleave(repeats)[kept].tolist()
    assert original.count(hesitates) == 1
    assert original.count(closing + 2) >= 7
    assert set(range(closing)) - set(original) <= {0, 1}
    assert kept[0] == 0
    assert kept[-1] == len(states) - 1


def test_a_robot_whose_state_does_not_follow_its_actions_cannot_be_replayed():
    generator = torch.Generator().manual_seed(0)
    trajectories = [
        (torch.randn(50, 10, generator=generator), torch.randn(50, 4, generator=generator)) for _ in range(20)
    ]
    replay = TrajectoryReplay(10, 4)
    assert not replay.is_blind
    replay.fit(trajectories, torch.arange(10) < 9, GRIPPER)
    assert replay.is_blind
    replay.action_scale.fill_(1)
    assert replay.trajectory(None, None) == "no dimension of the robot's state follows its actions"
