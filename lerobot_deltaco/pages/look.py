"""`deltaco look`: a page with pictures of where a policy looks, in a dataset or the benchmark."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from numpy.typing import NDArray
from tqdm import tqdm

from gym_deltaco.atomic_files import write_text
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import get_task, select_tasks
from lerobot_deltaco.data.demonstrations import as_uint8, read_demonstrations, read_robot_data
from lerobot_deltaco.data.reading import open_folder_or_hub
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.checkpoints import LoadedPolicy
from lerobot_deltaco.evaluation.video import (
    benchmark_env,
    find_demonstration,
    load_conditioned,
    record_episode,
)
from lerobot_deltaco.pages.arguments import LookArguments
from lerobot_deltaco.pages.html import data_uri, picture_uri, render
from lerobot_deltaco.pages.pictures import (
    MIN_SIDE,
    PICK_COLOR,
    PLACE_COLOR,
    demonstration_ends,
    draw_found,
    encode_video,
)
from lerobot_deltaco.policies.base.configuration import TaskConditionedConfig
from lerobot_deltaco.policies.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy, Found

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

# A location is right within this distance from the recorded one: a tenth of the image's side. In the
# benchmark, the centers of objects are at least 0.26 apart.
TOLERANCE = 0.2
_BENCHMARK_TASKS, _BENCHMARK_SEED = "scenario_a_test", 1000  # the first trial of the evaluation protocol


def look(arguments: LookArguments) -> str:
    """Draws where a policy looks in episodes of a dataset or of the benchmark, on one self-contained page.

    Returns:
        How many are right, and where the page is.

    Raises:
        UserError: The policy finds no locations, or does not fit the dataset.
    """
    checkpoint, dataset, episodes = arguments.checkpoint, arguments.dataset, arguments.episodes
    loaded = load_conditioned(checkpoint)
    if not isinstance(loaded.policy, DeltacoMatchPolicy):
        raise UserError(
            f"{checkpoint} holds a policy of the type {loaded.policy.config.type!r}, which does not look for "
            "locations. `deltaco look` needs one of the type deltaco_match."
        )
    if dataset is None:
        results = ["Successful episodes"]
        views = _benchmark_views(loaded, episodes)
    else:
        results = [f"Episodes with the right {what} location" for what in ("pick", "place")]
        views = _dataset_views(loaded, open_folder_or_hub(dataset), episodes)
    shown = list(tqdm(views, desc="Looking", unit="episode", total=episodes))
    rates = []
    for n, text in enumerate(results):
        known = [view["right"][n] for view in shown if view["right"][n] is not None]
        rates += [(text, sum(known), len(known))] if known else []
    page = arguments.out / "index.html"
    content = render(
        "look.html",
        checkpoint=checkpoint,
        source=dataset or "scenes of the benchmark",
        views=shown,
        rates=rates,
        tolerance=None if dataset is None else TOLERANCE,
        pick_color=f"rgb{PICK_COLOR}",
        place_color=f"rgb{PLACE_COLOR}",
    )
    write_text(page, content)
    return "\n".join([*(f"{text}: {n_right} of {n}" for text, n_right, n in rates), f"See {page}."])


def _benchmark_views(loaded: LoadedPolicy, n_episodes: int) -> Iterator[dict[str, Any]]:
    """Runs episodes of the benchmark's test tasks, and yields each as the page shows it."""
    policy, env = loaded.policy, benchmark_env(loaded.policy.config, MIN_SIDE)
    task_ids = select_tasks(_BENCHMARK_TASKS)
    for index in _spread(len(task_ids), n_episodes):
        task = get_task(task_ids[index])
        shown = (
            [find_demonstration(policy, task, env.scene_config)] if policy.config.uses_demonstrations else []
        )
        seed = episode_seed(0, "evaluation", task.index, 0, _BENCHMARK_SEED)
        recording = record_episode(loaded, env, task.index, seed, task.instruction, shown)
        assert recording.found is not None
        ends = demonstration_ends(shown[0]) if shown else None
        picture = picture_uri(draw_found(recording.frames[0], ends, recording.found))
        video = data_uri("video/mp4", encode_video(recording.frames))
        is_success = bool(recording.info["is_success"])
        text = f"Task {task.index}: {'success' if is_success else 'failure'}"
        text += _how_sure(policy, task.instruction, recording.found)
        yield {
            "title": task.instruction,
            "picture": picture,
            "text": text,
            "right": (is_success,),
            "video": video,
        }
    env.close()


