"""Grasps: when the gripper closes around an object that the arm then carries, and when it opens again."""

import numpy as np
import pytest
import torch

from lerobot_deltaco.data.grasps import find_grasp_states, find_grasps, warn_of_missing


def grasp_frames(gripper, spans):
    """Returns the frames of the grasp and of the release of each episode; None where there is no grasp."""
    return [
        None if isinstance(found, str) else (found.grasp, found.release)
        for found in find_grasps(gripper, spans)
    ]


def test_last_grasp_that_is_released_counts():
    states = torch.tensor([0, 1, 2, 3, 4, 5, 4.5, 4, 0, 0, 0, 0, 0, 0])[:, None]
    gripper = torch.tensor([1, -1, 1, 1, -1, -1, 1, 1, -1, 1.0, 1, 1, -1, -1])
    spans = [(0, 7), (8, 10), (11, 13)]
    grasps = find_grasp_states(states, gripper, spans)
    assert grasps.has_grasp.tolist() == [True, False, False]
    # One step after the command to close, and the step of the command to open.
    assert grasps.states[0, :, 0].tolist() == [5, 4.5]
    assert grasps.approach[0, 0] == 2
    assert grasps.carried.tolist() == [5, 8, 11]
    assert not grasps.states[1:].any()
    assert grasps.pick_states[:, 0].isnan().tolist() == [False, True, True]
    assert grasp_frames(gripper, spans) == [(4, 6), None, None]


def ramps(*values, frames=10):
    """Returns a trajectory that goes to each value in some frames, and rests there for as many."""
    parts = [np.linspace(a, b, frames) for a, b in zip(values[:1] + values, values, strict=False)]
    return np.concatenate([np.concatenate([part, np.full(frames, part[-1])]) for part in parts])


def test_each_trajectory_of_a_gripper_has_its_own_grasp():
    for values, closes, opens in [
        ((1, 0, 1), 30, 50),
        ((0, 1, 0.3, 1, 0), 50, 70),  # at rest, it is closed; the object holds it open
        ((1, 0.4, 0.7), 30, 50),  # it opens less after the release
        ((1, 0, 1, 0, 1), 70, 90),  # it slips: the last grasp counts
        ((0, 0.2, 0.1, 0.2), 50, 70),  # of another episode's scale
        ((0, 1, 0, 0.3, 0), 50, 70),  # it opens little after the release
        ((0.1, 0.6, 0.5, 0.6, 0.1), 50, 70),  # the object is wide
        ((1, 0, 0.2, 0, 1), 30, 90),  # its hold on the object loosens
        ((0, 1, 0, 1, 0, 0.2, 0), 50, 70),  # it trembles at rest
    ]:
        noise = np.random.default_rng(0).normal(0, 0.01 * max(values), 20 * len(values))
        trajectory = torch.from_numpy(ramps(*values) + noise)
        ((grasp, release),) = grasp_frames(trajectory, [(0, len(trajectory) - 1)])
        # Within the ramps, each of which takes 10 frames.
        assert closes - 10 <= grasp <= closes
        assert opens - 10 <= release <= opens


def test_glitches_of_a_frame_or_two_are_no_openings():
    trajectory = torch.from_numpy(ramps(0, 1, 0, 1, 0))
    (expected,) = grasp_frames(trajectory, [(0, 99)])
    for frame in (5, 45, 55, 85):
        for glitch in (-50, 100, torch.nan):
            glitched = trajectory.clone()
            glitched[frame : frame + 2] = glitch
            (found,) = find_grasps(glitched, [(0, 99)])
            if glitch is torch.nan:
                assert found == f"the gripper's command is not finite in frame {frame}"
            else:
                assert (found.grasp, found.release) == pytest.approx(expected, abs=2)


