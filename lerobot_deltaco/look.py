"""Pictures and videos of where a policy looks: `deltaco look`, on any dataset or on scenes of the benchmark."""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import av
import jinja2
import numpy as np
import torch
from lerobot.utils.constants import ACTION
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from tqdm import tqdm

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.layout import Layout
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import Task, get_task, select_tasks
from lerobot_deltaco.base_config import TaskConditionedConfig
from lerobot_deltaco.base_policy import TaskConditionedPolicy
from lerobot_deltaco.checkpoints import LoadedPolicy, find_checkpoints, load_policy
from lerobot_deltaco.demonstrations import (
    Demonstration,
    kept_frames,
    open_dataset,
    read_demonstrations,
    read_robot_data,
)
from lerobot_deltaco.deltaco_match.keyframes import find_keyframes
from lerobot_deltaco.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy, Found
from lerobot_deltaco.evaluate import Episode, Simulators, run_episodes
from lerobot_deltaco.lerobot_env import check_policy_fits

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

# No object and no container of the benchmark has these colors. They differ in lightness, so that they can be
# told apart without color vision.
PICK_COLOR, PLACE_COLOR = (225, 0, 170), (90, 240, 255)
VIDEO_FPS = 8  # a third of the nominal frame rate, which is too fast to watch
# Distance from the recorded location within which a found one is right: a tenth of the image's side. In the
# benchmark, the centers of objects are at least 0.26 apart.
TOLERANCE = 0.2
_BENCHMARK_TASKS, _BENCHMARK_SEED = "scenario_a_test", 1000  # the first trial of the evaluation protocol
_EXPERT_ATTEMPTS = 20
_MIN_SIDE = 320  # px, below which a scene is enlarged
_OPACITY = 0.65  # of a map at its maximum
_HELD_SECONDS = 1.0  # for which the last frame of a video stays

Color = tuple[int, int, int]


# Pictures


