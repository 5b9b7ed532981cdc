"""Images and videos of episodes of an evaluation set: where the policy looked, and videos by outcome.

Episodes are chosen by the record and run again, which takes seconds: to render all of them would take many
times as long as the evaluation.
"""

from __future__ import annotations

import html
import re
import shutil
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gym_deltaco.atomic_files import write_json, write_text
from gym_deltaco.object_sets import find_label
from gym_deltaco.sheets import GAP, across, caption, down, save_png, to_image
from gym_deltaco.tasks import CONTAINER_COLORS
from lerobot_deltaco.evaluation.checkpoint_policy import LoadedPolicy
from lerobot_deltaco.evaluation.evaluate import EpisodeImages, Evaluation
from lerobot_deltaco.evaluation.explanation import draw_episode
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.record import EpisodeResult, EvaluationRecord
from lerobot_deltaco.evaluation.videos import write_episode_video
from lerobot_deltaco.lerobot_internals import without_rollout_progress
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy

# What came of an episode, and what it is called.
KINDS = MappingProxyType(
    {
        "success": "Success",
        "wrong_object": "Wrong object",
        "nothing_grasped": "Nothing grasped",
        "wrong_container": "Wrong container",
        "dropped": "Dropped",
    }
)
EXPLANATIONS, VIDEOS = "explanations", "videos"
RENDER_SIZE = 256  # px
VIDEO_FPS = 10
_MAX_SLUG = 60  # characters


class RerunEpisode(NamedTuple):
    """An episode that was run again.

    Attributes:
        result: Episode as it is recorded.
        images: Images of the episode.
        is_repeated: Whether it ended as recorded. On another processor, it may end otherwise.
    """

    result: EpisodeResult
    images: EpisodeImages
    is_repeated: bool


def kind_of(episode: EpisodeResult) -> str:
    """What came of an episode, one of `KINDS`."""
    if episode.success:
        return "success"
    if episode.grasped_object < 0:
        return "nothing_grasped"
    if not episode.right_object:
        return "wrong_object"
    if episode.object_containers[episode.target_object] == 1 - episode.target_container:
        return "wrong_container"
    return "dropped"


def in_words(episode: EpisodeResult) -> str:
    """What came of an episode, in a sentence."""
    grasped = None if episode.grasped_object < 0 else find_label(episode.objects[episode.grasped_object]).name
    target = find_label(episode.objects[episode.target_object]).name
    wanted = CONTAINER_COLORS[episode.target_container]
    return {
        "success": f"Success: the {target} lies in the {wanted} bin.",
        "wrong_object": f"Wrong object: it grasped the {grasped}, not the {target}.",
        "nothing_grasped": f"It grasped nothing; the {target} was meant.",
        "wrong_container": f"Wrong container: the {target} was to lie in the {wanted} bin.",
        "dropped": f"It grasped the {target}, which lies in no bin.",
    }[kind_of(episode)]


def check_explainable(loaded: LoadedPolicy) -> None:
    """Checks that a policy finds goals, which are what an explanation shows.

    Raises:
        ValueError: It finds none.
    """
    config = loaded.policy.config
    if isinstance(loaded.policy, DeltacoPolicy):
        if config.locates_goals:
            return
        kind = f"demo_encoder={config.demo_encoder}"
    else:
        kind = f"type={config.type}"
    raise ValueError(
        "--explain draws where a policy with `demo_encoder=correspondence` looks. This one "
        f"(`{kind}`) finds no places in the image that could be drawn. Leave out --explain; --videos shows "
        "episodes of any policy."
    )


