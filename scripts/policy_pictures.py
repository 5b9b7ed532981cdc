"""Draws the documentation's pictures of the shipped policy: policy.gif and found.png in docs/images."""

from __future__ import annotations

from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import get_task
from lerobot_deltaco.checkpoints import LoadedPolicy
from lerobot_deltaco.demonstrations import Demonstration
from lerobot_deltaco.pictures import demonstration_ends, draw_found
from lerobot_deltaco.recording import load_conditioned, record_episode

OUT = Path("docs/images")
CHECKPOINT = Path("checkpoints/pick_place")
SEED = 1000  # of the evaluation protocol
# A scene of which each demonstration shows another object
SCENE_TASK, TRIAL, DEMONSTRATED_TASKS = 25, 2, (25, 29)
SENTENCES = ("Put it in green bin.", "Put it in red bin.")
FOUND_TASK, FOUND_SIZE = 128, 448
SIZE, END_SIZE, GAP, HEADER = 224, 108, 8, 30  # px
N_STEPS, FRAME_MS, LAST_FRAME_MS = 16, 160, 1800
N_COLORS = 96
FONT = ImageFont.load_default(size=16)


def draw_policy(loaded: LoadedPolicy) -> None:
    """Draws four episodes of one scene: a row for each demonstration, a column for each sentence."""
    left = END_SIZE + 3 * GAP
    canvas = Image.new("RGB", (left + 2 * (SIZE + GAP), HEADER + 2 * (SIZE + GAP)), "white")
    draw = ImageDraw.Draw(canvas)
    draw.text((GAP + END_SIZE / 2, HEADER / 2), "demonstration", "black", FONT, "mm")
    episodes = []
    for row, task_id in enumerate(DEMONSTRATED_TASKS):
        y, demonstration = HEADER + row * (SIZE + GAP), _demonstration(loaded, task_id)
        for n, end in enumerate(demonstration_ends(demonstration)):
            image = Image.fromarray(end).resize((END_SIZE, END_SIZE), Image.Resampling.BICUBIC)
            canvas.paste(image, (GAP, y + n * (END_SIZE + GAP)))
        for column, sentence in enumerate(SENTENCES):
            x = left + column * (SIZE + GAP)
            draw.text((x + SIZE / 2, HEADER / 2), f"“{sentence}”", "black", FONT, "mm")
            seed = episode_seed(0, "evaluation", SCENE_TASK, 0, SEED + TRIAL)
            recording = record_episode(loaded, SCENE_TASK, seed, sentence, [demonstration], render_size=SIZE)
            episodes.append((x, y, recording.frames))
    frames = []
    for step in range(N_STEPS + 1):
        frame = canvas.copy()
        for x, y, images in episodes:
            frame.paste(Image.fromarray(images[step]), (x, y))
        frames.append(frame)
    palette = frames[len(frames) // 2].quantize(N_COLORS)
    first, *others = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [FRAME_MS] * N_STEPS + [LAST_FRAME_MS]
    first.save(OUT / "policy.gif", save_all=True, append_images=others, duration=durations, loop=0)


def draw_locations(loaded: LoadedPolicy) -> None:
    """Draws where the policy looks in one scene."""
    demonstration = _demonstration(loaded, FOUND_TASK)
    seed = episode_seed(0, "evaluation", FOUND_TASK, 0, SEED)
    recording = record_episode(
        loaded, FOUND_TASK, seed, demonstration.task, [demonstration], render_size=FOUND_SIZE
    )
    assert recording.found is not None
    picture = draw_found(recording.frames[0], demonstration_ends(demonstration), recording.found)
    picture.quantize(256).save(OUT / "found.png", optimize=True)


def _demonstration(loaded: LoadedPolicy, task_id: int) -> Demonstration:
    return loaded.policy.demonstrations.of_task(get_task(task_id).instruction)[0]


if __name__ == "__main__":
    policy = load_conditioned(CHECKPOINT)
    draw_policy(policy)
    draw_locations(policy)
