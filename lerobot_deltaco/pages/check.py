"""`deltaco check`: shows what a policy would take from a dataset, before it is trained.

What it shows is made by the training's own code, up to the point at which the training would refuse.
"""

from __future__ import annotations

import logging
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

import numpy as np
import psutil
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE
from PIL import Image
from scipy.stats import binomtest
from torch import Tensor
from torch.utils.data import default_collate
from tqdm import tqdm

from lerobot_deltaco.data.demonstrations import DemonstrationBank
from lerobot_deltaco.data.frames import FramesInMemory, memory_for_frames
from lerobot_deltaco.data.grasps import Grasp, find_grasps
from lerobot_deltaco.data.gripper_states import GripperStates, find_gripper_states
from lerobot_deltaco.data.images import as_uint8, read_images, resize_images
from lerobot_deltaco.data.pauses import paused_frames
from lerobot_deltaco.data.reading import dimension_names, episode_spans, open_folder_or_hub
from lerobot_deltaco.data.training_data import DatasetEpisodes, TrainingData, read_robot_data
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.pages.arguments import CheckArguments, list_of_numbers
from lerobot_deltaco.pages.crops import demonstrated_crop
from lerobot_deltaco.pages.html import picture_uri, write_page
from lerobot_deltaco.policies.deltaco_match.configuration_deltaco_match import DeltacoMatchConfig
from lerobot_deltaco.policies.deltaco_match.findings import (
    PICK_COLOR,
    PLACE_COLOR,
    draw_mark,
)
from lerobot_deltaco.policies.deltaco_match.fit import EpisodePairs
from lerobot_deltaco.policies.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy
from lerobot_deltaco.policies.scene.proposals import N_OBJECTS
from lerobot_deltaco.training.train import image_size_in_memory

_PICTURE_HEIGHT = 180  # px
_MAX_FITTED = 300  # episodes, for which the fit takes about a minute
_ENOUGH = 70  # percent of the objects that are found, from which on a policy is worth training
# A camera stands still if at least this fraction of the edges in an episode's first image stay where they
# are: of the benchmark's fixed cameras 0.6 to 0.8, of its wrist camera below 0.1.
_MIN_STAYING, _COMPARED_SIZE, _EDGES, _SAME = 0.4, 48, 0.2, 0.5
_TIMED_STEPS, _DESCRIBED_EPISODES = 3, 16


class TrainingStart:
    """What training would make of a dataset before its first step, as far as it gets.

    Args:
        dataset: The dataset.
        config: Configuration of the policy.

    Attributes:
        refusal: Why training would refuse; None if it would not.
        warnings: What training would warn of.
        bytes: Memory for the frames.
        reading: Time to read the frames, s.
        policy: The policy; None if the configuration does not fit the dataset.
        bank: The episodes as demonstrations; None if they were not read.
        grasps: The grasp of each episode, or why there is none; empty if unknown.
        gripper_states: Dimensions of the state that tell how far the gripper is open; None if unknown.
    """

    def __init__(self, dataset: LeRobotDataset, config: DeltacoMatchConfig) -> None:
        self.dataset, self.config = dataset, config
        self.refusal: str | None = None
        self.bytes = 0
        self.reading = 0.0
        self.policy: DeltacoMatchPolicy | None = None
        self.bank: DemonstrationBank | None = None
        self.grasps: list[Grasp | str] = []
        self.gripper_states: GripperStates | None = None
        with _warnings() as self.warnings:
            try:
                self._begin()
            except (UserError, MemoryError) as error:
                self.refusal = str(error)

    def _begin(self) -> None:
        dataset, config = self.dataset, self.config
        size = image_size_in_memory(dataset, config)
        self.bytes = memory_for_frames(dataset, size)
        self.policy = make_policy(config, ds_meta=dataset.meta).train()
        began = time.perf_counter()
        frames = FramesInMemory(dataset, size)
        self.reading = time.perf_counter() - began
        data = TrainingData.read(frames, config.demonstration_format)
        self.bank, robot, command = data.demonstrations, data.robot, config.gripper_command
        assert robot is not None
        assert command is not None
        opening = command.opening(robot.actions)
        self.grasps = find_grasps(opening, robot.spans, command.usual_range, robot.states)
        self.gripper_states = find_gripper_states(robot.states, opening, robot.spans, robot.state_names)
        self.policy.fit_locations(data.to(self.policy.step.device))
        if len(self.bank) <= _MAX_FITTED:
            self.policy.fit_matching()
            return
        with_grasp = zip(self.bank.tasks, self.grasps, strict=True)
        EpisodePairs([task for task, grasp in with_grasp if isinstance(grasp, Grasp)])

    @property
    def locations(self) -> Tensor | None:
        """Pick and place locations of the episodes, (episodes, 2, 2) in -1..1; None if they are not known."""
        known = None if self.policy is None else self.policy.training_locations
        return None if known is None else known.locations.cpu()

    @property
    def has_crops(self) -> bool:
        """Whether it is known how large the objects' crops are."""
        return self.policy is not None and bool(self.policy.localizer.matching.fitted)


