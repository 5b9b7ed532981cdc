"""Out-of-distribution objects: meshes that come with PyBullet, which no instruction describes."""

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from gym_deltaco.containers import CONTAINER_WORDS
from gym_deltaco.layout import sample_layout
from gym_deltaco.objects.labels import MESHES, find_label
from gym_deltaco.objects.models import find_model
from gym_deltaco.objects.object_sets import select_objects
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.tasks import TASK_SETS, get_task
from lerobot_deltaco.collection.collect import CollectionPlan, collect
from lerobot_deltaco.data.demonstrations import DemonstrationBank
from lerobot_deltaco.evaluation.lerobot_env import DeltacoEnv
from lerobot_deltaco.evaluation.records import EvaluationPlan

TASKS = TASK_SETS["out_of_distribution"]


@pytest.mark.parametrize("name", ["out_of_distribution", "out_of_distribution_validation"])
def test_each_object_is_the_target_of_one_task(name):
    tasks = [get_task(index) for index in TASK_SETS[name]]
    targets = [task.object.index for task in tasks]
    assert targets == [label.index for label in select_objects(name)]
    assert len(targets) == len(set(targets)) == 96
    containers = [task.container for task in tasks]
    assert {containers.count(word) for word in CONTAINER_WORDS} == {16}
    instructions = {f"Put thing in {word} bin." for word in CONTAINER_WORDS}
    assert {task.instruction for task in tasks} == instructions
    assert all(target - 20_000 in MESHES and find_label(target).index == target for target in targets)


@pytest.mark.parametrize("label", select_objects("out_of_distribution")[::8], ids=lambda label: label.name)
def test_objects_fit_the_gripper(label):
    model = find_model(label.index)
    width, length, height = 2 * model.half_extents
    assert height <= width <= length <= 0.0851
    assert width <= 0.0441
    np.testing.assert_allclose(model.mesh.vertices.min(axis=0), -model.half_extents, atol=1e-9)
    np.testing.assert_allclose(np.abs(model.hull_points).max(axis=0), model.half_extents, atol=1e-9)
    assert find_model(label.index) is model
    # Faces look outward, so that the volume within them is positive: the mesh is not reflected.
    corners = model.mesh.triangles
    assert np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() > 0


def test_task_sets_bring_their_objects():
    plan = EvaluationPlan("out_of_distribution")
    assert plan.scene == SceneConfig(objects="out_of_distribution")
    layout = sample_layout(get_task(TASKS[0]), plan.scene, np.random.default_rng(0))
    found = [item.label for item in layout.objects]
    assert set(found) <= set(select_objects("out_of_distribution"))
    assert [get_task(TASKS[0]).object.describes(label) for label in found].count(True) == 1
    with pytest.raises(ValueError, match="asks for a thing, of which the objects 'all' have none"):
        SceneConfig().check_tasks(TASKS[:1])
    with pytest.raises(ValueError, match="`deltaco evaluate`"):
        DeltacoEnv(task="out_of_distribution")


def test_a_demonstration_is_found_by_its_object(tmp_path):
    first, second = (index for index in TASKS[:12] if get_task(index).container == "green")
    plan = CollectionPlan(f"{first},{second}", 1, scene=SceneConfig(objects="out_of_distribution"))
    collect(tmp_path / "data", plan)
    assert len(pq.read_table(tmp_path / "data/meta/tasks.parquet")) == 1
    columns = ["episode_index", "task_index", "benchmark.target_object"]
    table = pq.read_table(tmp_path / "data/data", columns=columns).to_pandas().drop_duplicates()
    moved = [get_task(index).object.index for index in (first, second)]
    assert table["benchmark.target_object"].tolist() == moved
    assert set(table["task_index"]) == {0}

    sentence = get_task(first).instruction
    bank = DemonstrationBank(torch.zeros(2, 2, 3, 4, 4, dtype=torch.uint8), [sentence] * 2, [0, 1], moved)
    for episode, target in enumerate(moved):
        assert [each.episode for each in bank.of_task(sentence, target)] == [episode]
    assert len(bank.of_task(sentence)) == 2
    with pytest.raises(ValueError, match="with object 20999"):
        bank.of_task(sentence, 20_999)