def test_approach_and_opening_scale_with_the_trajectory():
    slow = torch.from_numpy(ramps(0, 1, 0, 1, 0, frames=30))
    states = torch.arange(len(slow)).float()[:, None]
    (found,) = find_grasps(slow, [(0, len(slow) - 1)])
    # It closes in the frames 120 to 150, and opens in 180 to 210.
    assert 130 <= found.closing <= 140 <= found.grasp <= 150
    assert 180 < found.release < 190 < 200 < found.opened <= 210
    # Before the last 15 % of the way.
    way = float(found.closing)
    assert 0.8 * way < find_grasp_states(states, slow, [(0, len(slow) - 1)]).approach[0, 0] <= 0.85 * way


def test_the_approach_is_seen_while_the_arm_is_on_its_way():
    frames = torch.arange(60)
    gripper = 1 - 2.0 * ((frames >= 40) & (frames < 55))
    # The arm arrives in frame 10, and trembles for 30 frames before it grasps.
    way = (10 - frames).clamp_min(0) + (frames - 42).clamp(0, 10)
    states = torch.stack([way.float(), 0.01 * (frames % 2)], dim=1)
    grasps = find_grasp_states(states, gripper, [(0, 59)])
    assert 1 <= grasps.approach[0, 0] <= 3


def test_grasp_states_are_those_after_the_commands():
    frames = torch.arange(40)
    gripper = 1 - 2.0 * ((frames >= 5) & (frames < 30))
    grasps = find_grasp_states(frames[:, None], gripper, [(0, 39)])
    assert grasps.states.flatten().tolist() == [6, 30]
    assert grasps.carried.tolist() == [18]


def test_a_state_holds_while_the_command_is_to_stay():
    for close, stay, opened in ((0, 1, 2), (-1, 0, 1), (-2, -1, 0)):
        trajectory = [stay, opened, stay, stay, close, stay, stay, stay, opened, stay, stay]
        trajectories = torch.tensor([*trajectory, *trajectory]).float()
        assert grasp_frames(trajectories, [(0, 10), (11, 21)]) == [(4, 8), (15, 19)]


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ((1, 0), "the gripper does not open again"),
        ((0, 1), "the gripper opens, but does not close before"),
        ((0, 1, 0), "the gripper opens and closes, but does not open again"),
        ((1, 1), "the gripper does not move"),
    ],
)
def test_a_gripper_at_rest_grasps_nothing(values, reason, caplog):
    trajectory = torch.from_numpy(ramps(*values))
    spans = [(0, len(trajectory) - 1)]
    assert find_grasps(trajectory, spans) == [reason]
    grasps = find_grasp_states(torch.zeros(len(trajectory), 1), trajectory, spans)
    warn_of_missing(grasps, [7], "are not trained on")
    refusal = f"1 of 1 episodes have no grasp, and are not trained on: in 1, such as episode 7, {reason}."
    assert refusal in caplog.text


def test_trembles_and_noise_are_no_grasps():
    trajectories = [ramps(1, 0, 1), ramps(1, 0, 1), 1 - 0.05 * ramps(1, 0, 1)]
    starts = np.cumsum([0, *map(len, trajectories)]).tolist()
    spans = [(start, end - 1) for start, end in zip(starts, starts[1:], strict=False)]
    assert (
        find_grasps(torch.from_numpy(np.concatenate(trajectories)), spans)[2] == "the gripper only trembles"
    )
    alone, span = torch.from_numpy(trajectories[2]), [(0, len(trajectories[2]) - 1)]
    assert find_grasps(alone, span, usual=1.0) == ["the gripper only trembles"]
    noise = torch.from_numpy(np.random.default_rng(0).normal(0, 0.01, 200))
    assert find_grasps(noise, [(0, 199)]) == ["the gripper only trembles"]


# What the arm does tells which of several grasps carried the object.

HOME, OBJECT, GOAL = (0.0, 0.0, 0.3), (0.3, -0.2, 0.05), (0.25, 0.25, 0.1)
LIFTED, ABOVE = (0.3, -0.2, 0.1), (0.25, 0.25, 0.25)


