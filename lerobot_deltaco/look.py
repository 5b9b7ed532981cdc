"""`deltaco look`: a page with pictures of where a policy looks, in a dataset or the benchmark."""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import jinja2
import numpy as np
import torch
from lerobot.utils.constants import ACTION
from PIL import Image
from tqdm import tqdm

from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import get_task, select_tasks
from lerobot_deltaco.base_config import TaskConditionedConfig
from lerobot_deltaco.checkpoints import LoadedPolicy
from lerobot_deltaco.dataset_reading import open_dataset
from lerobot_deltaco.deltaco_match.keyframes import find_keyframes
from lerobot_deltaco.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy, Found
from lerobot_deltaco.demonstrations import read_demonstrations, read_robot_data
from lerobot_deltaco.evaluate import Simulators
from lerobot_deltaco.pictures import (
    MIN_SIDE,
    PICK_COLOR,
    PLACE_COLOR,
    demonstration_ends,
    draw_found,
    write_video,
)
from lerobot_deltaco.recording import benchmark_scene, load_conditioned, record_demonstration, record_episode

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

# A location is right within this distance from the recorded one: a tenth of the image's side. In the
# benchmark, the centers of objects are at least 0.26 apart.
TOLERANCE = 0.2
_BENCHMARK_TASKS, _BENCHMARK_SEED = "scenario_a_test", 1000  # the first trial of the evaluation protocol


class View(NamedTuple):
    """An episode on the page.

    Attributes:
        title: Instruction.
        picture: Picture by `draw_found`, as a data URI.
        text: Description of the episode.
        is_right: Whether the pick location is right, or the episode succeeded; None if it is not known.
        video: Video of the episode, as a data URI; None without one.
    """

    title: str
    picture: str
    text: str
    is_right: bool | None
    video: str | None = None


def look(
    checkpoint: str,
    repo_id: str | None = None,
    root: Path | None = None,
    episodes: int = 12,
    out: Path = Path("outputs/look"),
) -> Path:
    """Draws where a policy looks in episodes of a dataset or of the benchmark, on one self-contained page.

    Args:
        checkpoint: Folder of a policy or of its training run, or id of a repository on the Hub.
        repo_id: Repository id of a dataset; None for the name of its folder.
        root: Folder of the dataset. Without both, episodes of the benchmark's test tasks are run.
        episodes: Number of episodes, evenly spread.
        out: Folder for the page.

    Returns:
        The page.

    Raises:
        ValueError: The policy finds no locations, or does not fit the dataset.
    """
    if episodes < 1:
        raise ValueError(f"`episodes` must be at least 1. Got {episodes}.")
    loaded = load_conditioned(checkpoint)
    if not isinstance(loaded.policy, DeltacoMatchPolicy):
        raise ValueError(
            f"{checkpoint} holds a policy of the type {loaded.policy.config.type!r}, which does not look for "
            "locations. `deltaco look` needs one of the type deltaco_match."
        )
    out.mkdir(parents=True, exist_ok=True)
    if repo_id is None and root is None:
        source, result, tolerance = "scenes of the benchmark", "Successful episodes:", None
        views = _benchmark_views(loaded, episodes, out)
    else:
        source = repo_id or Path(root or "").resolve().name
        result, tolerance = "Episodes with the right pick location:", TOLERANCE
        views = _dataset_views(loaded, open_dataset("--dataset.root", source, root), episodes)
    shown = list(tqdm(views, desc="Looking", unit="episode", total=episodes))
    page = out / "index.html"
    partial = page.with_name(".index.html.part")
    known = [view.is_right for view in shown if view.is_right is not None]
    template = resources.files("lerobot_deltaco").joinpath("look.html").read_text(encoding="utf-8")
    text = (
        jinja2.Environment(autoescape=True)
        .from_string(template)
        .render(
            checkpoint=checkpoint,
            source=source,
            views=shown,
            result=result,
            n_right=sum(known),
            n_known=len(known),
            tolerance=tolerance,
            pick_color=f"rgb{PICK_COLOR}",
            place_color=f"rgb{PLACE_COLOR}",
        )
    )
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, page)
    return page


def _benchmark_views(loaded: LoadedPolicy, n_episodes: int, out: Path) -> Iterator[View]:
    """Runs episodes of the benchmark's test tasks."""
    policy, config = loaded.policy, loaded.policy.config
    scene, task_ids = benchmark_scene(config), select_tasks(_BENCHMARK_TASKS)
    simulators, video = Simulators(scene, MIN_SIDE), out / "episode.mp4"
    for index in _spread(len(task_ids), n_episodes):
        task = get_task(task_ids[index])
        shown = []
        if config.uses_demonstrations:
            bank = policy.demonstrations
            is_known = bank is not None and task.instruction in bank.rows
            shown = [
                bank.of_task(task.instruction)[0]
                if is_known
                else record_demonstration(config, task, 0, scene)
            ]
        seed = episode_seed(0, "evaluation", task.index, 0, _BENCHMARK_SEED)
        recording = record_episode(
            loaded, task.index, seed, task.instruction, shown, scene, MIN_SIDE, simulators=simulators
        )
        assert recording.found is not None
        ends = demonstration_ends(shown[0]) if shown else None
        picture = draw_found(recording.frames[0], ends, recording.found)
        write_video(recording.frames, video)
        is_success = bool(recording.info["is_success"])
        text = "success" if is_success else "failure"
        text = f"Task {task.index}: {text}{_how_sure(policy, task.instruction, recording.found)}"
        uri = _data_uri("video/mp4", video.read_bytes())
        video.unlink()
        yield View(task.instruction, _picture_uri(picture), text, is_success, uri)
    simulators.close()