def check(arguments: CheckArguments) -> str:
    """Shows what a policy would take from a dataset, on one self-contained page.

    Returns:
        The report.

    Raises:
        ValueError: Training would refuse the dataset; the message has the reason, and the report.
    """
    opened = open_folder_or_hub(arguments.dataset, list_of_numbers(arguments.dataset_episodes))
    config = DeltacoMatchConfig(**asdict(arguments.policy))
    start = TrainingStart(opened, config)
    tasks = DatasetEpisodes(opened).episode_tasks()
    views, staying = _read_episodes(start, tasks, arguments.episodes)
    dimensions = _dimensions(start)
    facts = _facts(start, staying, dimensions)
    if start.refusal is None:
        facts += _estimates(start, arguments.batch_size, arguments.steps)
    warnings = [*start.warnings, *_advice(start, tasks, staying)]
    found = Counter(
        task for task, grasp in zip(tasks, start.grasps, strict=False) if isinstance(grasp, Grasp)
    )
    counts = [(task, n, found[task]) for task, n in Counter(tasks).items()]
    page = write_page(
        arguments.out,
        "check.html",
        source=arguments.dataset,
        refusal=start.refusal,
        warnings=warnings,
        facts=facts,
        tasks=counts,
        dimensions=dimensions,
        views=views,
        n_episodes=len(tasks),
        has_locations=start.locations is not None,
        has_crops=start.has_crops,
    )
    lines = [
        *(f"{name + ':':15} {text}" for name, text in facts),
        *(f"task:           {n} episodes, {n_found} with a grasp: {task}" for task, n, n_found in counts),
        *(f"left out:       episode {view['number']}: {view['text']}" for view in views if not view["lines"]),
        *(f"warning:        {warning}" for warning in warnings),
        f"See {page}.",
    ]
    report = "\n".join(lines)
    if start.refusal is not None:
        raise UserError(f"Training would refuse this dataset. {start.refusal}\n{report}")
    return report


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Collects what the project warns of."""
    found: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: found.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger("lerobot_deltaco")
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield found
    finally:
        logger.removeHandler(handler)
        logger.propagate = True


# Episodes


def _read_episodes(
    start: TrainingStart, tasks: Sequence[str], n_shown: int
) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Returns episodes for the page, and for each camera the fraction of edges that stay where they are."""
    dataset, config, meta = start.dataset, start.config, start.dataset.meta
    cameras = [name for name in meta.camera_keys if name not in meta.depth_keys]
    demo_camera = config.cameras[0] if start.policy is not None else next(iter(cameras), None)
    grasps: Sequence[Grasp | str] = start.grasps or [""] * len(tasks)
    is_left_out = [isinstance(grasp, str) and bool(start.grasps) for grasp in grasps]
    left_out = np.flatnonzero(is_left_out)[:n_shown].tolist()
    others = np.flatnonzero(np.logical_not(is_left_out))
    n_others = min(len(others), n_shown - len(left_out))
    chosen = left_out + others[np.linspace(0, len(others) - 1, n_others).round().astype(int)].tolist()
    gripper = config.gripper_index if start.grasps else None
    actions = np.stack(dataset.hf_dataset.with_format("numpy")[ACTION]) if gripper is not None else None
    views, staying, spans = [], defaultdict(list), list(episode_spans(dataset).items())
    for episode in tqdm(chosen, desc="Reading episodes", unit="episode", leave=False):
        (number, (first, last)), grasp = spans[episode], grasps[episode]
        times = np.linspace(first, last, 4).round().astype(int).tolist()
        if isinstance(grasp, Grasp):
            times = [first, grasp.grasp, grasp.release, last]
        try:
            images_of = {camera: read_images(dataset, camera, times) for camera in cameras}
        except UserError:  # which the refusal names
            images_of = {}
        for camera, found in images_of.items():
            staying[camera].append(_staying_edges(found[:3]))
        images = [] if demo_camera is None else list(images_of.get(demo_camera, ()))
        located = start.locations if isinstance(grasp, Grasp) else None
        marks = [] if located is None else list(zip(located[episode], (PICK_COLOR, PLACE_COLOR), strict=True))
        pictures = _strip(images, marks)
        if marks and start.has_crops:
            assert start.policy is not None
            assert start.bank is not None
            given = start.policy.batch_demonstrations([[start.bank[episode]]], start.policy.step.device)
            assert given is not None
            pictures.append(picture_uri(demonstrated_crop(start.policy.localizer.matching, given)))
        text = f"{(last - first + 1) / meta.fps:.1f} s"
        if is_left_out[episode]:
            text += f", left out: {grasp}"
        polyline, lines = "", list[float]()
        if actions is not None:
            values = actions[first : last + 1, gripper]
            heights = 1 - (values - values.min()) / max(np.ptp(values), 1e-9)
            at = np.linspace(0, 1, len(values))
            polyline = " ".join(f"{x:.3f},{y:.3f}" for x, y in zip(at, heights, strict=True))
            if isinstance(grasp, Grasp):
                lines = [round(float(at[time - first]), 3) for time in times[1:3]]
        views.append(
            {
                "number": number,
                "task": tasks[episode],
                "text": text,
                "pictures": pictures,
                "polyline": polyline,
                "lines": lines,
            }
        )
    return views, {camera: float(np.median(values)) for camera, values in staying.items()}