def _dataset_views(
    loaded: LoadedPolicy, dataset: LeRobotDataset, n_episodes: int
) -> Iterator[dict[str, Any]]:
    """Finds the locations in first images of episodes, with other episodes as demonstrations."""
    policy, config, meta = loaded.policy, loaded.policy.config, dataset.meta
    _check_features(config, dataset)
    tasks = [names[0] for names in meta.episodes["tasks"]]
    data = read_robot_data(dataset, range(len(tasks)))
    keyframes = policy.keyframes_of(data)
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
        observation = {name: item[name] for name in config.input_features}
        observation |= {name: as_uint8(item[name]).float() / 255 for name in config.cameras}
        policy.reset()
        policy.set_tasks([tasks[episode]], [shown])
        with torch.inference_mode():
            policy.select_action(loaded.preprocessor({**observation, "task": tasks[episode]}))
        found: Found = policy.found
        recorded, right, text = None, (None, None), "no grasp is recorded"
        if bool(keyframes.has_grasp[episode]):
            states = keyframes.states[episode].to(config.device)
            recorded = policy.robot_states.to_image(states).clamp(-1, 1).cpu()
            distances = (found.locations[0].cpu() - recorded).norm(dim=1)
            right = tuple((distances < TOLERANCE).tolist())
            pick, place = (50 * distances).tolist()
            text = (
                f"pick and place locations {pick:.0f} and {place:.0f} % of the image's side from the recorded"
            )
        if bank is not None:
            own = partners[episode] == episode
            text += ", demonstrated by " + ("itself" if own else f"episode {partners[episode]}")
        text += _how_sure(policy, tasks[episode], found)
        ends = None
        if shown:
            ends = np.stack(
                [_image(dataset, row, config.cameras[0]) for row in data.spans[partners[episode]]]
            )
        picture = draw_found(
            _image(dataset, data.spans[episode][0], config.cameras[0]), ends, found, 0, recorded
        )
        yield {
            "title": tasks[episode],
            "picture": picture_uri(picture),
            "text": f"Episode {episode}: {text}",
            "right": right,  # whether the pick and the place location are right; None if that is not known
            "video": None,
        }


def _image(dataset: LeRobotDataset, row: int, camera: str) -> NDArray[np.uint8]:
    """Returns an image at the camera's own resolution, (H, W, 3)."""
    return as_uint8(dataset[row][camera]).permute(1, 2, 0).numpy()


def _how_sure(policy: DeltacoMatchPolicy, instruction: str, found: Found) -> str:
    """Returns how sure a policy is of what to pick, and which words count, as the end of a sentence."""
    words = [
        word if word == meant else f"{word}, understood as {meant}"
        for word, meant in policy.feature_matching.understood(instruction)
    ]
    return f"; {100 * found.p_pick[0]:.0f} % sure; words for the object: {', '.join(words) or 'none'}"


def _check_features(config: TaskConditionedConfig, dataset: LeRobotDataset) -> None:
    """Checks that a dataset has the policy's observations.

    Raises:
        UserError: It does not.
    """
    features = dataset.meta.features
    missing = [name for name in (*(config.input_features or {}), ACTION) if name not in features]
    if missing:
        raise UserError(
            f"The policy needs {missing[0]!r}, which {dataset.repo_id} does not have. Its features are "
            f"{', '.join(name for name in features if name.startswith(('observation', 'action')))}."
        )
    for name, feature in (config.input_features or {}).items():
        shape = tuple(features[name]["shape"])
        if name not in config.image_features and shape != tuple(feature.shape):
            raise UserError(
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
