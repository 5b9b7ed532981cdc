"""The ladder: oracles that replace a part of a policy, and names of failures."""

from contextlib import closing
from pathlib import Path
from typing import get_args

import numpy as np
import pybullet
import pytest

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import CLOSED, OPEN, Expert, JointExpert, target_positions
from gym_deltaco.scene_config import SceneConfig
from lerobot_deltaco.evaluation.checkpoints import load_policy
from lerobot_deltaco.evaluation.evaluate import evaluate
from lerobot_deltaco.evaluation.failures import FAILURES, NO_FAILURE, EpisodeMonitor
from lerobot_deltaco.evaluation.oracle import check_oracle, state_at
from lerobot_deltaco.evaluation.records import EvaluationPlan, Oracle
from lerobot_deltaco.policies.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy

CHECKPOINT = Path(__file__).parents[2] / "checkpoints" / "pick_place"
TASKS = "24,96,182,249"


@pytest.fixture(scope="module")
def ladder():
    """Episodes of the shipped policy, by oracle, where its locations lie 3 cm beside the objects."""
    loaded = load_policy(CHECKPOINT, ["--device=cpu"])
    with pytest.MonkeyPatch.context() as patch:
        localize = DeltacoMatchPolicy.localize

        def beside(*arguments):
            localization = localize(*arguments)
            locations = localization.locations.clone()
            locations[:, 0] += 0.15
            return localization._replace(locations=locations)

        patch.setattr(DeltacoMatchPolicy, "localize", beside)
        oracles: tuple[Oracle, ...] = get_args(Oracle)
        return {each: evaluate(loaded, EvaluationPlan(TASKS, trials=1, oracle=each)) for each in oracles}


def test_true_locations_repair_a_policy_that_localizes_badly(ladder):
    rates = {oracle: rows["success"].mean() for oracle, rows in ladder.items()}
    assert rates["location"] >= 0.75
    assert rates["controller"] <= 0.25
    # What the policy found is the same, whoever moves the arm.
    errors = {oracle: rows["pick_error"] for oracle, rows in ladder.items()}
    np.testing.assert_array_equal(errors["none"], errors["controller"])
    assert errors["location"].median() < 15 < 25 < errors["none"].median()
    assert (ladder["location"]["place_error"] < 30).all()


def test_only_episodes_without_success_have_a_failure(ladder):
    for rows in ladder.values():
        assert ((rows["failure"] == NO_FAILURE) == rows["success"]).all()
        assert set(rows["failure"]) <= {NO_FAILURE, *FAILURES}
    assert not (ladder["location"]["failure"] == "not found").any()


def test_a_photo_takes_the_place_of_the_demonstration():
    loaded = load_policy(CHECKPOINT, ["--device=cpu"])
    rows = evaluate(loaded, EvaluationPlan(TASKS, trials=1, photo=True))
    assert rows["right_object"].mean() >= 0.5
    assert (rows["demonstration_task"] == -1).all()
    assert not any(len(episodes) for episodes in rows["demonstration_episodes"])
    with pytest.raises(ValueError, match="A photo takes the place of one demonstration"):
        EvaluationPlan(TASKS, photo=True, without="instruction")


def test_a_policy_that_does_not_localize_has_no_oracle():
    class Other:
        config = type("Config", (), {"type": "act"})

    check_oracle(Other(), "none")
    for oracle in ("location", "controller"):
        with pytest.raises(ValueError, match="'act' does not find where"):
            check_oracle(Other(), oracle)


@pytest.mark.parametrize(("control", "kind"), [("position", Expert), ("joints", JointExpert)])
def test_the_controller_reaches_the_goals(control, kind):
    """At the target's own positions, it does the task; between objects, it grasps nothing."""
    with closing(PickPlaceEnv(scene=SceneConfig(control=control))) as env:
        for offset, succeeds in ((0.0, True), (0.05, False)):
            _, info = env.reset(seed=3, options={"task_id": 4})
            goals = target_positions(env.scene)
            goals[0, 0] += offset
            controller = kind(env, np.random.default_rng(0), noise=0.0, goals=goals)
            for _ in range(env.scene_config.n_steps):
                info = env.step(controller.act())[-1]
            assert info["is_success"] == info["right_object"] == succeeds


@pytest.mark.parametrize(("control", "kind"), [("position", Expert), ("joints", JointExpert)])
def test_the_state_at_a_position_is_the_robots_own(control, kind):
    with closing(PickPlaceEnv(4, SceneConfig(control=control))) as env:
        env.reset(seed=0)
        expert = kind(env, np.random.default_rng(0), noise=0.0)
        for _ in range(3 if control == "position" else 30):
            observation = env.step(expert.act())[0]
        assert env.scene.arm.is_open
        expected = state_at(env.scene.arm.position, control)
        np.testing.assert_allclose(observation["agent_pos"], expected, atol=0.05)


def carry(env, monitor, n_steps=4):
    """Lets the expert grasp the target and lift it."""
    expert = Expert(env, np.random.default_rng(0), noise=0.0)
    n_held = 0
    while n_held < n_steps:
        env.step(expert.act())
        monitor.step()
        n_held += env.scene.held_object == env.scene.layout.target_object


def test_failures_are_told_apart():
    with closing(PickPlaceEnv(4)) as env:

        def start():
            env.reset(seed=0)
            return EpisodeMonitor(env), target_positions(env.scene)

        def act(*action):
            env.step(np.array(action))
            monitor.step()

        monitor, true = start()
        layout = env.scene.layout
        assert monitor.errors(None) != monitor.errors(true) == (0, 0)
        assert monitor.errors(true + [[0.003, 0, 0.004], [0, 0.01, 1]]) == pytest.approx((5, 10))
        act(0, 0, 0, CLOSED)
        assert monitor.failure(None) == monitor.failure(true) == "missed"
        other_object, other_container = true.copy(), true.copy()
        other_object[0, :2] = env.scene.object_pose((layout.target_object + 1) % 3).position[:2]
        other = layout.containers[1 - layout.target_container]
        other_container[1, :2] = other.quadrant.container_center
        assert monitor.failure(other_object) == monitor.failure(other_container) == "not found"

        monitor, true = start()
        carry(env, monitor, n_steps=2)
        assert monitor.failure(true) == "not put down"
        act(0, 0, 0, OPEN)
        assert monitor.failure(true) == monitor.failure(None) == "put down beside"


@pytest.mark.parametrize(("where", "failure"), [(0.0, "lost"), (1.0, "thrown off")])
def test_a_target_that_slips_is_lost(where, failure):
    with closing(PickPlaceEnv(4)) as env:
        env.reset(seed=0)
        monitor, scene = EpisodeMonitor(env), env.scene
        carry(env, monitor)
        # As if it had slipped out.
        client = scene._simulation._client
        position = [0.6 + where, 0.25, -0.34]
        body = scene.bodies[scene.layout.target_object]
        pybullet.resetBasePositionAndOrientation(body, position, (0, 0, 0, 1), physicsClientId=client)
        env.step(np.array([0, 0, 0, CLOSED]))
        monitor.step()
        assert monitor.failure(None) == failure
