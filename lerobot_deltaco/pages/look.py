"""`deltaco look`: a page with pictures of where a policy looks, in a dataset or the benchmark."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from numpy.typing import NDArray
from tqdm import tqdm

from gym_deltaco.tasks import select_tasks
from lerobot_deltaco.data.demonstrations import Demonstration
from lerobot_deltaco.data.grasps import find_grasp_states
from lerobot_deltaco.data.gripper_states import find_gripper_states
from lerobot_deltaco.data.images import as_uint8
from lerobot_deltaco.data.object_prompts import ObjectPrompt, read_prompt
from lerobot_deltaco.data.reading import open_folder_or_hub
from lerobot_deltaco.data.training_data import DatasetEpisodes, read_demonstrations, read_robot_data
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.checkpoints import LoadedPolicy
from lerobot_deltaco.evaluation.video import load_conditioned
from lerobot_deltaco.pages.arguments import LookArguments, PromptOptions, list_of_numbers
from lerobot_deltaco.pages.crops import compared_crops
from lerobot_deltaco.pages.html import EpisodeView, picture_uri, write_page
from lerobot_deltaco.pages.player import Player
from lerobot_deltaco.pages.verdict import TOLERANCE
from lerobot_deltaco.policies.base.configuration import TaskConditionedConfig
from lerobot_deltaco.policies.deltaco_match.configuration_deltaco_match import DeltacoMatchConfig
from lerobot_deltaco.policies.deltaco_match.findings import (
    PICK_COLOR,
    PLACE_COLOR,
    describe_words,
    draw_localization,
)
from lerobot_deltaco.policies.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

_BENCHMARK_TASKS, _BENCHMARK_SEED = "scenario_a_test", 1000  # the first trial of the evaluation protocol

POLICY, UNMOVED, STILL = "this policy", "the demonstration, not moved", "holding still"


class Judged(NamedTuple):
    """An episode that was looked at.

    Attributes:
        view: The episode.
        rights: Whether it is right in each respect that the page counts; empty if that is unknown.
        errors: Distances of the arm from where it grasped and released in the episode, in standard deviations
            of the training's states, averaged over dimensions: by the policy, and by what knows nothing of
            the scene.
    """

    view: EpisodeView
    rights: tuple[bool, ...]
    errors: dict[str, float]


def look(arguments: LookArguments) -> str:
    """Draws where a policy looks in episodes of a dataset or of the benchmark, on one self-contained page.

    Returns:
        How many are right, and where the page is.

    Raises:
        ValueError: The policy finds no locations, or does not fit the dataset.
    """
    checkpoint, dataset = arguments.checkpoint, arguments.dataset
    held_out: list[int] = []
    loaded = load_conditioned(checkpoint)
    if not isinstance(loaded.policy, DeltacoMatchPolicy):
        raise UserError(
            f"{checkpoint} holds a policy of the type {loaded.policy.config.type!r}, which does not look for "
            "locations. `deltaco look` needs one of the type deltaco_match."
        )
    if dataset is None:
        names = ["Successful episodes"]
        episodes = _benchmark_episodes(loaded, arguments.episodes)
    else:
        names = [f"Episodes with the right {what} location" for what in ("pick", "place")]
        chosen = list_of_numbers(arguments.dataset_episodes)
        prompt = _prompt(arguments.policy, loaded.policy.config)
        opened = open_folder_or_hub(dataset, chosen)
        held_out = [] if chosen else _held_out_episodes(loaded.policy.config, opened)
        episodes = _dataset_episodes(loaded, opened, arguments.episodes, prompt, held_out)
    judged = list(tqdm(episodes, desc="Looking", unit="episode", total=arguments.episodes))
    known = np.array([each.rights for each in judged if each.rights])
    errors = {
        name: float(np.median([each.errors[name] for each in judged if name in each.errors]))
        for name in (POLICY, UNMOVED, STILL)
        if any(name in each.errors for each in judged)
    }
    rates = [(name, int(known[:, n].sum()), len(known)) for n, name in enumerate(names) if len(known)]
    page = write_page(
        arguments.out,
        "look.html",
        checkpoint=checkpoint,
        source=dataset or "scenes of the benchmark",
        views=[each.view for each in judged],
        rates=rates,
        errors=errors,
        tolerance=None if dataset is None else TOLERANCE,
        pick_color=f"rgb{PICK_COLOR}",
        place_color=f"rgb{PLACE_COLOR}",
    )
    lines = [f"{name}: {n_right} of {n}" for name, n_right, n in rates]
    if errors:
        compared = ", ".join(f"{name} {error:.2f}" for name, error in errors.items())
        lines.append(f"Arm at grasp and release, median error in standard deviations: {compared}")
    if dataset is not None:
        lines.append(
            "These episodes were held out of the fit of what to pick; where to place was trained on them."
            if held_out
            else "These say little if the policy was trained on the episodes."
        )
        lines.append(f"Its fit: {loaded.policy.localizer.matching.report}.")
    return "\n".join([*lines, f"See {page}."])


def _benchmark_episodes(loaded: LoadedPolicy, n_episodes: int) -> Iterator[Judged]:
    """Runs episodes of the benchmark's test tasks."""
    player, task_ids = Player(loaded), select_tasks(_BENCHMARK_TASKS)
    for index in _spread(len(task_ids), n_episodes):
        view = player.run(player.default_choice(task_ids[index], _BENCHMARK_SEED))
        yield Judged(view, (view.is_right is True,), {})