def _strip(images: Sequence[Tensor], marks: Sequence[tuple[Tensor, tuple[int, int, int]]]) -> list[str]:
    """Returns images (3, H, W) as data URIs, the first with marks at its locations."""
    found = []
    for n, image in enumerate(images):
        picture = Image.fromarray(as_uint8(image).permute(1, 2, 0).numpy())
        width = round(picture.width * _PICTURE_HEIGHT / picture.height)
        picture = picture.resize((width, _PICTURE_HEIGHT), Image.Resampling.BICUBIC)
        for (location, color), name in zip(marks if n == 0 else [], ("pick", "place"), strict=False):
            draw_mark(picture, location.tolist(), color, name)
        found.append(picture_uri(picture))
    return found


def _staying_edges(images: Tensor) -> float:
    """Returns the fraction of the edges in the first of some images that are also in the others."""
    gray = resize_images(images, _COMPARED_SIZE).float().mean(dim=1)
    changes = [gray.diff(dim=dim).flatten(1) for dim in (1, 2)]
    edges = torch.cat(changes, dim=1)
    first, others = edges[0], edges[1:]
    strong = first.abs() > first.abs().quantile(1 - _EDGES)
    if not bool(strong.any()):
        return 0.0
    return ((others - first).abs() < _SAME * first.abs())[:, strong].float().mean().item()


# Facts and advice


def _dimensions(start: TrainingStart) -> dict[str, list[tuple[str, float, float]]]:
    """Returns the name, the minimum and the maximum of each dimension of the state and the action."""
    found, meta = {}, start.dataset.meta
    for feature in (OBS_STATE, ACTION):
        if feature in meta.features and feature in meta.stats:
            low, high = (np.ravel(meta.stats[feature][end]).tolist() for end in ("min", "max"))
            # Names that cannot be read are an error of the policy.
            names = dimension_names(meta.features[feature], feature) if start.policy is not None else []
            found[feature] = list(zip(names or map(str, range(len(low))), low, high, strict=True))
    return found


def _facts(
    start: TrainingStart, staying: dict[str, float], dimensions: dict[str, list[tuple[str, float, float]]]
) -> list[tuple[str, str]]:
    """Returns what a policy would take from the dataset, each fact with its name."""
    dataset, config, meta = start.dataset, start.config, start.dataset.meta
    facts = [
        (
            "dataset",
            f"{dataset.num_episodes} episodes, {dataset.num_frames:,} frames, {meta.fps} per second",
        )
    ]
    for camera, fraction in staying.items():
        is_chosen = bool(config.image_features) and camera == config.cameras[0]
        does = "stands still" if fraction >= _MIN_STAYING else "moves"
        text = f"{camera} {does} ({100 * fraction:.0f} % of the edges stay where they are)"
        facts.append(("demo camera" if is_chosen else "camera", text))
    if start.grasps:
        n_found = sum(isinstance(grasp, Grasp) for grasp in start.grasps)
        closing = f"{config.name_gripper(meta.features)}; {config.gripper_closed} values close it"
        facts.append(("gripper", closing))
    if start.gripper_states is not None:
        chosen = start.gripper_states.is_gripper.nonzero().flatten().tolist()
        names = ((n, dimensions[OBS_STATE][n][0]) for n in chosen)
        states = ", ".join(f"{n}" if name == str(n) else f"{n} ({name})" for n, name in names)
        which = f"dimension {states} of the state" if states else "nothing in the state"
        facts.append(("its state", f"{which}, {start.gripper_states.reason}; the rest is the arm's"))
    if start.grasps:
        facts.append(("grasps", f"in {n_found} of {len(start.grasps)} episodes; others are left out"))
    if start.refusal is None and start.policy is not None:
        facts.append(("finding", _finding(start.policy)))
    for feature, rows in dimensions.items():
        arm = [ends for name, *ends in rows if "gripper" not in name.lower()] or [[0.0, 0.0]]
        low, high = min(low for low, _ in arm), max(high for _, high in arm)
        greatest = max(-low, high)
        unit = "radians" if greatest <= 2 * np.pi else "degrees, or LeRobot's -100..100"
        unit = "-1..1, or meters" if greatest <= 1 else unit
        facts.append(("units", f"{feature}: from {low:.4g} to {high:.4g}, so probably {unit}"))
    if OBS_STATE in meta.features:
        robot = read_robot_data(DatasetEpisodes(dataset), config.demonstration_format)
        assert robot is not None
        paused = paused_frames(robot, dataset.fps)
        facts.append(("pauses", f"the robot stands still in {100 * paused.mean():.0f} % of the frames"))
    return facts


