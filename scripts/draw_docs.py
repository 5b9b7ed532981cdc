"""Draws the documentation's images: the benchmark's scenes and objects, and the shipped policy."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.layout import twin_word
from gym_deltaco.objects.labels import OBJECTS, SHAPES
from gym_deltaco.objects.objects import ObjectModel, object_model
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.seeding import episode_seed
from gym_deltaco.sim.camera import Camera
from gym_deltaco.sim.fixtures import TABLE_BOXES, TRAY_BOXES, table_mesh, tray_mesh
from gym_deltaco.sim.simulation import Simulation
from gym_deltaco.sim.workspace import CAMERA, TRAY_CENTER, TRAY_FLOOR
from gym_deltaco.tasks import SCENARIOS, TASK_SETS, get_task
from lerobot_deltaco.evaluation.photos import image_locations
from lerobot_deltaco.evaluation.records import EvaluationPlan, read_records
from lerobot_deltaco.evaluation.video import (
    benchmark_env,
    find_demonstration,
    load_conditioned,
    record_episode,
)
from lerobot_deltaco.pages.player import SHOWCASE
from lerobot_deltaco.policies.deltaco_match.findings import demonstration_ends, draw_localization
from lerobot_deltaco.reports.leaderboard import collect_results
from lerobot_deltaco.reports.report import calibration_rows, draw_calibration, make_table

CHECKPOINT = Path("checkpoints/pick_place")
# Tasks of all kinds with various containers: six names, three colors, three shapes
SCENE_TASKS = (4, 64, 123, 179, 231, 258, 33, 234, 187, 90, 144, 296)
VIEW_SIZE, POLICY_SIZE = 256, 48  # px, of images for people and for policies
CROP_SIZE = 14  # px of the policy's image, around an object
CLOSE_UP = Camera(
    (*TRAY_CENTER, TRAY_FLOOR + 0.033), distance=0.21, yaw=CAMERA.yaw, pitch=-35, fov=30, near=0.02
)
ACCENT = "#c45400"

LOCATED_TASK, LOCATED_SIZE = 128, 448
EPISODE_SIZE, END_SIZE, GAP, HEADER = 224, 108, 8, 30  # px
N_STEPS, FRAME_MS, LAST_FRAME_MS = 16, 160, 1800


# The benchmark


def draw_objects(out: Path) -> None:
    """Draws close-ups of the 32 objects in the order of their shapes, with the policy's view as insets."""
    labels = sorted(OBJECTS, key=lambda label: SHAPES.index(label.shape))
    figure, axes = _grid(4, 8, (13.6, 7.6))
    with closing(Simulation()) as simulation:
        for ax, label in zip(axes.flat, labels, strict=True):
            close_up, crop = _object_views(simulation, object_model(label.index))
            ax.imshow(close_up)
            inset = ax.inset_axes((0.64, 0, 0.36, 0.36))
            inset.imshow(crop, interpolation="nearest")
            inset.set(xticks=[], yticks=[])
            is_test = label.index in SCENARIOS["a"].test_rows
            color = ACCENT if is_test else "black"
            ax.set_title(f"{label.shape}\n{label.index} {label.name}", loc="left", color=color, fontsize=8)
            ax.spines[:].set(visible=is_test, color=ACCENT, linewidth=3)
    figure.savefig(out / "objects_by_shape.png")


def _object_views(simulation: Simulation, model: ObjectModel) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Returns a close-up of an object alone on the tray, and its part of the policy's image."""
    simulation.reset()
    center = np.array([*TRAY_CENTER, TRAY_FLOOR + model.height / 2])
    simulation.add_free_body(model.mesh, model.parts, center, min(0.25, model.yaw_range[1]), mass=1.0)
    simulation.add_static_body(tray_mesh(), TRAY_BOXES, (*TRAY_CENTER, TRAY_FLOOR))
    simulation.add_static_body(table_mesh(), TABLE_BOXES)
    x, y = np.rint(_pixel(center, POLICY_SIZE) - CROP_SIZE / 2).astype(int)
    seen = simulation.render(CAMERA, POLICY_SIZE)
    return simulation.render(CLOSE_UP, 2 * VIEW_SIZE), seen[y : y + CROP_SIZE, x : x + CROP_SIZE]