def write_explanations(
    folder: Path, loaded: LoadedPolicy, plan: EvaluationPlan, record: EvaluationRecord, n_episodes: int
) -> list[Path]:
    """Draws where the policy looked in some episodes, spread evenly over the set.

    Args:
        folder: Folder in which the folder of the images is made anew.
        loaded: The policy.
        plan: Plan of the evaluation set.
        record: Record of the evaluation set.
        n_episodes: Number of episodes.

    Returns:
        The images, one for each episode.

    Raises:
        ValueError: The policy finds no goals.
    """
    check_explainable(loaded)
    chosen = _evenly(record.episodes, n_episodes)
    written = []
    with _NewFolder(folder / EXPLANATIONS) as new:
        for episode, images, _ in _run_again(loaded, plan, record, chosen):
            assert images.goals is not None
            title = f"“{episode.instruction}” {in_words(episode)}"
            drawn = draw_episode(title, images.scenes, images.observed, images.demonstration, images.goals)
            save_png(to_image(drawn), new / f"{_file_name(episode)}.png")
            written.append(folder / EXPLANATIONS / f"{_file_name(episode)}.png")
    return written


def write_videos(
    folder: Path, loaded: LoadedPolicy, plan: EvaluationPlan, record: EvaluationRecord, n_each: int
) -> Path:
    """Makes videos of some episodes of each kind of outcome.

    Args:
        folder: Folder in which the folder of the videos is made anew: an MP4 file for each episode in a
            folder for each of `KINDS`, `index.json` with what is known of them, `index.html`, which shows
            them, and `sheet.png` with the last image of each.
        loaded: The policy.
        plan: Plan of the evaluation set.
        record: Record of the evaluation set.
        n_each: Number of episodes of each kind; all of them if there are fewer.

    Returns:
        The page `index.html`.
    """
    groups: dict[str, list[EpisodeResult]] = defaultdict(list)
    for episode in record.episodes:
        groups[kind_of(episode)].append(episode)
    chosen = [episode for group in groups.values() for episode in _evenly(group, n_each)]
    index = []
    last_images: dict[str, list[Image.Image]] = defaultdict(list)
    with _NewFolder(folder / VIDEOS) as new:
        for episode, images, is_repeated in _run_again(loaded, plan, record, chosen):
            kind = kind_of(episode)
            name = f"{kind}/{_file_name(episode)}.mp4"
            (new / kind).mkdir(exist_ok=True)
            frames = [_video_frame(episode, images, step) for step in range(len(images.scenes))]
            write_episode_video(new / name, frames, VIDEO_FPS)
            last_images[kind].append(Image.fromarray(frames[-1]))
            index.append(
                {
                    "file": name,
                    "outcome": kind,
                    "what_happened": in_words(episode),
                    "task_id": episode.task_id,
                    "trial": episode.trial,
                    "seed": episode.seed,
                    "instruction": episode.instruction,
                    "demonstration": episode.demonstration,
                    "ends_as_recorded": is_repeated,
                }
            )
        counts = {kind: len(groups[kind]) for kind in KINDS}
        write_json(new / "index.json", {"episodes_by_outcome": counts, "videos": index}, indent=1)
        write_text(new / "index.html", _page(record, counts, index))
        rows = [
            down(
                [
                    caption(f"{title}: {counts[kind]} of {len(record.episodes)}", 400),
                    across(last_images[kind]),
                ]
            )
            for kind, title in KINDS.items()
            if kind in last_images
        ]
        save_png(down(rows, 2 * GAP), new / "sheet.png")
    return folder / VIDEOS / "index.html"


class _NewFolder:
    """Makes a folder under another name, which takes its place if the block ends without an error."""

    def __init__(self, path: Path) -> None:
        self._path, self._temporary = path, path.with_name(f".{path.name}.part")

    def __enter__(self) -> Path:
        shutil.rmtree(self._temporary, ignore_errors=True)
        self._temporary.mkdir(parents=True)
        return self._temporary

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is not None:
            shutil.rmtree(self._temporary, ignore_errors=True)
            return
        shutil.rmtree(self._path, ignore_errors=True)
        self._temporary.rename(self._path)


