"""Evaluation on LIBERO-PRO: what a policy is given, and what is recorded. Without the simulator."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot_env_libero_pro", reason="envs/lerobot_env_libero_pro is not on the path")
from lerobot_env_libero_pro import evaluate
from lerobot_env_libero_pro.evaluate import (
    LoadedPolicy,
    PolicyActor,
    demonstrating_sentences,
    is_lured,
    read_record,
    run_episode,
    table,
)
from lerobot_env_libero_pro.suites import Task

BASKET = "basket_1_contain_region"
OBJECTS = ("milk_1", "butter_1", "ketchup_1", "basket_1")
HEADER = {"suite": "libero_object", "versions": {"mujoco": "3.3.0"}}


def make_task(target="milk_1", place=BASKET, sentence=None, suite="libero_object"):
    sentence = sentence or f"pick the {target[:-2]} and place it in the basket"
    return Task(suite, 0, "", sentence, Path(), OBJECTS, (("in", target, place),), {})


MILK, BUTTER, KETCHUP = (make_task(name) for name in OBJECTS[:3])


@pytest.fixture(autouse=True)
def three_tasks(monkeypatch):
    """The only tasks: milk, butter and ketchup into the basket."""
    monkeypatch.setattr(
        evaluate, "load_tasks", lambda suite, ids=None: [MILK, BUTTER, KETCHUP][: None if ids is None else 1]
    )
    monkeypatch.setattr(evaluate, "training_places", lambda env: None)


class FakeScene:
    """A scene whose hand is at the target when the third action is chosen."""

    task, state_size = MILK, 7

    def __init__(self):
        self.steps = 0

    def position(self, name):
        return np.array([0.1 * OBJECTS.index(name) if name in OBJECTS else 0.3, 0, 0.02])

    def hand_position(self):
        return self.position("milk_1") if self.steps >= 2 else np.array([0, 0.5, 0.3])


class FakeEnv:
    """An environment in which the third action that closes the gripper succeeds."""

    draws, task_description = True, MILK.sentence

    def reset(self, seed):
        self.scene, self.closed = FakeScene(), 0
        return self.observation(), self.info()

    def step(self, action):
        self.scene.steps += 1
        self.closed += action[-1] > 0
        info = self.info()
        return self.observation(), 0, info["is_success"], self.scene.steps == 10, info

    def observation(self):
        return {
            "pixels": {"image": np.zeros((8, 8, 3), np.uint8)},
            "agent_pos": np.full(8, self.scene.steps, np.float32),
        }

    def info(self):
        is_success = bool(self.closed == 3)
        return {
            "is_success": is_success,
            "target": "milk_1",
            "lifted": "milk_1" if is_success else "",
            "target_position": self.scene.position("milk_1"),
        }


class FakePolicy:
    """A policy that closes the gripper, and notes what it is given."""

    config = SimpleNamespace(device="cpu", uses_demonstrations=True)

    def __init__(self, sentences=(MILK.sentence, BUTTER.sentence)):
        self.demonstrations = SimpleNamespace(
            rows=dict.fromkeys(sentences),
            of_task=lambda task: [SimpleNamespace(task=task, episode=n) for n in (0, 1)],
        )
        self.given, self.states = [], None

    def reset(self):
        pass

    def set_tasks(self, instructions, demonstrations):
        self.given.append((*instructions, *[each.task for each in demonstrations[0]]))

    def set_pick_and_place(self, states):
        self.states = states

    def select_action(self, batch):
        self.seen = batch
        return torch.tensor([[0.0, 0, 0, 0, 0, 0, 2]])


def loaded(policy):
    return LoadedPolicy(policy, lambda batch: batch, lambda action: action, {"type": "fake"})


@pytest.mark.parametrize(
    ("condition", "given"),
    [
        ("full", (MILK.sentence, MILK.sentence)),
        ("no_demonstration", (MILK.sentence,)),
        ("no_sentence", ("", MILK.sentence)),
        ("wrong_demonstration", (MILK.sentence, BUTTER.sentence)),
    ],
)
def test_a_condition_gives_or_keeps_back_what_it_says(condition, given):
    policy = FakePolicy()
    row = run_episode(FakeEnv(), PolicyActor(loaded(policy), condition), state=1)
    assert policy.given == [given]
    assert policy.seen["task"] == [given[0]]
    assert policy.states is None
    assert row["success"]
    assert row["success_at_end"]
    assert row["n_steps"] == 3
    assert row["closed_at"] == row["target_at"] == [0, 0, 0.02]
    assert row.get("demonstration") == (given[1] if len(given) == 2 else None)
    assert row.get("demonstration_episode") == (1 if len(given) == 2 else None)
    json.dumps(row)


def test_the_oracle_gives_the_true_places(monkeypatch):
    states = np.arange(16, dtype=np.float32).reshape(2, 8)
    monkeypatch.setattr(evaluate, "grasp_and_release", lambda *_: states)
    policy = FakePolicy()
    run_episode(FakeEnv(), PolicyActor(loaded(policy), "oracle"), state=0)
    assert policy.states.tolist() == [states.tolist()]


def test_what_a_policy_localized_is_recorded(monkeypatch):
    monkeypatch.setattr(evaluate, "grasp_and_release", lambda *_: np.zeros((2, 8), np.float32))
    policy = FakePolicy()
    policy.localized_states = torch.tensor([[[0.12] + [0.0] * 7, [0.3, 0.4] + [0.0] * 6]])
    policy.pick_confidence = torch.tensor([0.75])
    row = run_episode(FakeEnv(), PolicyActor(loaded(policy), "full"), state=0)
    assert (row["localized"], row["confidence"]) == ("butter_1", 0.75)
    assert (row["pick_error"], row["place_error"]) == (0.12, 0.5)


def test_a_policy_that_takes_only_a_sentence_has_only_the_full_condition():
    policy = SimpleNamespace(
        config=SimpleNamespace(device="cpu"), reset=lambda: None, select_action=FakePolicy().select_action
    )
    assert run_episode(FakeEnv(), PolicyActor(loaded(policy), "full"), state=0)["success"]
    with pytest.raises(ValueError, match="'no_sentence' is for policies with a method `set_tasks`"):
        PolicyActor(loaded(policy), "no_sentence")


@pytest.mark.parametrize("condition", ["full", "no_sentence", "wrong_demonstration", "oracle"])
def test_an_empty_bank_is_an_error_and_not_another_condition(condition):
    policy = FakePolicy()
    policy.demonstrations = None
    with pytest.raises(ValueError, match=f"'{condition}' needs demonstrations.*--demo-root"):
        PolicyActor(loaded(policy), condition)
    run_episode(FakeEnv(), PolicyActor(loaded(policy), "no_demonstration"), state=0)
    assert policy.given == [(MILK.sentence,)]


def test_a_policy_that_no_longer_looks_gets_no_new_pictures():
    policy, env = FakePolicy(), FakeEnv()
    policy.needs_images = False
    run_episode(env, PolicyActor(loaded(policy), "full"), state=0)
    assert not env.draws


def test_a_new_pairing_is_demonstrated_with_the_same_object():
    on_plate = make_task("milk_1", "plate_1", "put the milk on the plate", "libero_object_task")
    known = [BUTTER.sentence, MILK.sentence]
    assert demonstrating_sentences(on_plate, known, is_wrong=False, state=0) == [MILK.sentence]
    with pytest.raises(ValueError, match="No demonstration for 'pick the ketchup"):
        demonstrating_sentences(KETCHUP, known, is_wrong=False, state=0)


@pytest.mark.parametrize(
    ("closed_at", "target_at", "expected"),
    [
        ([0, 0.01, 0.2], [0.3, 0, 0], True),
        ([0.3, 0.01, 0.2], [0.3, 0, 0], False),
        (None, [0.3, 0, 0], False),
        ([0, 0.01, 0.2], [0.05, 0, 0], None),
    ],
)
def test_the_lure_is_where_the_target_stood_and_does_not_stand(closed_at, target_at, expected):
    closed = None if closed_at is None else np.array(closed_at)
    assert is_lured(closed, np.array(target_at), np.zeros((1, 3))) is expected
    assert is_lured(closed, np.array(target_at), None) is None


def test_a_record_goes_on_after_an_interruption_and_refuses_another_policy(tmp_path):
    file = tmp_path / "records" / "swap.jsonl"
    assert read_record(file, HEADER) == []
    with file.open("a") as stream:
        stream.write('{"state": 0}\n{"state"')
    assert read_record(file, HEADER) == [{"state": 0}]
    assert read_record(file, HEADER) == [{"state": 0}]
    with pytest.raises(ValueError, match="its suite is libero_object, and not libero_goal"):
        read_record(file, HEADER | {"suite": "libero_goal"})


def test_the_table_has_a_row_for_each_condition():
    row = {
        "success": True,
        "success_at_end": False,
        "target": "a",
        "lifted": "a",
        "lured": None,
        "seconds": 2,
    }
    rows = [row | {"condition": "full", "localized": "b"}] * 4 + [row | {"condition": "script"}]
    full, script = table(rows).splitlines()[2:]
    assert full == "| full | 4 | 100 (51 to 100) | 0 (0 to 49) | 0 (0 to 49) | 100 (51 to 100) | - | 2.0 |"
    assert script.startswith("| script | 1 | 100 (21 to 100) | 0 (0 to 79) | - |")
