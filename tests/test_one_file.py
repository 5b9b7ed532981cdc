"""`examples/deltaco_match_in_one_file.py`, with few episodes."""

import ast
from pathlib import Path

import deltaco_match_in_one_file as one_file
import pytest
import torch

TASKS, OBJECTS = (3, 64, 112), "scenario_a_train"
N_TRAIN, N_HELD_OUT = 12, 2  # episodes of each task


@pytest.fixture(scope="module")
def episodes():
    """Training episodes and held-out ones."""
    collected = one_file.collect(TASKS, N_TRAIN + N_HELD_OUT, OBJECTS)
    is_train = [n % (N_TRAIN + N_HELD_OUT) < N_TRAIN for n in range(len(collected))]
    pairs = list(zip(collected, is_train, strict=True))
    return [episode for episode, train in pairs if train], [episode for episode, train in pairs if not train]


@pytest.fixture(scope="module")
def policy(episodes):
    return one_file.Policy(episodes[0])


def test_the_object_of_a_held_out_episode_is_proposed_where_the_hand_is_projected(policy, episodes):
    distances = []
    for episode in episodes[1]:
        location = policy.camera(episode.hand[[episode.grasp]])
        distances.append((policy.propose(episode.first)[:, :2] - location).norm(dim=1).min())
    assert torch.stack(distances).median() < 0.15


def test_objects_and_places_are_found_in_held_out_episodes(policy, episodes):
    train, held_out = episodes
    grasps, releases = [], []
    for episode in held_out:
        demonstration = next(other for other in train if other.task == episode.task)
        found = policy.localize(episode.first, demonstration, episode.instruction)
        grasps.append((found.grasp - episode.hand[episode.grasp]).norm())
        releases.append((found.release - episode.hand[episode.release])[:2].norm())
    assert torch.stack(grasps).median() < 0.04  # m
    assert torch.stack(releases).median() < 0.06


def test_a_moved_trajectory_ends_at_the_grasp_and_at_the_release(episodes):
    demonstration = episodes[0][0]
    found = one_file.PickPlace(torch.zeros(2), *torch.rand(2, 3))
    moved = one_file.move(demonstration, found)
    torch.testing.assert_close(moved[0], demonstration.hand[0])
    torch.testing.assert_close(moved[demonstration.grasp], found.grasp)
    torch.testing.assert_close(moved[demonstration.release], found.release)


def test_only_words_that_describe_objects_of_several_tasks_count(episodes):
    # Two tasks share a shape, two a container.
    features = torch.eye(3).repeat_interleave(4, dim=0)
    features[:8, 0] = 1
    bags = torch.tensor([[1.0, 1, 0], [1, 0, 1], [0, 0, 0]]).repeat_interleave(4, dim=0)
    scores = one_file.WordScores(features, bags, torch.arange(3).repeat_interleave(4))
    assert scores.weights[0] > scores.weights[1:].max()


def test_it_acts(policy):
    outcomes = one_file.evaluate(policy, TASKS[:1], OBJECTS)
    assert outcomes.shape == (1, 2)


def test_the_file_imports_nothing_of_the_package():
    tree = ast.parse(Path(one_file.__file__).read_text())
    modules = [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    modules += [name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names]
    assert {name.split(".")[0] for name in modules}.isdisjoint({"lerobot_deltaco", "lerobot"})