def draw_scenes(path: Path, task_ids: Sequence[int], scene: SceneConfig) -> None:
    """Draws the first image of an episode of twelve tasks, for people and for a policy."""
    figure, axes = _grid(4, 6, (13.6, 11.0))
    with closing(PickPlaceEnv(task_ids[0], scene)) as env:
        for (left, right), task_id in zip(axes.reshape(-1, 2), task_ids, strict=True):
            observation = _reset(env, task_id, 0)
            left.imshow(env.scene.render(VIEW_SIZE))
            right.imshow(observation["pixels"], interpolation="nearest")
            left.set_title(textwrap.fill(f"{task_id}: {env.task_description}", 58), loc="left")
    figure.savefig(path)


def draw_joint_control(out: Path) -> None:
    """Draws an episode with joint control, at the end of each stage, as both cameras see it."""
    with closing(PickPlaceEnv(scene=SceneConfig(control="joints", image_size=160))) as env:
        steps = list(expert_episode(env, SCENE_TASKS[0], episode_seed(0, "train", SCENE_TASKS[0], 0)))
        fps = env.metadata["render_fps"]
    ends = {step.stage: (number, step) for number, step in enumerate(steps)}
    figure, axes = _grid(2, len(ends), (1.75 * len(ends), 4))
    for column, (number, step) in zip(axes.T, ends.values(), strict=True):
        for ax, image in zip(column, step.observation["pixels"].values(), strict=True):
            ax.imshow(image)
        column[0].set_title(f"{number / fps:.1f} s\n{step.stage.value}", loc="left", fontsize=7)
    for ax, camera in zip(axes[:, 0], step.observation["pixels"], strict=True):
        ax.set_ylabel(camera)
    figure.savefig(out / "joint_control.png")


def draw_ambiguity(out: Path) -> None:
    """Draws both ambiguity schemes: first and last image of a demonstration, and a new scene."""
    figure, axes = _grid(2, 3, (8.4, 7.2))
    captions = (
        "The demonstration begins.",
        "It ends in the left bin, which is {color}. Which of the two is meant?",
        'New scene: the instruction says "left bin", whatever its color.',
    )
    _draw_ambiguity(axes[0], "container", 236, (2, 55), captions)
    word = twin_word(get_task(31))
    captions = (
        "The demonstration begins. The instruction does not say which jar is meant.",
        f"The expert takes the jar that stood on the {word}.",
        f"New scene: again, the jar on the {word} is meant.",
    )
    _draw_ambiguity(axes[1], "object", 31, (3, 51), captions)
    figure.savefig(out / "ambiguity.png")


def _draw_ambiguity(
    axes: Any, ambiguity: str, task_id: int, episodes: tuple[int, int], captions: Sequence[str]
) -> None:
    """Draws a demonstration of a task and another scene, given the numbers of their episodes."""
    with closing(PickPlaceEnv(scene=SceneConfig(ambiguity=ambiguity))) as env:
        _reset(env, task_id, episodes[0])
        layout, images = env.scene.layout, [env.scene.render(VIEW_SIZE)]
        color = layout.containers[layout.target_container].color
        successes = 0
        for step in expert_episode(env, task_id, episode_seed(0, "train", task_id, episodes[0])):
            successes += step.info["is_success"]
            if successes == 3:
                break
        images.append(env.scene.render(VIEW_SIZE))
        _reset(env, task_id, episodes[1])
        layout, pose = env.scene.layout, env.scene.object_pose(env.scene.layout.target_object)
        images.append(env.scene.render(VIEW_SIZE))
    for ax, image, caption in zip(axes, images, captions, strict=True):
        ax.imshow(image)
        ax.set_xlabel(textwrap.fill(caption.format(color=color), 38), loc="left")
        ax.set_title(" ", fontsize=12)  # room for the title, which is wider than its axes
    title = f'Ambiguity "{ambiguity}": {get_task(task_id).instruction}'
    axes[0].text(0, 1.03, title, transform=axes[0].transAxes, fontsize=12, in_layout=False)
    # A ring around what is meant
    center, radius = pose.position, 24
    if ambiguity == "container":
        quadrant = layout.containers[layout.target_container].quadrant
        center, radius = np.array([*quadrant.container_center, TRAY_FLOOR]), 34
    ring = Circle(tuple(_pixel(center, VIEW_SIZE)), radius, fill=False, edgecolor="white", linewidth=3)
    axes[2].add_patch(ring)