def _dataset_views(loaded: LoadedPolicy, dataset: LeRobotDataset, n_episodes: int) -> Iterator[View]:
    """Finds the locations in first images of episodes, with other episodes as demonstrations."""
    policy, config, meta = loaded.policy, loaded.policy.config, dataset.meta
    _check_features(config, dataset)
    tasks = [names[0] for names in meta.episodes["tasks"]]
    data = read_robot_data(dataset, range(len(tasks)))
    keyframes = find_keyframes(data.states, config.gripper_opening(data.actions), data.spans)
    chosen = _spread(len(tasks), n_episodes)
    partners = {episode: _partner(tasks, episode) for episode in chosen}
    bank = None
    if config.uses_demonstrations:
        needed = sorted(set(partners.values()))
        bank = read_demonstrations(
            dataset, config.cameras[0], config.image_size, config.n_demo_frames, needed
        )
        bank.pick_states = keyframes.pick_states[needed]
    for episode in chosen:
        shown = [] if bank is None else [bank.of_episode(partners[episode])]
        item = dataset[data.spans[episode][0]]
        # Videos are read as uint8, images as floats in 0..1.
        observation = {
            name: item[name].float() / 255 if item[name].dtype == torch.uint8 else item[name]
            for name in config.input_features
        }
        policy.reset()
        policy.set_tasks([tasks[episode]], [shown])
        with torch.inference_mode():
            policy.select_action(loaded.preprocessor({**observation, "task": tasks[episode]}))
        found: Found = policy.found
        recorded, is_right, text = None, None, "no grasp is recorded"
        if bool(keyframes.found[episode]):
            states = keyframes.states[episode].to(config.device)
            recorded = policy.robot_states.to_image(states).clamp(-1, 1).cpu()
            distance = float((found.locations[0, 0].cpu() - recorded[0]).norm())
            is_right = distance < TOLERANCE
            text = f"pick location {50 * distance:.0f} % of the image's side from the recorded grasp"
        if bank is not None:
            own = partners[episode] == episode
            text += ", demonstrated by " + ("itself" if own else f"episode {partners[episode]}")
        text += _how_sure(policy, tasks[episode], found)
        image = (observation[config.cameras[0]] * 255).round().to(torch.uint8)
        scene = image.permute(1, 2, 0).numpy()
        ends = demonstration_ends(shown[0]) if shown else None
        picture = draw_found(scene, ends, found, 0, recorded)
        yield View(tasks[episode], _picture_uri(picture), f"Episode {episode}: {text}", is_right)


def _how_sure(policy: DeltacoMatchPolicy, instruction: str, found: Found) -> str:
    """Returns how sure a policy is of what to pick, and which words count, as the end of a sentence."""
    words = [
        word if word == meant else f"{word} ({meant})"
        for word, meant in policy.feature_matching.understood(instruction)
    ]
    return f"; {100 * found.p_pick[0]:.0f} % sure; words for the object: {', '.join(words) or 'none'}"


def _check_features(config: TaskConditionedConfig, dataset: LeRobotDataset) -> None:
    """Checks that a dataset has the policy's observations.

    Raises:
        ValueError: It does not.
    """
    features = dataset.meta.features
    missing = [name for name in (*(config.input_features or {}), ACTION) if name not in features]
    if missing:
        raise ValueError(
            f"The policy needs {missing[0]!r}, which {dataset.repo_id} does not have. Its features are "
            f"{', '.join(name for name in features if name.startswith(('observation', 'action')))}."
        )
    for name, feature in (config.input_features or {}).items():
        shape = tuple(features[name]["shape"])
        if name not in config.image_features and shape != tuple(feature.shape):
            raise ValueError(
                f"{dataset.repo_id} is of another robot: its {name!r} has the shape {shape}, that of the "
                f"policy {tuple(feature.shape)}. Name a dataset of the policy's robot."
            )


def _partner(tasks: Sequence[str], episode: int) -> int:
    """Returns another episode of the same task, or the episode itself if there is none."""
    same = [n for n, task in enumerate(tasks) if task == tasks[episode]]
    return same[(same.index(episode) + 1) % len(same)]


def _spread(n: int, n_chosen: int) -> list[int]:
    """Returns at most `n_chosen` of the numbers below n, evenly spread."""
    return np.linspace(0, n - 1, min(n, n_chosen)).round().astype(int).tolist()


def _picture_uri(picture: Image.Image) -> str:
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=90)
    return _data_uri("image/jpeg", buffer.getvalue())


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