def draw_found(
    scene: NDArray[np.uint8],
    demonstration_ends: NDArray[np.uint8] | None,
    found: Found,
    sample: int = 0,
    recorded: Tensor | None = None,
) -> Image.Image:
    """Draws where a policy looked: the scene at its full resolution, and at its left the demonstration.

    A magenta ring marks the pick location, a cyan square the place location.

    Args:
        scene: First image of the episode, (H, W, 3).
        demonstration_ends: First and last image of the demonstration, (2, h, w, 3); None without one.
        found: What the policy found.
        sample: Index of the episode in the batch of `found`.
        recorded: Pick and place locations in the dataset, (2, 2) in -1..1, which get white crosses.

    Returns:
        The picture. Scenes of less than 320 px are enlarged.
    """
    picture = Image.fromarray(scene)
    scale = _MIN_SIDE / min(picture.size)
    if scale > 1:
        size = (round(picture.width * scale), round(picture.height * scale))
        picture = picture.resize(size, Image.Resampling.BICUBIC)
    logits = found.maps[sample].float().cpu()
    picture = _overlay(picture, logits.flatten(1).softmax(dim=1).view_as(logits), (PICK_COLOR, PLACE_COLOR))
    if recorded is not None:
        for location in recorded.tolist():
            _draw_cross(picture, location)
    pick, place = found.locations[sample].tolist()
    _draw_mark(picture, pick, PICK_COLOR, "pick")
    _draw_mark(picture, place, PLACE_COLOR, "place")
    if demonstration_ends is None:
        return picture
    gap = max(4, picture.height // 80)
    height = (picture.height - gap) // 2
    width = round(height * demonstration_ends.shape[2] / demonstration_ends.shape[1])
    image = Image.new("RGB", (width + gap + picture.width, picture.height), "white")
    image.paste(picture, (width + gap, 0))
    for n, (end, color) in enumerate(zip(demonstration_ends, (PICK_COLOR, PLACE_COLOR), strict=True)):
        panel = Image.fromarray(end).resize((width, height), Image.Resampling.BICUBIC)
        if found.attention is not None and found.by_demonstration[n]:
            panel = _overlay(panel, found.attention[sample, n : n + 1].float().cpu(), (color,))
        image.paste(panel, (0, n * (height + gap)))
    return image


def _overlay(picture: Image.Image, maps: Tensor, colors: tuple[Color, ...]) -> Image.Image:
    """Lays maps (maps, h, w) of weights over a picture, each in its color."""
    for weights, color in zip(maps, colors, strict=True):
        # The square root shows less likely locations, too.
        relative = (weights / weights.max().clamp_min(1e-12)).sqrt().numpy()
        opacity = Image.fromarray(np.round(255 * _OPACITY * relative).astype(np.uint8))
        opacity = opacity.resize(picture.size, Image.Resampling.BILINEAR)
        picture = Image.composite(Image.new("RGB", picture.size, color), picture, opacity)
    return picture


def _pixel(picture: Image.Image, location: Sequence[float]) -> tuple[float, float]:
    return (location[0] + 1) / 2 * picture.width, (location[1] + 1) / 2 * picture.height


def _draw_mark(picture: Image.Image, location: Sequence[float], color: Color, name: str) -> None:
    """Draws a ring for a pick, or a square for a place, with its name."""
    draw, (x, y) = ImageDraw.Draw(picture), _pixel(picture, location)
    radius, line = min(picture.size) / 18, max(2, min(picture.size) // 130)
    outline = draw.ellipse if name == "pick" else draw.rectangle
    for reach, width, ink in ((radius + line, 3 * line, (0, 0, 0)), (radius, line, color)):
        outline((x - reach, y - reach, x + reach, y + reach), outline=ink, width=width)
    font = ImageFont.load_default(size=max(14, min(picture.size) // 22))
    is_low = y > picture.height / 2
    position = (x, y - radius - 2 * line) if is_low else (x, y + radius + 2 * line)
    anchor = "mb" if is_low else "mt"
    draw.text(position, name, "white", font, anchor, stroke_width=2, stroke_fill="black")


def _draw_cross(picture: Image.Image, location: Sequence[float]) -> None:
    draw, (x, y) = ImageDraw.Draw(picture), _pixel(picture, location)
    reach, line = min(picture.size) / 30, max(2, min(picture.size) // 130)
    for width, ink in ((3 * line, "black"), (line, "white")):
        draw.line((x - reach, y - reach, x + reach, y + reach), ink, width)
        draw.line((x - reach, y + reach, x + reach, y - reach), ink, width)


def demonstration_ends(demonstration: Demonstration) -> NDArray[np.uint8]:
    """Returns the first and the last image of a demonstration, (2, H, W, 3)."""
    return demonstration.frames[[0, -1]].permute(0, 2, 3, 1).cpu().numpy()


def write_video(frames: Sequence[NDArray[np.uint8]], path: Path, fps: int = VIDEO_FPS) -> None:
    """Writes an H.264 video in MP4, which browsers play. The last frame stays for a second.

    Args:
        frames: Images, (H, W, 3); an odd row or column is cut off.
        path: File to write.
        fps: Frames per second.
    """
    partial = path.with_name(f".{path.name}.part")
    height, width = (side // 2 * 2 for side in frames[0].shape[:2])
    with av.open(str(partial), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "20"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for image in (*frames, *[frames[-1]] * round(_HELD_SECONDS * fps)):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image[:height, :width]), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    os.replace(partial, path)


# Episodes of the benchmark


class Recording(NamedTuple):
    """A recorded episode of the benchmark.

    Attributes:
        frames: Rendered images before the first step and after each, (render_size, render_size, 3).
        observed: First image that the policy received, (H, W, 3).
        found: Locations that the policy found in it; None for policies that find none.
        info: Info of the environment after the last step.
        layout: Objects and containers of the scene.
        placed: Pairs of an object and a container in which it has come to rest.
    """

    frames: list[NDArray[np.uint8]]
    observed: NDArray[np.uint8]
    found: Found | None
    info: dict[str, Any]
    layout: Layout
    placed: frozenset[tuple[int, int]]


def record_episode(
    loaded: LoadedPolicy,
    task_id: int,
    seed: int,
    instruction: str,
    demonstrations: Sequence[Demonstration],
    scene: SceneConfig = SceneConfig(),  # noqa: B008
    render_size: int = 320,
    on_step: Callable[[int], None] | None = None,
    simulators: Simulators | None = None,
) -> Recording:
    """Runs an episode of the benchmark and records it.

    Args:
        loaded: The policy and its processors.
        task_id: Index of the task that the scene is drawn for.
        seed: Seed of the environment's reset.
        instruction: Instruction that the policy receives; empty for none.
        demonstrations: Demonstrations that the policy receives; empty for none.
        scene: Settings of the scene.
        render_size: Height and width of the frames, px.
        on_step: Called with the number of steps that have been run.
        simulators: Environments with the same scene and render size to use; None makes one.
    """
    frames: list[NDArray[np.uint8]] = []
    first: dict[str, Any] = {}
    placed: set[tuple[int, int]] = set()

    def record(envs: Sequence[PickPlaceEnv], observations: Sequence[Any]) -> None:
        env = envs[0]
        if not first:
            first.update(observed=observations[0]["pixels"], layout=env.scene.layout)
        image = env.render()
        assert image is not None
        frames.append(image)
        placed.update((n, env.scene.container_of(n)) for n in range(len(env.scene.bodies)))
        if on_step is not None:
            on_step(len(frames) - 1)

    own = simulators or Simulators(scene, render_size)
    try:
        with torch.inference_mode():
            episode = Episode(task_id, 0, seed, instruction, task_id if demonstrations else -1)
            (info,) = run_episodes(loaded, own, [episode], [demonstrations], record)
    finally:
        if simulators is None:
            own.close()
    in_containers = frozenset(pair for pair in placed if pair[1] >= 0)
    found = getattr(loaded.policy, "found", None)
    return Recording(frames, first["observed"], found, info, first["layout"], in_containers)


def record_demonstration(
    config: TaskConditionedConfig, task: Task, number: int = 0, scene: SceneConfig | None = None
) -> Demonstration:
    """Records a demonstration of a task by the scripted expert.

    Args:
        config: Configuration of the policy that the demonstration is for.
        task: The task.
        number: Number of the demonstration, which draws its scene.
        scene: Settings of the scene; None for the benchmark's with the policy's image size.

    Raises:
        RuntimeError: The expert has failed too often.
    """
    env = PickPlaceEnv(task.index, scene or benchmark_scene(config))
    try:
        for attempt in range(_EXPERT_ATTEMPTS):
            seed = episode_seed(0, "validation", task.index, number, attempt)
            steps = list(expert_episode(env, task.index, seed))
            if steps[-1].info["is_success"]:
                break
        else:
            raise RuntimeError(f"The expert failed {_EXPERT_ATTEMPTS} times at: {task.instruction}")
    finally:
        env.close()
    images = np.stack([step.observation["pixels"] for step in steps])
    frames = torch.from_numpy(images).permute(0, 3, 1, 2)
    pick_state = None
    if config.gripper_index is not None and config.state_dim:
        states = torch.from_numpy(np.stack([step.observation["agent_pos"] for step in steps]))
        gripper = config.gripper_opening(torch.from_numpy(np.stack([step.action for step in steps])))
        pick_state = find_keyframes(states, gripper, [(0, len(steps) - 1)]).pick_states[0]
    info = steps[-1].info
    return Demonstration(
        task.instruction,
        frames[kept_frames(0, len(frames) - 1, config.n_demo_frames)],
        pick_state,
        target_object=int(info["objects"][info["target_object"]]),
    )


def benchmark_scene(config: Any) -> SceneConfig:
    """Returns the benchmark's scene with the image size that a policy was trained on.

    Raises:
        ValueError: The policy is not one for the benchmark.
    """
    sizes = [feature.shape[-1] for feature in config.image_features.values()]
    scene = SceneConfig(image_size=sizes[0]) if sizes else SceneConfig()
    check_policy_fits(config, scene)
    return scene


def load_conditioned(checkpoint: str | Path) -> LoadedPolicy:
    """Loads a policy that takes a demonstration or an instruction.

    Args:
        checkpoint: Folder of a policy or of a training run, of which the last checkpoint is loaded; or id of a
            repository on the Hugging Face Hub.

    Raises:
        ValueError: There is no checkpoint, or its policy is of another kind.
    """
    folder = Path(checkpoint)
    if folder.exists() or len(folder.parts) != 2:
        folder = find_checkpoints(folder)[-1].folder
    loaded = load_policy(folder)
    if not isinstance(loaded.policy, TaskConditionedPolicy):
        raise ValueError(
            f"{checkpoint} holds a policy of the type {loaded.policy.config.type!r}, which takes no "
            "demonstrations. Name one of the type deltaco or deltaco_match."
        )
    return loaded


# `deltaco look`


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
    checkpoint: str | Path,
    repo_id: str | None = None,
    root: str | Path | None = None,
    episodes: int = 12,
    out: Path = Path("outputs/look"),
) -> Path:
    """Draws where a policy looks in episodes of a dataset or of the benchmark, on one self-contained page.

    Args:
        checkpoint: Checkpoint, as `load_conditioned` takes it.
        repo_id: Repository id of a LeRobotDataset; None with `root` takes the folder's name.
        root: Folder of the dataset; None for LeRobot's cache. Without `repo_id` and `root`, episodes of the
            benchmark's test tasks are run.
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
    text = _template().render(
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
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, page)
    return page


def _benchmark_views(loaded: LoadedPolicy, n_episodes: int, out: Path) -> Iterator[View]:
    """Runs episodes of the benchmark's test tasks."""
    policy, config = loaded.policy, loaded.policy.config
    scene, task_ids = benchmark_scene(config), select_tasks(_BENCHMARK_TASKS)
    simulators, video = Simulators(scene, _MIN_SIDE), out / "episode.mp4"
    for index in _spread(len(task_ids), n_episodes):
        task = get_task(task_ids[index])
        shown = []
        if config.uses_demonstrations:
            bank = policy.demonstrations
            is_known = bank is not None and task.instruction in bank.rows
            shown = [
                bank.of_task(task.instruction)[0] if is_known else record_demonstration(config, task, 0, scene)
            ]
        seed = episode_seed(0, "evaluation", task.index, 0, _BENCHMARK_SEED)
        recording = record_episode(
            loaded, task.index, seed, task.instruction, shown, scene, _MIN_SIDE, simulators=simulators
        )
        assert recording.found is not None
        ends = demonstration_ends(shown[0]) if shown else None
        picture = draw_found(recording.frames[0], ends, recording.found)
        write_video(recording.frames, video)
        is_success = bool(recording.info["is_success"])
        text = "success" if is_success else "failure"
        text = f"Task {task.index}: {text}"
        uri = _data_uri("video/mp4", video.read_bytes())
        video.unlink()
        yield View(task.instruction, _picture_uri(picture), text, is_success, uri)
    simulators.close()


def _dataset_views(loaded: LoadedPolicy, dataset: LeRobotDataset, n_episodes: int) -> Iterator[View]:
    """Finds the locations in first images of episodes, by demonstrations from other episodes of their tasks."""
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
        bank = read_demonstrations(dataset, config.cameras[0], config.image_size, config.n_demo_frames, needed)
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
        image = (observation[config.cameras[0]] * 255).round().to(torch.uint8)
        scene = image.permute(1, 2, 0).numpy()
        ends = demonstration_ends(shown[0]) if shown else None
        picture = draw_found(scene, ends, found, 0, recorded)
        yield View(tasks[episode], _picture_uri(picture), f"Episode {episode}: {text}", is_right)


def _check_features(config: TaskConditionedConfig, dataset: LeRobotDataset) -> None:
    """Checks that a dataset has what a policy observes.

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


@cache
def _template() -> jinja2.Template:
    text = resources.files("lerobot_deltaco").joinpath("look.html").read_text(encoding="utf-8")
    return jinja2.Environment(autoescape=True).from_string(text)