def _prompt(options: PromptOptions, config: TaskConditionedConfig) -> ObjectPrompt | None:
    """Returns the object that options show in place of demonstrations."""
    if options == PromptOptions():
        return None
    _, height, width = config.image_features[config.cameras[0]].shape
    return read_prompt(list_of_numbers(options.demo_point), options.demo_photo, (width, height))


def _dataset_episodes(
    loaded: LoadedPolicy,
    dataset: LeRobotDataset,
    n_episodes: int,
    prompt: ObjectPrompt | None,
    held_out: Sequence[int],
) -> Iterator[Judged]:
    """Localizes in the first images of episodes, by other episodes as demonstrations or by a prompt.

    Args:
        loaded: The policy.
        dataset: The dataset.
        n_episodes: Number of episodes.
        prompt: What shows the object in place of other episodes.
        held_out: Episodes to choose from; empty for all.
    """
    policy, config = loaded.policy, loaded.policy.config
    camera = config.cameras[0]
    _check_features(config, dataset)
    recorded_episodes, form = DatasetEpisodes(dataset), config.demonstration_format
    tasks, indices = recorded_episodes.episode_tasks(), list(recorded_episodes.spans)
    data = read_robot_data(recorded_episodes, form)
    assert data is not None
    assert form.gripper is not None
    opening = form.gripper.opening(data.actions)
    grasps = find_grasp_states(data.states, opening, data.spans, form.gripper.usual_range)
    is_arm = ~find_gripper_states(data.states, opening, data.spans, data.state_names).is_gripper
    candidates = [n for n, index in enumerate(indices) if not held_out or index in held_out]
    numbers = [candidates[n] for n in _spread(len(candidates), n_episodes)]
    partners = {episode: _partner(tasks, episode) for episode in numbers}
    bank = None
    if config.uses_demonstrations and prompt is None:
        needed = [indices[partner] for partner in sorted(set(partners.values()))]
        bank = read_demonstrations(DatasetEpisodes(dataset, needed), form)
    for episode in numbers:
        task, partner = tasks[episode], partners[episode]
        item = dataset[data.spans[episode][0]]
        observation = {name: item[name] for name in config.input_features}
        observation |= {name: as_uint8(item[name]).float() / 255 for name in config.cameras}
        policy.reset()
        given: list[Demonstration | ObjectPrompt] = [] if prompt is None else [prompt]
        if bank is not None:
            given = [bank.of_episode(indices[partner])]
        policy.set_tasks([task], [given])
        with torch.inference_mode():
            policy.select_action(loaded.preprocessor({**observation, "task": task}))
        localization = policy.localization
        where = f"Episode {indices[episode]}"
        if bank is not None:
            where += ", demonstrated by " + (
                "itself" if partner == episode else f"episode {indices[partner]}"
            )
        elif prompt is not None:
            where += ", where a point shows the object" if prompt.image is None else ", by a photo"
        rights, headline, recorded, errors = (), "No grasp found", None, {}
        if bool(grasps.has_grasp[episode]):
            states = grasps.states[episode].to(config.device)
            recorded = policy.state_regressor.to_image(states).clamp(-1, 1).cpu()
            distances = (localization.locations[0].cpu() - recorded).norm(dim=1)
            rights = tuple((distances < TOLERANCE).tolist())
            pick, place = (50 * distances).tolist()
            headline = f"Pick off by {pick:.1f} %, place by {place:.1f} % of the image's side"
            guesses = {POLICY: policy.localized_states[0].cpu()}
            if bank is not None and partner != episode and bool(grasps.has_grasp[partner]):
                guesses[UNMOVED] = grasps.states[partner]
            guesses[STILL] = data.states[data.spans[episode][0]].expand(2, -1)
            scale = policy.state_regressor.state_scale.cpu()
            errors = {
                name: float(((guess - grasps.states[episode]) * scale)[:, is_arm].abs().mean())
                for name, guess in guesses.items()
            }
        ends = None
        if bank is not None:
            ends = np.stack([_image(dataset, row, camera) for row in data.spans[partner]])
        images = {camera: observation[camera][None].to(config.device)}
        image = policy.undo_camera_motion(images, localization.camera_motion)[camera][0]
        scene = as_uint8(image).permute(1, 2, 0).cpu().numpy()
        picture = picture_uri(draw_localization(scene, ends, localization, recorded))
        matching = policy.localizer.matching
        words = describe_words(matching, task)
        sure = f"{100 * localization.confidence.item():.0f} % sure of the object. {words}"
        is_right = all(rights) if rights else None
        crops = [picture_uri(crop) for crop in compared_crops(matching, localization, image, *given)]
        lines = [f"{where}.", sure]
        view = EpisodeView(task, "", [], is_right, headline, lines, picture, None, crops)
        yield Judged(view, rights, errors)


def _held_out_episodes(config: DeltacoMatchConfig, dataset: LeRobotDataset) -> list[int]:
    """Returns the episodes that were held out of the fit, if the policy was trained on this dataset."""
    is_training_dataset = config.n_dataset_frames == dataset.meta.total_frames
    return config.held_out_episodes if is_training_dataset else []


def _image(dataset: LeRobotDataset, row: int, camera: str) -> NDArray[np.uint8]:
    """Returns an image at the camera's full resolution, (H, W, 3)."""
    return as_uint8(dataset[row][camera]).permute(1, 2, 0).numpy()


def _check_features(config: TaskConditionedConfig, dataset: LeRobotDataset) -> None:
    """Checks that a dataset has the policy's observations.

    Raises:
        ValueError: A feature is missing or has another shape.
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


def _spread(n: int, n_selected: int) -> list[int]:
    """Returns at most `n_selected` of the numbers below n, evenly spread."""
    return np.linspace(0, n - 1, min(n, n_selected)).round().astype(int).tolist()
