"""Demonstrations of the page: those of a checkpoint, and those made of whole episodes."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.evaluation.videos import write_episode_video
from lerobot_deltaco.play.errors import PlayError
from lerobot_deltaco.policy.demonstrations import DemonstrationSet, kept_frame_indices, resize_images
from lerobot_deltaco.policy.goals.keyframes import find_keyframes


@dataclass(frozen=True)
class Demonstration:
    """An episode that demonstrates a task.

    Attributes:
        title: Description for the page.
        frames: Kept images, the first and the last among them, (kept, H, W, 3), of the policy's
            `demo_image_size`.
        grasp_state: Robot state when the gripper closed, (state,); NaN if it never did, None if it is not
            known.
        video: All of its images as an MP4 file; None if they are not known.
    """

    title: str
    frames: NDArray[np.uint8]
    grasp_state: NDArray[np.float32] | None = None
    video: bytes | None = None

    @property
    def ends(self) -> NDArray[np.uint8]:
        """First and last image, (2, H, W, 3)."""
        return self.frames[[0, -1]]


def check_number(counts: dict[str, int], task: str, number: int, where: str) -> None:
    """Checks that there is a demonstration.

    Args:
        counts: Number of demonstrations by task string.
        task: Task string.
        number: Number of the demonstration among those of the task, from 1.
        where: What has the demonstrations, for the message.

    Raises:
        PlayError: There is none.
    """
    if task not in counts:
        raise PlayError(f"The {where} has no demonstration of {task!r}.")
    if not isinstance(number, int) or not 1 <= number <= counts[task]:
        raise PlayError(f"{task!r} has the demonstrations 1 to {counts[task]}. Got {number!r}.")


def stored_demonstration(demonstrations: DemonstrationSet, task: str, number: int) -> Demonstration:
    """A demonstration that a checkpoint keeps, which has no video: only some of its images are known.

    Args:
        demonstrations: The checkpoint's.
        task: Task string.
        number: Number of the demonstration among those of the task, from 1.
    """
    rows = demonstrations.rows[task]
    row = rows[number - 1]
    frames = demonstrations.frames[row].permute(0, 2, 3, 1).cpu().numpy()
    states = demonstrations.grasp_states
    grasp_state = None if states is None else states[row].cpu().numpy()
    return Demonstration(f"{task} ({number} of {len(rows)})", frames, grasp_state)


def demonstration_of(
    title: str,
    images: Tensor,
    robot: tuple[Tensor, Tensor] | None,
    config: DeltacoConfig,
    video_images: Sequence[NDArray[np.uint8]],
    fps: int,
) -> Demonstration:
    """What a policy gets of a whole episode, with a video of all of it.

    Args:
        title: Description for the page.
        images: Images of the camera, (frames, 3, H, W), uint8.
        robot: States of the robot, (frames, state), and commands of its gripper, greater for more open,
            (frames,); None if the policy does without.
        config: The policy's.
        video_images: Images for people, (H, W, 3) each.
        fps: Frames per second.
    """
    last = len(images) - 1
    kept = resize_images(images[kept_frame_indices(0, last, config.n_demo_frames)], config.demo_image_size)
    grasp_state = None
    if robot is not None:
        grasp_state = find_keyframes(*robot, [(0, last)]).grasp_states[0].numpy()
    return Demonstration(title, kept.permute(0, 2, 3, 1).numpy(), grasp_state, _encoded(video_images, fps))


def _encoded(frames: Sequence[NDArray[np.uint8]], fps: int) -> bytes:
    """An MP4 file."""
    with tempfile.TemporaryDirectory(prefix="deltaco-play-") as folder:
        path = Path(folder) / "video.mp4"
        write_episode_video(path, frames, fps)
        return path.read_bytes()