def _run_again(
    loaded: LoadedPolicy, plan: EvaluationPlan, record: EvaluationRecord, chosen: Iterable[EpisodeResult]
) -> Iterator[RerunEpisode]:
    """Runs episodes again as they were run, in the same batches, and renders them."""
    wanted = {(episode.task_id, episode.trial): episode for episode in chosen}
    evaluation = Evaluation(*loaded, plan, record.step, render_size=RENDER_SIZE)
    with evaluation, without_rollout_progress():
        for number, batch in enumerate(evaluation.batches):
            rendered = [each for each in batch if (each.task_id, each.trial) in wanted]
            for outcome in evaluation.run(number, rendered) if rendered else ():
                if outcome.images is None:
                    continue
                again = outcome.result
                recorded = wanted[again.task_id, again.trial]
                is_repeated = (again.success, again.grasped_object, again.object_containers) == (
                    recorded.success,
                    recorded.grasped_object,
                    recorded.object_containers,
                )
                yield RerunEpisode(recorded, outcome.images, is_repeated)


def _evenly(episodes: Sequence[EpisodeResult], n: int) -> list[EpisodeResult]:
    """At most n of them, evenly spread."""
    places = np.linspace(0, len(episodes) - 1, min(n, len(episodes))).round().astype(int)
    return [episodes[place] for place in places.tolist()]


def _file_name(episode: EpisodeResult) -> str:
    """Task, trial and instruction, without a suffix."""
    words = re.sub(r"[^a-z0-9]+", "-", episode.instruction.lower()).strip("-")
    return f"task_{episode.task_id:03d}_trial_{episode.trial}_{words[:_MAX_SLUG].strip('-')}"


def _video_frame(episode: EpisodeResult, images: EpisodeImages, step: int) -> NDArray[np.uint8]:
    """An image of an episode with its demonstration, instruction and step, of even height and width."""
    size = RENDER_SIZE
    columns = [to_image(images.scenes[step])]
    if images.demonstration is not None:
        half = (size - GAP) // 2
        ends = [
            to_image(image).resize((half, half), Image.Resampling.BICUBIC) for image in images.demonstration
        ]
        columns.insert(0, down(ends))
    top = across(columns)
    is_last = step == len(images.scenes) - 1
    text = in_words(episode) if is_last else f"step {step} of {len(images.scenes) - 1}"
    words = caption(f"“{episode.instruction}”\n{text}", top.width, 14, n_lines=5)
    frame = np.asarray(down([top, words]))
    return frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]


def _page(record: EvaluationRecord, counts: dict[str, int], index: Sequence[dict[str, object]]) -> str:
    n_episodes = len(record.episodes)
    parts = [
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>",
        f"<title>{html.escape(record.experiment)}, step {record.step}</title>",
        "<style>body{font-family:sans-serif;margin:2em;max-width:80em}figure{display:inline-block;"
        "margin:.5em;width:24em;vertical-align:top}video{width:100%}figcaption{font-size:.85em}</style></head>",
        f"<body><h1>{html.escape(record.experiment)}, step {record.step:,}</h1>",
        f"<p>{n_episodes} episodes of {html.escape(record.tasks)}; {record.success_rate:.1%} succeeded. At "
        "the left, first and last image of the demonstration, if there is one.</p>",
    ]
    for kind, title in KINDS.items():
        parts.append(f"<h2>{title}: {counts[kind]} ({counts[kind] / n_episodes:.1%})</h2>")
        for video in index:
            if video["outcome"] != kind:
                continue
            remark = "" if video["ends_as_recorded"] else " <em>Ended otherwise than recorded.</em>"
            text = {name: html.escape(str(value)) for name, value in video.items()}
            parts.append(
                f"<figure><video controls loop muted preload='metadata' src='{text['file']}'></video>"
                f"<figcaption>“{text['instruction']}” {text['what_happened']} (Task {text['task_id']}, trial "
                f"{text['trial']}.){remark}</figcaption></figure>"
            )
    return "\n".join([*parts, "</body></html>"]) + "\n"
