"""Draws the documentation's images of the benchmark: objects, scenes, joint control, ambiguity schemes."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from gym_deltaco.camera import Camera
from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.fixtures import TABLE_BOXES, TRAY_BOXES, table_mesh, tray_mesh
from gym_deltaco.layout import Layout, twin_word
from gym_deltaco.objects import ObjectModel, object_model
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.seeding import episode_seed
from gym_deltaco.simulation import Simulation, camera_matrices
from gym_deltaco.tasks import OBJECTS, SCENARIOS, SHAPES, TASK_SETS, get_task
from gym_deltaco.workspace import CAMERA, TRAY_CENTER, TRAY_FLOOR

# Tasks of all kinds with various containers: six names, three colors, three shapes
SCENE_TASKS = (4, 64, 123, 179, 231, 258, 33, 234, 187, 90, 144, 296)
CONTAINER_TASK, OBJECT_TASK = 236, 31  # white object in left bin; jar in green bin
VIEW_SIZE, POLICY_SIZE = 256, 48  # px, of images for people and for policies
CROP_SIZE = 14  # px of the policy's image, around an object
CLOSE_UP = Camera(
    (*TRAY_CENTER, TRAY_FLOOR + 0.033), distance=0.21, yaw=CAMERA.yaw, pitch=-35, fov=30, near=0.02
)
N_TRIES = 50  # scenes, to find one that shows what is meant
ACCENT = "#c45400"
DPI = 100


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
    _save(figure, out / "objects_by_shape.png")


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


def draw_scenes(out: Path) -> None:
    """Draws the first image of an episode of several tasks, for people and for a policy."""
    _draw_scenes(SCENE_TASKS, SceneConfig(), out / "scenes.png")


def draw_foreign_scenes(out: Path) -> None:
    """Draws the first image of an episode of several tasks with foreign objects."""
    _draw_scenes(TASK_SETS["foreign"][:12], SceneConfig(objects="foreign"), out / "foreign_objects.png")


def _draw_scenes(task_ids: Sequence[int], scene: SceneConfig, path: Path) -> None:
    figure, axes = _grid(4, 6, (13.6, 11.0))
    with closing(PickPlaceEnv(task_ids[0], scene)) as env:
        for (left, right), task_id in zip(axes.reshape(-1, 2), task_ids, strict=True):
            observation, _ = env.reset(
                seed=episode_seed(0, "train", task_id, 0), options={"task_id": task_id}
            )
            left.imshow(env.scene.render(VIEW_SIZE))
            right.imshow(observation["pixels"], interpolation="nearest")
            left.set_title(textwrap.fill(f"{task_id}: {env.task_description}", 58), loc="left")
    _save(figure, path)


def _expert_images(env: PickPlaceEnv, task_id: int, seed: int) -> list[NDArray[np.uint8]]:
    """Returns the images of an episode before the first step and after each, until two after its success."""
    env.reset(seed=seed, options={"task_id": task_id})
    images = [env.scene.render(VIEW_SIZE)]
    n_successes = 0
    for step in expert_episode(env, task_id, seed):
        images.append(env.scene.render(VIEW_SIZE))
        n_successes += step.info["is_success"]
        if n_successes == 3:
            break
    return images


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
    _save(figure, out / "joint_control.png")


def draw_ambiguity(out: Path) -> None:
    """Draws both ambiguity schemes: first and last image of a demonstration, and a new scene."""
    figure, axes = _grid(2, 3, (8.4, 7.2))
    task = get_task(CONTAINER_TASK)
    with closing(PickPlaceEnv()) as env:
        start, end, shown = _demonstration(env, task.index)
        scene, layout = _new_scene(
            env, task.index, lambda new: new.target_container != shown.target_container
        )
    color = shown.containers[shown.target_container].color
    center = layout.containers[layout.target_container].quadrant.container_center
    panels = [
        (start, "The demonstration begins."),
        (end, f"It ends in the left bin, which is {color}. Which of the two is meant?"),
        (scene, 'New scene: the instruction says "left bin", whatever its color.'),
    ]
    _draw_row(axes[0], f'Ambiguity "container": {task.instruction}', panels)
    axes[0, 2].add_patch(_ring(np.array([*center, TRAY_FLOOR]), 34))

    task = get_task(OBJECT_TASK)
    with closing(PickPlaceEnv(scene=SceneConfig(ambiguity="object"))) as env:
        start, end, shown = _demonstration(env, task.index)
        xy = shown.objects[shown.target_object].xy
        scene, layout = _new_scene(
            env, task.index, lambda new: np.abs(new.objects[new.target_object].xy - xy).max() > 0.05
        )
        position = env.scene.object_pose(layout.target_object).position
    panels = [
        (start, "The demonstration begins. The instruction does not say which jar is meant."),
        (end, f"The expert takes the jar that stood on the {twin_word(task)}."),
        (scene, f"New scene: again, the jar on the {twin_word(task)} is meant."),
    ]
    _draw_row(axes[1], f'Ambiguity "object": {task.instruction}', panels)
    axes[1, 2].add_patch(_ring(position, 24))
    _save(figure, out / "ambiguity.png")


def _draw_row(axes: Any, title: str, panels: list[tuple[NDArray[np.uint8], str]]) -> None:
    """Draws images with captions below them, and a title above the first one."""
    for ax, (image, caption) in zip(axes, panels, strict=True):
        ax.imshow(image)
        ax.set_xlabel(textwrap.fill(caption, 38), loc="left")
        ax.set_title(" ", fontsize=12)  # room for the title, which is wider than its axes
    axes[0].text(0, 1.03, title, transform=axes[0].transAxes, fontsize=12, in_layout=False)


def _demonstration(env: PickPlaceEnv, task_id: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8], Layout]:
    """Returns the first and the last image of an episode in which the expert succeeds, and its layout."""
    for trial in range(N_TRIES):
        seed = episode_seed(0, "train", task_id, trial)
        env.reset(seed=seed, options={"task_id": task_id})
        if _is_in_view(env.scene.layout):
            images = _expert_images(env, task_id, seed)
            if len(images) <= env.scene_config.n_steps:
                return images[0], images[-1], env.scene.layout
    raise RuntimeError(f"No demonstration of task {task_id} in {N_TRIES} tries.")


def _new_scene(
    env: PickPlaceEnv, task_id: int, is_wanted: Callable[[Layout], bool]
) -> tuple[NDArray[np.uint8], Layout]:
    """Returns the image and the layout of a scene that was not tried for the demonstration."""
    for trial in range(N_TRIES, 2 * N_TRIES):
        env.reset(seed=episode_seed(0, "train", task_id, trial), options={"task_id": task_id})
        if is_wanted(env.scene.layout) and _is_in_view(env.scene.layout):
            return env.scene.render(VIEW_SIZE), env.scene.layout
    raise RuntimeError(f"No scene of task {task_id} in {N_TRIES} tries.")


def _is_in_view(layout: Layout) -> bool:
    """Returns whether the centers of all objects are well within the image."""
    centers = [_pixel(np.array([*item.xy, TRAY_FLOOR + item.model.height / 2]), 1) for item in layout.objects]
    return bool((np.abs(np.array(centers) - 0.5) < 0.42).all())


def _pixel(point: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Projects a point of the world, (3,), m, into the benchmark's camera. Returns (x, y), px."""
    view, projection = (np.reshape(matrix, (4, 4)).T for matrix in camera_matrices(CAMERA))
    x, y, _, w = projection @ view @ [*point, 1.0]
    return np.array([1 + x / w, 1 - y / w]) * size / 2


def _ring(point: NDArray[np.float64], radius: float) -> Circle:
    x, y = _pixel(point, VIEW_SIZE)
    return Circle((x, y), radius, fill=False, edgecolor="white", linewidth=3)


def _grid(n_rows: int, n_columns: int, size: tuple[float, float]) -> tuple[Figure, Any]:
    """Makes a figure of `size` (inches) with a grid of axes without ticks and frames."""
    figure, axes = plt.subplots(n_rows, n_columns, figsize=size, layout="constrained", squeeze=False)
    for ax in axes.flat:
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    return figure, axes


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    """Draws all images."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", nargs="?", type=Path, default=Path("docs/images"), help="folder to write to")
    out = parser.parse_args(arguments).out
    out.mkdir(parents=True, exist_ok=True)
    mpl.use("Agg")
    with mpl.rc_context({"axes.titlesize": 9, "axes.labelsize": 9}):
        for draw in (
            draw_objects,
            draw_scenes,
            draw_foreign_scenes,
            draw_ambiguity,
            draw_joint_control,
        ):
            draw(out)


if __name__ == "__main__":
    main()
