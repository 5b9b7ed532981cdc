"""Finding objects in new scenes, from a few episodes of a few objects: still images, no robot moves.

    python benchmarks/finding.py --cases toy gym-8-100 --seeds 0 1 2

Each case fits feature matching to first and last images of episodes, and looks for objects in scenes that
were not fitted: of the same tasks, and with new objects. No test object of the benchmark is used. A choice is
right if it lies on the object. A fit takes one to two minutes on a core.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from numpy.typing import NDArray
from torch import Tensor

from gym_deltaco.containers import CONTAINER_COLORS
from gym_deltaco.layout import MIN_OBJECT_DISTANCE, Layout, PlacedContainer, PlacedObject, sample_layout
from gym_deltaco.objects.models import find_model
from gym_deltaco.phrases import paraphrase
from gym_deltaco.scene import Scene
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.sim.camera import Camera
from gym_deltaco.sim.simulation import Simulation, camera_matrices
from gym_deltaco.sim.workspace import CAMERA, QUADRANTS, TRAY_FLOOR
from gym_deltaco.tasks import OBJECTS, get_task, select_tasks

N_TEST_SCENES = 60
POLICY_SIZE = 48  # px, of the images of the policy
LOCATION_NOISE = 0.03  # of grasps in the image, where its edges are at -1 and 1


@dataclass(frozen=True)
class Case:
    """A dataset: objects, episodes and a camera.

    Args:
        n_objects: Number of objects that are trained on; 0 for the benchmark's own tasks with 400 objects.
        n_episodes: Number of episodes.
        camera: The camera.
        size: Width and height of the images, px.
        people: Whether tasks are also described in people's words.
        pixel_noise: Standard deviation of the noise of a pixel, 0..255.
    """

    n_objects: int
    n_episodes: int
    camera: Camera = CAMERA
    size: tuple[int, int] = (96, 96)
    people: bool = True
    pixel_noise: float = 0.0


def _front_camera(distance: float) -> Camera:
    return Camera(target=(0.6, 0.22, -0.35), distance=distance, yaw=165, pitch=-38, far=5.0)


TOY = Case(4, 32, _front_camera(0.62), (160, 120), people=False, pixel_noise=2.0)
CASES = {
    "toy": TOY,
    **{f"gym-{n}-{m}": Case(n, m) for n in (4, 8, 24) for m in (30, 100, 300)},
    # The object is 3 to 13 % of the side of the picture.
    **{
        f"size-{d}": replace(TOY, n_episodes=64, camera=_front_camera(d / 100), size=(240, 240))
        for d in (30, 45, 80, 130)
    },
    "home": Case(0, 600),
}


class StillEpisode(NamedTuple):
    """What is known of an episode.

    Attributes:
        first: First image, (3, H, W) uint8.
        last: Last image.
        locations: Locations of its objects, (objects, 2) in -1..1, the target first.
        radius: Radius of the target in the image, in the same unit.
        task: Task string.
        sentences: Its instructions.
    """

    first: Tensor
    last: Tensor
    locations: Tensor
    radius: float
    task: str
    sentences: list[str]


def project(camera: Camera, points: NDArray[np.float64], aspect: float) -> NDArray[np.float64]:
    """Projects points (n, 3), m, into images, (n, 2) in -1..1."""
    view, projection = (np.reshape(matrix, (4, 4)).T for matrix in camera_matrices(camera))
    clip = np.c_[points, np.ones(len(points))] @ (projection @ view).T
    return clip[:, :2] / clip[:, 3:] * [1, -aspect]


class Scenes:
    """Draws still episodes."""

    def __init__(self, case: Case, objects: Sequence[int], rng: np.random.Generator) -> None:
        self.case, self.objects, self.rng = case, list(objects), rng
        self.simulation = Simulation()

    def episode(self, target: int, container: int) -> StillEpisode:
        """Draws an episode that moves an object to a container."""
        label = find_model(target).label
        # Random objects have no names.
        name = label.name if target < len(OBJECTS) else f"{label.color} {label.shape}"
        task = f"Put the {name} in the {CONTAINER_COLORS[container]} box."
        sentences = [task]
        if self.case.people and target < len(OBJECTS):
            people_task = get_task(50 * container + target)
            # The same for each episode of a task
            rng = np.random.default_rng((people_task.index, 0))
            sentences = [task] * 8 + [paraphrase(people_task, "train", rng) for _ in range(8)]
        return self.show(self._layout(target, container), task, sentences)

    def show(self, layout: Layout, task: str, sentences: list[str]) -> StillEpisode:
        """Draws an episode of a layout."""
        camera, (width, height) = self.case.camera, self.case.size
        scene = Scene(self.simulation, layout)
        first = self._render(scene)
        order = [layout.target_object, *(n for n in range(len(layout.objects)) if n != layout.target_object)]
        points = np.array([scene.object_pose(n).position for n in order])
        locations = project(camera, points, width / height)
        target = layout.objects[layout.target_object]
        aside = points[:1] + target.model.radius * _right(camera)
        radius = float(np.abs(project(camera, aside, width / height)[0] - locations[0])[0])
        moved = list(layout.objects)
        center = layout.containers[layout.target_container].quadrant.container_center
        moved[layout.target_object] = target._replace(xy=center)
        scene = Scene(self.simulation, layout._replace(objects=tuple(moved)))
        low, high = (0.45, 0.1, -0.2), (0.75, 0.3, -0.1)
        hand = self.rng.uniform(low, high)
        for _ in range(6):
            scene.command(hand, True)
        locations = torch.tensor(locations, dtype=torch.float32)
        return StillEpisode(first, self._render(scene), locations, radius, task, sentences)

    def _render(self, scene: Scene) -> Tensor:
        width, height = self.case.size
        image = self.simulation.render(self.case.camera, width).astype(np.float32)
        image = image[(width - height) // 2 :][:height]
        if self.case.pixel_noise:
            image = image * self.rng.uniform(0.97, 1.03)
            image = image + self.rng.normal(0, self.case.pixel_noise, image.shape)
        return torch.from_numpy(image.clip(0, 255).astype(np.uint8)).permute(2, 0, 1).contiguous()

    def _layout(self, target: int, container: int) -> Layout:
        rng = self.rng
        others = rng.choice([n for n in self.objects if n != target], 2, replace=False)
        quadrants = rng.permutation(len(QUADRANTS))
        containers = tuple(
            PlacedContainer(color, QUADRANTS[quadrants[n]]) for n, color in enumerate(CONTAINER_COLORS)
        )
        while True:
            placed = []
            for index in (target, *map(int, others)):
                region = QUADRANTS[quadrants[2 + rng.integers(2)]].object_region
                model = find_model(index)
                placed.append(
                    PlacedObject(model, rng.uniform(region.low, region.high), rng.uniform(*model.yaw_range))
                )
            distances = [np.hypot(*(placed[a].xy - placed[b].xy)) for a, b in ((0, 1), (0, 2), (1, 2))]
            points = np.array([(*item.xy, TRAY_FLOOR + item.model.half_extents[2]) for item in placed])
            seen = np.abs(project(self.case.camera, points, self.case.size[0] / self.case.size[1])) < 0.92
            if min(distances) > MIN_OBJECT_DISTANCE and seen.all():
                return Layout(tuple(placed), containers, 0, container)


def _right(camera: Camera) -> NDArray[np.float64]:
    yaw = np.radians(camera.yaw)
    return np.array([np.cos(yaw), np.sin(yaw), 0.0])


@dataclass
class Data:
    """Episodes of a case: those that are fitted, and pairs of a scene and a demonstration to test."""

    train: list[StillEpisode]
    tests: dict[str, list[tuple[StillEpisode, StillEpisode]]]


def draw_data(case: Case, seed: int) -> Data:
    """Draws the data of a case."""
    rng = np.random.default_rng((seed, case.n_objects, case.n_episodes))
    if not case.n_objects:
        return _draw_home(case, rng)
    order = [int(n) for n in rng.permutation(24)]
    objects = order[: case.n_objects]
    new = order[case.n_objects :][:8] if case.n_objects < 16 else list(range(232, 256))
    scenes, new_scenes = Scenes(case, objects, rng), Scenes(case, [*objects[:4], *new], rng)
    # Each task in turn
    pairs = [(target, container) for target in objects for container in range(2)]
    train = [scenes.episode(*pairs[n % len(pairs)]) for n in range(case.n_episodes)]
    by_task: dict[str, list[StillEpisode]] = {}
    for episode in train:
        by_task.setdefault(episode.task, []).append(episode)
    same = []
    for n in range(N_TEST_SCENES):
        episode = scenes.episode(*pairs[n % len(pairs)])
        shown = by_task.get(episode.task, [])
        if shown:
            same.append((episode, shown[int(rng.integers(len(shown)))]))
    fresh = []
    for n in range(N_TEST_SCENES):
        target, container = new[n % len(new)], n % 2
        fresh.append((new_scenes.episode(target, container), new_scenes.episode(target, container)))
    for each in (scenes, new_scenes):
        each.simulation.close()
    return Data(train, {"same": same, "new": fresh})


def _draw_home(case: Case, rng: np.random.Generator) -> Data:
    """Draws data of the benchmark's own tasks: fold 0 of the training objects is held out."""
    scenes = Scenes(case, [], rng)

    def episode(task_id: int, config: SceneConfig) -> StillEpisode:
        task = get_task(task_id)
        people = np.random.default_rng((task_id, 0))
        sentences = [task.instruction] * 8
        sentences += [paraphrase(task, "train", people) for _ in range(8)]
        return scenes.show(sample_layout(task, config, rng), task.instruction, sentences)

    config = SceneConfig(objects="fold_0:400")
    tasks = select_tasks("scenario_a_fold_0_train")
    # As many tasks as can be shown twice
    tasks = rng.permutation(tasks)[: case.n_episodes // 2].tolist()
    train = [episode(tasks[n % len(tasks)], config) for n in range(case.n_episodes)]
    of_task: dict[str, list[StillEpisode]] = {}
    for each in train:
        of_task.setdefault(each.task, []).append(each)
    same = []
    for n in range(3 * N_TEST_SCENES):
        scene = episode(tasks[n % len(tasks)], config)
        same.append((scene, of_task[scene.task][int(rng.integers(2))]))
    config = SceneConfig(objects="scenario_a_train")
    tasks = [n for n in select_tasks("scenario_a_fold_0_validation") if n < 300]
    fresh = []
    for n in range(3 * N_TEST_SCENES):
        task = int(tasks[n * 7 % len(tasks)])
        fresh.append((episode(task, config), episode(task, config)))
    scenes.simulation.close()
    return Data(train, {"same": same, "new": fresh})


def small(images: Tensor) -> Tensor:
    """Scales images (n, 3, H, W) uint8 to the policy's size."""
    scaled = F.interpolate(images.float(), (POLICY_SIZE, POLICY_SIZE), mode="area")
    return scaled.round().to(torch.uint8)


def fit(data: Data, seed: int) -> Any:
    """Fits feature matching to the training episodes of a case."""
    from lerobot_deltaco.policies.base.configuration import has_bfloat16
    from lerobot_deltaco.policies.deltaco_match.feature_matching import FeatureMatching
    from lerobot_deltaco.policies.deltaco_match.fit import fit_feature_matching
    from lerobot_deltaco.policies.deltaco_match.words import vocabulary_of

    train = data.train
    first, last = (torch.stack([getattr(e, part) for e in train]) for part in ("first", "last"))
    picks = torch.stack([e.locations[0] for e in train])
    generator = torch.Generator().manual_seed(seed)
    picks = picks + LOCATION_NOISE * torch.randn(picks.shape, generator=generator)
    sentences = {e.task: e.sentences for e in train}
    vocabulary = vocabulary_of(text for texts in sentences.values() for text in texts)
    matching = FeatureMatching(vocabulary)
    tasks = [e.task for e in train]
    fit_feature_matching(
        matching,
        *(small(first), small(last), first, picks, torch.zeros(len(train)), tasks, sentences, seed),
        in_bfloat16=has_bfloat16(),
    )
    return matching


def measure(matching: Any, pairs: Sequence[tuple[StillEpisode, StillEpisode]]) -> dict[str, float]:
    """Looks for objects in new scenes.

    Returns:
        Rates: a proposal at the object; the right object by the encoder's features alone, without any fit, by
        demonstration, by words and by both; and of the choices by demonstration and by both, how many are
        sure by 90 % and more, and how many of these are right.
    """
    scenes = torch.stack([scene.first for scene, _ in pairs])
    shown = torch.stack([demonstration.first for _, demonstration in pairs])
    last = torch.stack([demonstration.last for _, demonstration in pairs])
    generator = torch.Generator().manual_seed(0)
    picks = torch.stack([demonstration.locations[0] for _, demonstration in pairs])
    picks = picks + LOCATION_NOISE * torch.randn(picks.shape, generator=generator)
    ends = torch.stack([small(each).float() / 255 for each in (shown, last)], dim=1)
    described = matching.describe(ends, shown.float() / 255, picks, picks)
    templates = None if described.templates is None else described.templates[:, None]
    rng = np.random.default_rng(0)
    texts = [str(rng.choice(scene.sentences)) for scene, _ in pairs]
    nothing = [""] * len(pairs)
    heights = torch.full((len(pairs),), torch.nan)
    locations = matching.background(scenes.float() / 255)
    inputs = (
        matching.compare.inputs(matching.features(*crops))
        for crops in ((scenes, locations), (shown, described.centers[:, None]))
    )
    cosines = F.cosine_similarity(*inputs, dim=2).masked_fill(locations[..., 0].isnan(), -1)
    chosen = locations[torch.arange(len(pairs)), cosines.argmax(dim=1)]
    result = {"raw": float(np.mean([_is_right(e, at) for (e, _), at in zip(pairs, chosen, strict=True)]))}
    for name, words, by in (
        ("demo", nothing, (described.descriptors, heights, templates)),
        ("words", texts, (None, None, None)),
        ("both", texts, (described.descriptors, heights, templates)),
    ):
        candidates = matching.find(scenes.float() / 255, words, *by, matching.novelty(words))
        location, p, _ = candidates.best
        right, near = [], []
        for n, (scene, _) in enumerate(pairs):
            right.append(_is_right(scene, location[n]))
            offsets = (candidates.locations[n] - scene.locations[0]).norm(dim=1)
            near.append(bool((offsets < 0.9 * scene.radius).any()))
        result[name] = float(np.mean(right))
        result["near"] = float(np.mean(near))
        certain = p.numpy() >= 0.9
        result[f"sure {name}"] = float(certain.mean())
        result[f"sure right {name}"] = float(np.mean(np.array(right)[certain])) if certain.any() else np.nan
    return result


def _is_right(scene: StillEpisode, location: Tensor) -> bool:
    """Returns whether a location (2,) is on the object that the task asks for."""
    distance = (scene.locations - location).norm(dim=1)
    return bool(distance.argmin() == 0 and distance[0] < 0.9 * scene.radius)


def main() -> None:
    """Fits and measures the cases that the command line names, and prints a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cases", nargs="+", default=[*CASES], choices=[*CASES])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--out", type=Path, help="file of the figures, as JSON lines")
    arguments = parser.parse_args()
    columns = (
        "near",
        "raw",
        "demo",
        "words",
        "both",
        "sure demo",
        "sure right demo",
        "sure both",
        "sure right both",
    )
    print(f"{'case':12} {'scenes':6} " + " ".join(f"{name:>10.10}" for name in columns))  # noqa: T201
    for case in arguments.cases:
        rows: dict[str, list[dict[str, float]]] = {}
        began = time.perf_counter()
        for seed in arguments.seeds:
            data = draw_data(CASES[case], seed)
            matching = fit(data, seed)
            for name, pairs in data.tests.items():
                rows.setdefault(name, []).append(measure(matching, pairs))
        for name, figures in rows.items():
            mean = {column: float(np.nanmean([each[column] for each in figures])) for column in columns}
            print(f"{case:12} {name:6} " + " ".join(f"{100 * mean[c]:10.0f}" for c in columns), flush=True)  # noqa: T201
            if arguments.out:
                with arguments.out.open("a") as file:
                    file.write(json.dumps({"case": case, "scenes": name, "seeds": figures}) + "\n")
        print(f"  {time.perf_counter() - began:.0f} s", flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