def _finding(policy: DeltacoMatchPolicy) -> str:
    """Returns how often the object is found where that was not learned, and what to make of it."""
    matching = policy.localizer.matching
    if not bool(matching.fitted):
        return f"not tried with more than {_MAX_FITTED} episodes; training tells after its fit"
    n_right, n_all = matching.held_out.tolist()
    if not n_all:
        return f"{matching.report}: record more episodes of each task"
    interval = binomtest(n_right, n_all).proportion_ci(method="wilson")
    low, high = 100 * interval.low, 100 * interval.high
    verdict = "enough for new scenes of these tasks"
    if low < _ENOUGH:
        verdict = "too few episodes are held out to tell whether that is enough: record more of each task"
    if high < _ENOUGH:
        verdict = "not enough for new scenes: record more episodes, and larger or clearer images"
    return f"{matching.report} ({low:.0f} to {high:.0f} %): {verdict}"


def _advice(start: TrainingStart, tasks: Sequence[str], staying: dict[str, float]) -> list[str]:
    """Returns what training does not warn of."""
    config, advice = start.config, list[str]()
    single = [task for task, n in Counter(tasks).items() if n == 1]
    if single:
        advice.append(
            f"{len(single)} tasks have a single episode, which demonstrates itself, such as {single[0]!r}. "
            "Record at least two."
        )
    if config.image_features and staying.get(config.cameras[0], 1.0) < _MIN_STAYING:
        still = [camera for camera, fraction in staying.items() if fraction >= _MIN_STAYING]
        other = f"Set --policy.demo_camera={still[0]}." if still else "No camera of the dataset does."
        advice.append(
            f"The demonstration camera, {config.cameras[0]}, must stand still, but seems to move. {other}"
        )
    return advice


# Time and memory


def _estimates(start: TrainingStart, batch_size: int, steps: int) -> list[tuple[str, str]]:
    """Measures a few steps of training, and returns what all of it would take."""
    dataset, config, policy, bank = start.dataset, start.config, start.policy, start.bank
    assert policy is not None
    assert bank is not None
    windows = resolve_delta_timestamps(config, dataset.meta)
    timed = LeRobotDataset(
        dataset.repo_id, dataset.root, dataset.episodes, delta_timestamps=windows, return_uint8=True
    )
    batch = default_collate([timed[n % len(timed)] for n in range(batch_size)])
    for camera in dataset.meta.camera_keys:
        batch[camera] = resize_images(batch[camera], config.image_size).float() / 255
    batch = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)[0](batch)
    optimizer = config.get_optimizer_preset().build(policy.get_optim_params())
    for n in range(1 + _TIMED_STEPS):
        if n == 1:  # the first step is slower
            began = time.perf_counter()
        policy.forward(batch)[0].backward()
        optimizer.step()
        optimizer.zero_grad()
    per_step = (time.perf_counter() - began) / _TIMED_STEPS
    # Crops of all proposals are encoded, which is most of the fit.
    ends = bank.frames[:_DESCRIBED_EPISODES, [0, -1]]
    full_resolution = ends[:, 0] if bank.first_images is None else bank.first_images[:_DESCRIBED_EPISODES]
    middle = torch.zeros(len(ends), 2, device=ends.device)
    began = time.perf_counter()
    policy.localizer.matching.describe(ends.float() / 255, full_resolution, middle, middle)
    per_crop = (time.perf_counter() - began) / len(ends)
    fit = min(len(bank), policy.localizer.matching.settings.max_episodes) * N_OBJECTS * per_crop
    total = start.reading + fit + steps * per_step
    memory = start.bytes + psutil.Process().memory_info().rss
    return [
        (
            "time",
            f"about {total / 60:.0f} minutes on this machine ({config.device}) for {steps:,} steps of "
            f"{batch_size}: {start.reading / 60:.1f} to read the frames, {fit / 60:.1f} to encode crops for "
            f"the feature matching, {1000 * per_step:.0f} ms a step",
        ),
        ("memory", f"about {memory / 1e9:.1f} GB, of which the frames take {start.bytes / 1e9:.2f}"),
    ]
