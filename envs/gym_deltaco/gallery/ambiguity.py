"""The figure of the two schemes of ambiguity."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.gallery.episodes import record
from gym_deltaco.gallery.scenes import PEOPLE_SIZE, Figure, make_env, pixel_of, scene_seed, view_of
from gym_deltaco.layout import Layout, twin_word
from gym_deltaco.sheets import GAP, across, caption, circled, down, framed, save_png
from gym_deltaco.tasks import OBJECTS, Task, get_task
from gym_deltaco.workspace import TRAY_FLOOR

_TRIES = 50  # seeds, to find a scene that shows what is meant


def draw_ambiguity(out: Path, seed: int, tick: Callable[[], object]) -> Figure:
    """The two schemes: one that only the instruction settles, and one that only the demonstration settles."""
    rows = []
    for draw in (_container_scheme, _object_scheme):
        rows.append(draw(seed))
        tick()
    save_png(framed(down(rows, gap=3 * GAP), thickness=GAP), out / "ambiguity.png")
    text = (
        "Why a policy is given a demonstration and an instruction. In scheme 'container' (the paper's i), "
        "the demonstration alone does not say which bin is meant. In scheme 'object' (ii), the instruction "
        "alone does not say which of two identical objects is meant. A ring marks the right one in the new "
        "scene."
    )
    return Figure("ambiguity.png", "The two schemes of ambiguity", text)


def _container_scheme(seed: int) -> Image.Image:
    """A demonstration that fits a color as well as a place, and a new scene where the two part."""
    task = get_task(236)  # Put white colored object in left bin.
    with closing(make_env("container")) as env:
        start, end, demonstrated = _demonstration(env, task, seed)
        scene, layout = _new_scene(
            env, task, seed, lambda new: new.target_container != demonstrated.target_container
        )
        mark = pixel_of(_container_position(layout), PEOPLE_SIZE)
    color = demonstrated.containers[demonstrated.target_container].color
    word = task.container
    return _row(
        f'Scheme "container": {task.instruction}',
        (start, "The demonstration begins."),
        (
            end,
            f"It ends in the {word} bin, which is {color}. It does not say which of the two is meant.",
        ),
        (
            circled(scene, mark, radius=34),
            f'A new scene: the instruction says "{word} bin", whatever its color.',
        ),
    )


def _object_scheme(seed: int) -> Image.Image:
    """A demonstration that picks one of two identical objects, and a new scene with them."""
    task = get_task(31)  # Put blue colored, cylinder shaped jar in green bin.
    with closing(make_env("object")) as env:
        start, end, demonstrated = _demonstration(env, task, seed)
        scene, layout = _new_scene(
            env, task, seed, lambda new: not np.allclose(_target_xy(new), _target_xy(demonstrated), atol=0.05)
        )
        mark = pixel_of(env.scene.object_pose(layout.target_object).position, PEOPLE_SIZE)
    name, word = OBJECTS[task.row].name, twin_word(task)
    return _row(
        f'Scheme "object": {task.instruction}',
        (start, f"The demonstration begins. The instruction does not say which {name} is meant."),
        (end, f"The expert takes the {name} that stood on the {word}."),
        (circled(scene, mark, radius=24), f"A new scene: again, the {name} on the {word} is meant."),
    )


def _demonstration(env: PickPlaceEnv, task: Task, seed: int) -> tuple[Image.Image, Image.Image, Layout]:
    """The first and the last image of an episode in which the expert succeeds, and its scene."""
    for number in range(_TRIES):
        if _is_in_view(_new_layout(env, task, seed, number)):
            episode = record(env, task.index, scene_seed(seed, task.index, number))
            if episode.success_step is not None:
                return episode.frames[0], episode.frames[-1], env.scene.layout
    raise RuntimeError(f"No demonstration of task {task.index} in {_TRIES} tries.")


def _new_scene(
    env: PickPlaceEnv, task: Task, seed: int, is_wanted: Callable[[Layout], bool]
) -> tuple[Image.Image, Layout]:
    """A scene of the task that is as wanted, other than those tried for the demonstration."""
    for number in range(_TRIES, 2 * _TRIES):
        layout = _new_layout(env, task, seed, number)
        if is_wanted(layout) and _is_in_view(layout):
            return view_of(env), layout
    raise RuntimeError(f"No scene of task {task.index} as wanted in {_TRIES} tries.")


def _new_layout(env: PickPlaceEnv, task: Task, seed: int, number: int) -> Layout:
    env.reset(seed=scene_seed(seed, task.index, number), options={"task_id": task.index})
    return env.scene.layout


def _is_in_view(layout: Layout) -> bool:
    """Whether the edges of the image cut no object much. They do cut some that stand far in front."""
    middles = [
        pixel_of(np.array([*item.xy, TRAY_FLOOR + item.model.height / 2]), 1) for item in layout.objects
    ]
    return bool((np.abs(np.array(middles) - 0.5) < 0.42).all())


def _container_position(layout: Layout) -> NDArray[np.float64]:
    return np.array([*layout.containers[layout.target_container].quadrant.container_center, TRAY_FLOOR])


def _target_xy(layout: Layout) -> NDArray[np.float64]:
    return layout.objects[layout.target_object].xy


def _row(title: str, *panels: tuple[Image.Image, str]) -> Image.Image:
    cells = [down([image, caption(text, PEOPLE_SIZE, n_lines=3)], gap=4) for image, text in panels]
    sheet = across(cells, gap=2 * GAP)
    return down([caption(title, sheet.width, size=18), sheet])