def _reset(env: PickPlaceEnv, task_id: int, number: int) -> dict[str, Any]:
    """Draws the scene of a training episode, and returns its first observation."""
    return env.reset(seed=episode_seed(0, "train", task_id, number), options={"task_id": task_id})[0]


def _pixel(point: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Projects a point of the world, (3,), m, into the benchmark's camera. Returns (x, y), px."""
    return (image_locations(point[None])[0] + 1) * size / 2


def _grid(n_rows: int, n_columns: int, size: tuple[float, float]) -> tuple[Figure, Any]:
    """Makes a figure of `size` (inches) with a grid of axes without ticks and frames."""
    figure, axes = plt.subplots(n_rows, n_columns, figsize=size, layout="constrained", squeeze=False)
    for ax in axes.flat:
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    return figure, axes


# The shipped policy


def draw_policy(out: Path) -> None:
    """Draws four episodes of one scene: a row for each demonstration, a column for each sentence."""
    loaded, font = load_conditioned(CHECKPOINT), ImageFont.load_default(size=16)
    env = benchmark_env(loaded.policy.config, EPISODE_SIZE)
    left = END_SIZE + 3 * GAP
    canvas = Image.new("RGB", (left + 2 * (EPISODE_SIZE + GAP), HEADER + 2 * (EPISODE_SIZE + GAP)), "white")
    draw = ImageDraw.Draw(canvas)
    draw.text((GAP + END_SIZE / 2, HEADER / 2), "demonstration", "black", font, "mm")
    episodes = []
    for number, choice in enumerate(SHOWCASE):
        (row, column), sentence = divmod(number, 2), choice.instruction
        x, y = left + column * (EPISODE_SIZE + GAP), HEADER + row * (EPISODE_SIZE + GAP)
        demonstration = find_demonstration(loaded.policy, get_task(choice.demo_task), env.scene_config)
        for n, end in enumerate(demonstration_ends(demonstration)):
            image = Image.fromarray(end).resize((END_SIZE, END_SIZE), Image.Resampling.BICUBIC)
            canvas.paste(image, (GAP, y + n * (END_SIZE + GAP)))
        if row == 0:
            draw.text((x + EPISODE_SIZE / 2, HEADER / 2), f"“{sentence}”", "black", font, "mm")
        recording = record_episode(loaded, env, choice.task_id, choice.scene_seed, sentence, [demonstration])
        episodes.append((x, y, recording.frames))
    frames = []
    for step in range(N_STEPS + 1):
        frame = canvas.copy()
        for x, y, images in episodes:
            frame.paste(Image.fromarray(images[step]), (x, y))
        frames.append(frame)
    palette = frames[len(frames) // 2].quantize(96)
    first, *others = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [FRAME_MS] * N_STEPS + [LAST_FRAME_MS]
    first.save(out / "policy.gif", save_all=True, append_images=others, duration=durations, loop=0)


def draw_locations(out: Path) -> None:
    """Draws where the policy looks in one scene."""
    loaded = load_conditioned(CHECKPOINT)
    env, seed = (
        benchmark_env(loaded.policy.config, LOCATED_SIZE),
        EvaluationPlan().scene_seed(LOCATED_TASK, 0),
    )
    demonstration = find_demonstration(loaded.policy, get_task(LOCATED_TASK), env.scene_config)
    recording = record_episode(loaded, env, LOCATED_TASK, seed, demonstration.task, [demonstration])
    assert recording.localization is not None
    ends = demonstration_ends(demonstration)
    picture = draw_localization(recording.frames[0], ends, recording.localization)
    picture.quantize(256).save(out / "found.png", optimize=True)


def draw_finding(path: Path, out: Path) -> None:
    """Draws how often objects are found by the number of training episodes and objects.

    Args:
        path: What `benchmarks/finding.py --out` wrote.
        out: Folder to write to.
    """
    rates: dict[tuple[str, int], dict[int, list[dict[str, float]]]] = {}
    for line in path.read_text().splitlines():
        row = json.loads(line)
        kind, *numbers = row["case"].split("-")
        if kind == "gym":
            n_objects, n_episodes = map(int, numbers)
            rates.setdefault((row["scenes"], n_objects), {})[n_episodes] = row["seeds"]
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 3.2), layout="constrained", sharey=True)
    titles = {"same": "Trained objects in new scenes", "new": "New objects"}
    for (scenes, n_objects), by_episodes in sorted(rates.items()):
        ax, episodes = axes[[*titles].index(scenes)], sorted(by_episodes)
        for name, style in (("both", "o-"), ("raw", ":")):
            values = [100 * np.mean([seed[name] for seed in by_episodes[n]]) for n in episodes]
            color, label = {4: ACCENT, 8: "#1f6fb2", 24: "#3a7d34"}[n_objects], f"{n_objects} objects"
            ax.plot(episodes, values, style, color=color, label=label if name == "both" else None)
    for ax, title in zip(axes, titles.values(), strict=True):
        ax.set(title=title, xscale="log", xlabel="training episodes", xticks=[30, 100, 300], ylim=(70, 101))
        ax.set_xticks([], minor=True)
        ax.set_xticklabels(["30", "100", "300"])
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("right object, %")
    axes[0].plot([], [], ":", color="gray", label="without a fit")
    axes[0].legend(loc="lower right", fontsize=8)
    figure.savefig(out / "finding.png")


