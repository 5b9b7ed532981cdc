"""Images of the benchmark's objects, scenes and expert, and a page that shows them."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from gym_deltaco import CONTROL_FPS, EPISODE_STEPS
from gym_deltaco.atomic_files import write_text
from gym_deltaco.camera import Camera
from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.fixtures import TABLE_BOXES, TRAY_BOXES, table_mesh, tray_mesh
from gym_deltaco.layout import Ambiguity, Layout, twin_word
from gym_deltaco.objects import ObjectModel, object_model
from gym_deltaco.random_objects import random_model
from gym_deltaco.seeding import episode_seed
from gym_deltaco.sheets import (
    ACCENT,
    GAP,
    INK,
    PAPER,
    across,
    caption,
    circled,
    down,
    enlarged,
    framed,
    grid,
    save_gif,
    save_png,
    to_image,
)
from gym_deltaco.simulation import Simulation, camera_matrices
from gym_deltaco.tasks import COLORS, OBJECTS, SCENARIOS, SHAPES, ObjectLabel, Task, get_task
from gym_deltaco.workspace import CAMERA, TRAY_CENTER, TRAY_FLOOR

N_EPISODES = 3
POLICY_SIZE = 48  # px, of what a policy sees
PEOPLE_SIZE = 256  # px, of what people see

_CLOSE_UP = Camera(
    target=(*TRAY_CENTER, TRAY_FLOOR + 0.033), distance=0.21, yaw=CAMERA.yaw, pitch=-35, fov=30, near=0.02
)
_CLOSE_UP_SIZE = 136  # px
_CROP_SIZE = 14  # px of the policy's image, around an object
_CROP_ZOOM = 6
_SCENE_ZOOM = 4
_N_COLUMNS = 6  # objects in a row
_OBJECT_YAW = 0.25  # rad, or as much as the object may be turned in a scene
_SLOWED = 3  # times slower than nominal is the animation
_FRAME_MS = 1000 * _SLOWED // CONTROL_FPS
_LAST_FRAME_MS = 1500
_STEPS_AFTER_SUCCESS = 2  # to show
_TRIES = 50  # seeds, to find a scene that shows what is meant

_OBJECTS_TEXT = (
    f"Large: seen from nearby. Small: the same in the {POLICY_SIZE} px image that a policy sees. Framed in "
    "orange: the 8 that scenario A does not train on by name."
)

TEST_OBJECTS = frozenset(SCENARIOS["a"].test_rows) & frozenset(range(len(OBJECTS)))


class Episode(NamedTuple):
    """An episode of the expert, up to shortly after its success, or to its end."""

    task: Task
    frames: list[Image.Image]  # before the first step, and after each one
    stages: list[str]  # of each frame
    info: dict[str, Any]  # after the last step
    success_step: int | None  # from 1; None without success

    @property
    def outcome(self) -> str:
        """What the environment's info says of it."""
        if self.success_step is not None:
            return f"success after step {self.success_step}"
        grasped = self.info["grasped_object"]
        held = OBJECTS[self.info["objects"][grasped]].name if grasped >= 0 else "nothing"
        return f"no success in {len(self.frames) - 1} steps (last grasped: {held})"


class Figure(NamedTuple):
    """An image of the page."""

    file: str
    title: str
    text: str