def recorded(*stages, seed=0):
    """Returns the states and commands of (position, opening) stages; each takes 20 frames and 10 at rest.

    The gripper's opening is the last dimension of the state. Whoever teleoperates trembles.
    """
    rng = np.random.default_rng(seed)
    values = np.array([[*position, opening] for position, opening in stages])
    motion = np.stack([ramps(*column, frames=15) for column in values.T.tolist()], axis=1)
    states = motion + rng.normal(0, 0.002, motion.shape)
    return torch.from_numpy(states).float(), torch.from_numpy(
        motion[:, 3] + rng.normal(0, 0.004, len(motion))
    )


def carried_from_object_to_goal(states, commands):
    """Whether the only grasp found holds from the object to the goal."""
    (found,) = find_grasps(commands, [(0, len(states) - 1)], states=states)
    grasps = find_grasp_states(states, commands, [(0, len(states) - 1)])
    ends = torch.tensor([OBJECT, GOAL])
    return not isinstance(found, str) and (grasps.states[0, :, :3] - ends).abs().max() < 0.03


PICK_AND_PLACE = [(HOME, 1), (OBJECT, 1), (OBJECT, 0.2), (LIFTED, 0.2), (ABOVE, 0.2), (GOAL, 0.2), (GOAL, 1)]


@pytest.mark.parametrize("rest", [0, 0.5, 1])
@pytest.mark.parametrize("blips", [1, 3])
def test_a_blip_of_the_gripper_at_rest_is_no_grasp(rest, blips):
    at_home = [(HOME, 1 - rest if rest != 0.5 else 0), (HOME, rest)] * blips
    stages = [*PICK_AND_PLACE, (HOME, 1), (HOME, rest), *at_home]
    assert carried_from_object_to_goal(*recorded((HOME, rest), (HOME, 1 - rest), *stages))


def test_a_gripper_that_closes_on_the_way_home_and_opens_there_has_put_nothing_down():
    stages = [*PICK_AND_PLACE, (GOAL, 0), (ABOVE, 0), (HOME, 0)]
    assert carried_from_object_to_goal(*recorded(*stages))
    assert carried_from_object_to_goal(*recorded(*stages, (HOME, 1), (HOME, 0), (HOME, 1)))


@pytest.mark.parametrize("attempts", [1, 3])
def test_attempts_that_fail_and_touches_at_the_goal_are_no_grasps(attempts):
    beside = (0.27, -0.17, 0.05)
    failed = [(beside, 1), (beside, 0), (LIFTED, 0), (LIFTED, 1)] * attempts
    adjusted = [(ABOVE, 1), (GOAL, 1), (GOAL, 0.2), (GOAL, 1)]
    assert carried_from_object_to_goal(
        *recorded(PICK_AND_PLACE[0], *failed, *PICK_AND_PLACE[1:], *adjusted, (HOME, 1))
    )


def test_the_grasp_that_ends_at_the_goal_counts_if_the_object_slips():
    half = (0.28, 0.0, 0.2)
    lost = [(HOME, 1), ((0.3, -0.5, 0.05), 1), ((0.3, -0.5, 0.05), 0.2), (half, 0.2), (half, 1)]
    assert carried_from_object_to_goal(*recorded(*lost, *PICK_AND_PLACE[1:], (HOME, 1)))


def test_a_robot_may_begin_where_it_puts_the_object():
    failed = [(OBJECT, 1), (OBJECT, 0), (LIFTED, 0), (LIFTED, 1)]
    assert carried_from_object_to_goal(*recorded((GOAL, 1), *failed, *PICK_AND_PLACE[1:]))


def test_an_episode_in_which_nothing_is_carried_is_left_out_and_named():
    episodes = [
        recorded(*PICK_AND_PLACE),
        recorded((HOME, 1), (OBJECT, 1), (OBJECT, 0), (OBJECT, 1), (HOME, 1)),
    ]
    states, commands = (torch.cat(parts) for parts in zip(*episodes, strict=True))
    n_first = len(episodes[0][0])
    spans = [(0, n_first - 1), (n_first, len(states) - 1)]
    grasps = find_grasp_states(states, commands, spans)
    assert grasps.missing == (None, "the arm stands still while the gripper is closed")
    # Without states, only the gripper is seen.
    assert not any(isinstance(grasp, str) for grasp in find_grasps(commands, spans))