def draw_acting(path: Path, out: Path) -> None:
    """Draws how often tasks succeed by the number of training episodes.

    Args:
        path: Folder of the records of `few_demonstrations`.
        out: Folder to write to.
    """
    rates: dict[tuple[str, str], dict[int, list[float]]] = {}
    for record in read_records(path):
        policy, number, scenes = record.experiment.partition("/")[2].split("_")
        by_episodes = rates.setdefault((scenes, policy), {})
        by_episodes.setdefault(int(number), []).append(100 * record.success_rate)
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 3.2), layout="constrained", sharey=True)
    titles = {"same": "Trained tasks in new scenes", "novel": "Novel tasks and objects"}
    names, colors = (
        {"replay": "replay", "network": "policy network"},
        {"replay": ACCENT, "network": "#1f6fb2"},
    )
    for ax, (scenes, title) in zip(axes, titles.items(), strict=True):
        for policy, name in names.items():
            by_episodes = dict(sorted(rates.get((scenes, policy), {}).items()))
            means = [np.mean(trainings) for trainings in by_episodes.values()]
            ax.plot(list(by_episodes), means, "o-", color=colors[policy], label=name)
            for n_episodes, trainings in by_episodes.items():
                ax.plot([n_episodes] * len(trainings), trainings, ".", color=colors[policy], alpha=0.4)
        ax.set(title=title, xscale="log", xlabel="training episodes", ylim=(0, 100))
        ax.set_xticks([30, 100, 300, 1000], labels=["30", "100", "300", "1,000"])
        ax.set_xticks([], minor=True)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("success, %")
    axes[0].legend(loc="lower right", fontsize=8)
    figure.savefig(out / "acting.png")


def main(out: Path = Path("docs/images")) -> None:
    """Draws all images.

    Args:
        out: Folder to write to.
    """
    out.mkdir(parents=True, exist_ok=True)
    mpl.use("Agg")
    with mpl.rc_context({"axes.titlesize": 9, "axes.labelsize": 9, "savefig.dpi": 100}):
        draw_objects(out)
        draw_scenes(out / "scenes.png", SCENE_TASKS, SceneConfig())
        name = "out_of_distribution"
        draw_scenes(out / f"{name}.png", TASK_SETS[name][:12], SceneConfig(objects=name))
        draw_ambiguity(out)
        draw_joint_control(out)
        draw_finding(Path("results/finding_few_objects.jsonl"), out)
        draw_acting(Path("results/few_demonstrations"), out)
    draw_policy(out)
    draw_locations(out)
    shipped = collect_results(read_records(Path("results/shipped")))
    draw_calibration(make_table(shipped, calibration_rows)).savefig(out / "calibration.png")


if __name__ == "__main__":
    tyro.cli(main)