def draw_gallery(
    out: Path, seed: int, task_ids: Sequence[int], max_scenes: int, random_objects: Sequence[ObjectLabel] = ()
) -> None:
    """Draws all images, and the page `index.md`, which links to them, last.

    Args:
        out: Folder to write to.
        seed: Seed of the scenes.
        task_ids: Tasks whose scenes are shown; of some, an episode of the expert too.
        max_scenes: Greatest number of tasks; so many are drawn at random from more.
        random_objects: Random objects that are drawn too.

    Raises:
        OSError: The folder cannot be made or written to.
    """
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=out):
        pass  # so that a folder that cannot be written to is an error before anything is drawn
    shown = _drawn(task_ids, max_scenes, seed)
    recorded = shown[:: max(1, len(shown) // N_EPISODES)][:N_EPISODES]
    n_updates = len(OBJECTS) + len(random_objects) + len(shown) + len(recorded) + 2
    progress = tqdm(total=n_updates, desc="gallery", unit="image")
    with progress, closing(Simulation()) as simulation:
        cells = []
        for index in range(len(OBJECTS)):
            cells.append(object_cell(simulation, object_model(index)))
            progress.update()
        figures = [
            draw_objects_by_name(out, cells),
            draw_objects(out, "shape", SHAPES, cells),
            draw_objects(out, "color", COLORS, cells),
            draw_scenes(out, seed, shown, progress.update),
            *draw_episodes(out, seed, recorded, progress.update),
            draw_ambiguity(out, seed, progress.update),
        ]
        if random_objects:
            figures.append(draw_random_objects(out, random_objects, simulation, progress.update))
    write_text(out / "index.md", page(figures))


def page(figures: Iterable[Figure]) -> str:
    """The Markdown page."""
    sections = [f"## {title}\n\n{text}\n\n![{title}]({file})" for file, title, text in figures]
    introduction = (
        "A WidowX 250 stands at a shallow tray with three objects and two bins, one green and one red. An "
        "instruction says which object to put into which bin; front is near the camera, back is near the "
        f"robot, left and right are the image's. A policy sees {POLICY_SIZE} x {POLICY_SIZE} pixels. All "
        "images are drawn by `deltaco-gallery`, from code alone."
    )
    return "\n\n".join(["# The benchmark in images", introduction, *sections]) + "\n"


# Objects


def draw_objects(out: Path, what: str, names: Sequence[str], cells: Sequence[Image.Image]) -> Figure:
    """The 32 objects in groups by shape or color, as in the paper's figures 6 and 5.

    Args:
        out: Folder to write to.
        what: "shape" or "color".
        names: Names of the groups.
        cells: An image for each object.
    """
    groups = []
    for name in names:
        members = [cells[label.index] for label in OBJECTS if getattr(label, what) == name]
        heading = caption(f"{name} ({len(members)})", width=cells[0].width, size=20)
        group = down([heading, grid(members, _N_COLUMNS, gap=GAP)], gap=4)
        groups.append((min(len(members), _N_COLUMNS), group))
    file = f"objects_by_{what}.png"
    shelves = [across(shelf, gap=GAP) for shelf in _shelves(groups)]
    save_png(framed(down(shelves, gap=2 * GAP), thickness=GAP), out / file)
    return Figure(file, f"Objects by {what}", f"All 32 objects, by {what}. {_OBJECTS_TEXT}")


def draw_objects_by_name(out: Path, cells: Sequence[Image.Image]) -> Figure:
    """The 32 objects in the order of their numbers, as in the paper's figure 4.

    Args:
        out: Folder to write to.
        cells: An image for each object.
    """
    file = "objects_by_name.png"
    save_png(framed(grid(cells, _N_COLUMNS, gap=GAP), thickness=GAP), out / file)
    return Figure(file, "Objects by name", f"All 32 objects, by number. {_OBJECTS_TEXT}")


def draw_random_objects(
    out: Path, labels: Sequence[ObjectLabel], simulation: Simulation, tick: Callable[[], object]
) -> Figure:
    """Random objects, by shape."""
    groups = []
    for shape in SHAPES:
        cells = []
        for label in labels:
            if label.shape == shape:
                close_up, crop = object_views(simulation, random_model(label.index))
                width = close_up.width + crop.width + 4
                name = caption(f"{label.index}  {label.color}", width, size=14)
                cells.append(down([across([close_up, crop], gap=4, align="end"), name], gap=2))
                tick()
        if cells:
            heading = caption(f"{shape} ({len(cells)})", width=cells[0].width, size=20)
            group = down([heading, grid(cells, _N_COLUMNS, gap=GAP)], gap=4)
            groups.append((min(len(cells), _N_COLUMNS), group))
    shelves = [across(shelf, gap=GAP) for shelf in _shelves(groups)]
    save_png(framed(down(shelves, gap=2 * GAP), thickness=GAP), out / "random_objects.png")
    text = (
        f"{len(labels)} random objects, by shape, with the color that instructions call them by. None has "
        "both the shape and the color of a test object of scenario A."
    )
    return Figure("random_objects.png", "Random objects", text)


def object_cell(simulation: Simulation, model: ObjectModel) -> Image.Image:
    """An object from nearby, as a policy sees it, and its name."""
    close_up, crop = object_views(simulation, model)
    label = model.label
    width = close_up.width + crop.width + 4
    is_test = label.index in TEST_OBJECTS
    text = caption(f"{label.index}  {label.name}", width, size=14, color=ACCENT if is_test else INK)
    cell = down([across([close_up, crop], gap=4, align="end"), text], gap=2)
    return framed(cell, ACCENT if is_test else PAPER, thickness=3)


def object_views(simulation: Simulation, model: ObjectModel | None) -> tuple[Image.Image, Image.Image]:
    """An object alone on the tray (None: nothing): from nearby, and its part of what a policy sees."""
    simulation.reset()
    middle = np.array([*TRAY_CENTER, TRAY_FLOOR])
    if model is not None:
        middle[2] += model.height / 2
        yaw = min(_OBJECT_YAW, model.yaw_range[1])
        simulation.add_free_body(model.mesh, model.parts, middle, yaw, mass=1.0)
    simulation.add_static_body(tray_mesh(), TRAY_BOXES, (*TRAY_CENTER, TRAY_FLOOR))
    simulation.add_static_body(table_mesh(), TABLE_BOXES)
    close_up = to_image(simulation.render(_CLOSE_UP, 3 * _CLOSE_UP_SIZE), _CLOSE_UP_SIZE)
    seen = simulation.render(CAMERA, POLICY_SIZE)
    x, y = np.rint(_pixel_of(middle, POLICY_SIZE) - _CROP_SIZE / 2).astype(int)
    return close_up, enlarged(seen[y : y + _CROP_SIZE, x : x + _CROP_SIZE], _CROP_ZOOM)


def _shelves(groups: Iterable[tuple[int, Image.Image]]) -> list[list[Image.Image]]:
    """Groups, given with their widths in columns, each on the first shelf that has room for it."""
    shelves: list[list[Image.Image]] = []
    free: list[int] = []
    for width, image in groups:
        number = next((number for number, columns in enumerate(free) if columns >= width), len(free))
        if number == len(free):
            shelves.append([])
            free.append(_N_COLUMNS)
        shelves[number].append(image)
        free[number] -= width
    return shelves


def _pixel_of(point: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Where the benchmark's camera sees a point of the world, (3,), m: (x, y) in an image of `size` px."""
    view, projection = (np.reshape(matrix, (4, 4)).T for matrix in camera_matrices(CAMERA))
    x, y, _, w = projection @ view @ [*point, 1.0]
    return np.array([1 + x / w, 1 - y / w]) * size / 2


# Scenes


def draw_scenes(out: Path, seed: int, task_ids: Sequence[int], tick: Callable[[], object]) -> Figure:
    """A scene of each task."""
    cells = []
    with closing(_environment("container")) as env:
        for task_id in task_ids:
            observation, _ = env.reset(seed=_seed(seed, task_id), options={"task_id": task_id})
            small = enlarged(observation["pixels"], _SCENE_ZOOM)
            images = across([_view(env), small], gap=4, align="end")
            instruction = caption(f"{task_id}: {env.task_description}", images.width, n_lines=2)
            cells.append(down([images, instruction], gap=4))
            tick()
    save_png(framed(grid(cells, n_columns=3), thickness=GAP), out / "scenes.png")
    text = (
        f"{len(task_ids)} of the 300 tasks: the start of an episode, with the task's number and instruction. "
        f"Left: for people. Right: the {POLICY_SIZE} x {POLICY_SIZE} pixels that a policy gets, enlarged."
    )
    return Figure("scenes.png", "Scenes", text)


def _environment(ambiguity: Ambiguity) -> PickPlaceEnv:
    return PickPlaceEnv(ambiguity=ambiguity, image_size=POLICY_SIZE)


def _view(env: PickPlaceEnv) -> Image.Image:
    return to_image(env.scene.render(PEOPLE_SIZE))


def _seed(seed: int, task_id: int, number: int = 0) -> int:
    """Training scenes, so that nobody has seen those of an evaluation here."""
    return episode_seed(seed, "train", task_id, number)


def _drawn(task_ids: Sequence[int], n_tasks: int, seed: int) -> list[int]:
    """At most so many of the tasks, in their order."""
    n_tasks = min(n_tasks, len(task_ids))
    positions = np.random.default_rng(seed).choice(len(task_ids), n_tasks, replace=False)
    return [task_ids[position] for position in sorted(positions)]


# The expert


def draw_episodes(out: Path, seed: int, task_ids: Sequence[int], tick: Callable[[], object]) -> list[Figure]:
    """Episodes of the expert: the first one as a strip, all of them as an animation."""
    episodes = []
    with closing(_environment("container")) as env:
        for task_id in task_ids:
            episodes.append(record(env, task_id, _seed(seed, task_id)))
            tick()
    first = episodes[0]
    save_png(_strip(first), out / "episode.png")
    frames = [frame for episode in episodes for frame in _animated(episode)]
    durations = [
        duration
        for episode in episodes
        for duration in [_FRAME_MS] * (len(episode.frames) - 1) + [_LAST_FRAME_MS]
    ]
    save_gif(frames, durations, out / "episode.gif")
    outcomes = "\n".join(
        f'- Task {episode.task.index}, "{episode.task.instruction}": {episode.outcome}.'
        for episode in episodes
    )
    return [
        Figure(
            "episode.png",
            "An episode of the expert",
            f'"{first.task.instruction}", every other step: {first.outcome}. The scripted expert knows '
            "where everything is. Its actions are noisy on purpose, as in the paper, and it "
            "repeats what goes wrong.",
        ),
        Figure(
            "episode.gif",
            "Episodes of the expert, animated",
            f"Each is shown until shortly after its success, or for all of its {EPISODE_STEPS} steps, "
            f"{_SLOWED} times slower than nominal. What the environment's info says of them:\n\n{outcomes}",
        ),
    ]


def record(env: PickPlaceEnv, task_id: int, seed: int) -> Episode:
    """Runs the expert until it has succeeded, and the gripper left, or the episode ends."""
    _, info = env.reset(seed=seed, options={"task_id": task_id})
    frames, stages = [_view(env)], ["start"]
    success_step = None
    for number, step in enumerate(expert_episode(env, task_id, seed), start=1):
        frames.append(_view(env))
        stages.append(step.stage.value)
        info = step.info
        if info["is_success"] and success_step is None:
            success_step = number
        if success_step is not None and number == success_step + _STEPS_AFTER_SUCCESS:
            break
    return Episode(get_task(task_id), frames, stages, info, success_step)


def _strip(episode: Episode) -> Image.Image:
    last = len(episode.frames) - 1
    numbers = [*range(0, last, 2), last]
    cells = [
        down([episode.frames[n], caption(f"{n}: {episode.stages[n]}", PEOPLE_SIZE)], gap=4) for n in numbers
    ]
    sheet = grid(cells, n_columns=4, gap=GAP)
    heading = caption(f"{episode.task.instruction} {episode.outcome.capitalize()}.", sheet.width, size=18)
    return framed(down([heading, sheet]), thickness=GAP)


def _animated(episode: Episode) -> list[Image.Image]:
    """The frames, with the instruction above and the stage below."""
    heading = caption(episode.task.instruction, PEOPLE_SIZE, size=14, n_lines=3)
    last = len(episode.frames) - 1
    frames = []
    for number, (frame, stage) in enumerate(zip(episode.frames, episode.stages, strict=True)):
        text = episode.outcome if number == last else f"{number}: {stage}"
        frames.append(framed(down([heading, frame, caption(text, PEOPLE_SIZE, size=14)], gap=2), thickness=4))
    return frames


# Ambiguity


def draw_ambiguity(out: Path, seed: int, tick: Callable[[], object]) -> Figure:
    """The two schemes: what only the instruction tells, and what only the demonstration tells."""
    rows = []
    for draw in (_container_scheme, _object_scheme):
        rows.append(draw(seed))
        tick()
    save_png(framed(down(rows, gap=3 * GAP), thickness=GAP), out / "ambiguity.png")
    text = (
        "Why a policy is given a demonstration and an instruction. In scheme 'container' (the paper's i), "
        "the demonstration alone does not tell which bin is meant. In scheme 'object' (ii), the instruction "
        "alone does not tell which of two identical objects. The ring marks what is meant in the new scene."
    )
    return Figure("ambiguity.png", "The two schemes of ambiguity", text)


def _container_scheme(seed: int) -> Image.Image:
    """A demonstration that fits a color as well as a place, and a new scene where the two part."""
    task = get_task(236)  # Put white colored object in left bin.
    with closing(_environment("container")) as env:
        start, end, shown = _demonstration(env, task, seed)
        scene, layout = _new_scene(
            env, task, seed, lambda new: new.target_container != shown.target_container
        )
        mark = _pixel_of(_container_position(layout), PEOPLE_SIZE)
    color = shown.containers[shown.target_container].color
    word = task.container
    return _row(
        f'Scheme "container": {task.instruction}',
        (start, "The demonstration begins."),
        (
            end,
            f"It ends in the bin on the {word}, which is {color}. By itself, it does not tell what matters.",
        ),
        (
            circled(scene, mark, radius=34),
            f'A new scene: "{word} bin" is in the instruction, {color} is not.',
        ),
    )


def _object_scheme(seed: int) -> Image.Image:
    """A demonstration that picks one of two identical objects, and a new scene with them."""
    task = get_task(31)  # Put blue colored, cylinder shaped jar in green bin.
    with closing(_environment("object")) as env:
        start, end, shown = _demonstration(env, task, seed)
        scene, layout = _new_scene(
            env, task, seed, lambda new: not np.allclose(_target_xy(new), _target_xy(shown), atol=0.05)
        )
        mark = _pixel_of(env.scene.object_pose(layout.target_object).position, PEOPLE_SIZE)
    name, word = OBJECTS[task.row].name, twin_word(task)
    return _row(
        f'Scheme "object": {task.instruction}',
        (start, f"The demonstration begins. The instruction does not tell which {name} is meant."),
        (end, f"It takes the one that stood on the {word} of the tray."),
        (circled(scene, mark, radius=24), f"A new scene: again, it is the {name} on the {word}."),
    )


def _demonstration(env: PickPlaceEnv, task: Task, seed: int) -> tuple[Image.Image, Image.Image, Layout]:
    """The first and the last image of an episode in which the expert succeeds, and its scene."""
    for number in range(_TRIES):
        if _is_in_view(_new_layout(env, task, seed, number)):
            episode = record(env, task.index, _seed(seed, task.index, number))
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
            return _view(env), layout
    raise RuntimeError(f"No scene of task {task.index} as wanted in {_TRIES} tries.")


def _new_layout(env: PickPlaceEnv, task: Task, seed: int, number: int) -> Layout:
    env.reset(seed=_seed(seed, task.index, number), options={"task_id": task.index})
    return env.scene.layout


def _is_in_view(layout: Layout) -> bool:
    """Whether the edges of the image cut no object much. They do cut some that stand far in front."""
    middles = [
        _pixel_of(np.array([*item.xy, TRAY_FLOOR + item.model.height / 2]), 1) for item in layout.objects
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
