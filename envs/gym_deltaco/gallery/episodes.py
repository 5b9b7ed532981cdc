"""Episodes of the scripted expert: a strip of images, and an animation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

from gym_deltaco import CONTROL_FPS, EPISODE_STEPS
from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.gallery.scenes import PEOPLE_SIZE, Figure, make_env, scene_seed, view_of
from gym_deltaco.sheets import GAP, caption, down, framed, grid, save_gif, save_png
from gym_deltaco.tasks import OBJECTS, Task, get_task

_SLOWED = 3  # factor by which the animation is slower than nominal
_FRAME_MS = 1000 * _SLOWED // CONTROL_FPS
_LAST_FRAME_MS = 1500
_STEPS_AFTER_SUCCESS = 2  # to show


class Episode(NamedTuple):
    """An episode of the expert, up to shortly after its success, or to its end."""

    task: Task
    frames: list[Image.Image]  # before the first step, and after each one
    stages: list[str]  # of each frame
    info: dict[str, Any]  # after the last step
    success_step: int | None  # from 1; None without success

    @property
    def outcome(self) -> str:
        """Description from the environment's info."""
        if self.success_step is not None:
            return f"success after step {self.success_step}"
        grasped = self.info["grasped_object"]
        held = OBJECTS[self.info["objects"][grasped]].name if grasped >= 0 else "nothing"
        return f"no success in {len(self.frames) - 1} steps (last grasped: {held})"


def draw_episodes(out: Path, seed: int, task_ids: Sequence[int], tick: Callable[[], object]) -> list[Figure]:
    """Episodes of the expert: the first one as a strip, all of them as an animation."""
    episodes = []
    with closing(make_env("container")) as env:
        for task_id in task_ids:
            episodes.append(record(env, task_id, scene_seed(seed, task_id)))
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
            "tries again when it fails.",
        ),
        Figure(
            "episode.gif",
            "Episodes of the expert, animated",
            f"Each is shown until shortly after its success, or for all of its {EPISODE_STEPS} steps, "
            f"{_SLOWED} times slower than nominal. Outcomes, from the environment's info:\n\n{outcomes}",
        ),
    ]


def record(env: PickPlaceEnv, task_id: int, seed: int) -> Episode:
    """Runs the expert until it has succeeded, and the gripper left, or the episode ends."""
    _, info = env.reset(seed=seed, options={"task_id": task_id})
    frames, stages = [view_of(env)], ["start"]
    success_step = None
    for number, step in enumerate(expert_episode(env, task_id, seed), start=1):
        frames.append(view_of(env))
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
