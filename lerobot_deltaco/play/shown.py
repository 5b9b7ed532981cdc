"""What a user's session looks like on the page: updates of its components."""

from __future__ import annotations

from typing import Any

import gradio as gr
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lerobot_deltaco.play.layout import (
    DEMO_SIZE,
    DemonstrationPart,
    InstructionPart,
    Panel,
    ScenePart,
    Start,
)
from lerobot_deltaco.play.session import Run, Session
from lerobot_deltaco.play.videos import VideoFiles

Updates = dict[Any, Any]


def show_start(part: Start, session: Session) -> Updates:
    """Which checkpoint is loaded."""
    if session.checkpoint is None:
        return {}
    return {part.status: f"Ready. The checkpoint is {session.checkpoint}."}


def show_scene(part: ScenePart, session: Session) -> Updates:
    """The scene."""
    return {
        part.image: None if session.view is None else session.view.image,
        part.objects: "" if session.view is None else ", ".join(session.view.objects),
        part.task: None if session.scene is None else session.scene.task_id,
        part.seed: 0 if session.scene is None else session.scene.seed,
    }


def show_demonstration(part: DemonstrationPart, session: Session, files: VideoFiles) -> Updates:
    """The demonstration, with a video or the reason why there is none."""
    demonstration = session.demonstration
    ends = None if demonstration is None else demonstration.ends
    video = None if demonstration is None else demonstration.video
    chosen, place = session.demonstrated or (None, 1)
    reason = ""
    if demonstration is not None and video is None:
        reason = (
            f"None: a checkpoint keeps only {len(demonstration.frames)} images of a demonstration. Load a "
            "dataset, or let the expert do it, to see all of them."
        )
    return {
        part.first: None if ends is None else _enlarged(ends[0]),
        part.last: None if ends is None else _enlarged(ends[1]),
        part.video: gr.update(value=None if video is None else files.put(video), visible=video is not None),
        part.no_video: gr.update(value=reason, visible=bool(reason)),
        part.shown: "Nothing is chosen." if demonstration is None else demonstration.title,
        part.task: gr.update(choices=list(session.demonstrated_tasks or {}), value=chosen),
        part.number: place,
    }


def show_instruction(part: InstructionPart, session: Session) -> Updates:
    """The instruction, and what is used of it and the demonstration."""
    choices, reason = session.uses
    use = gr.update(
        choices=list(choices), value=session.use, interactive=len(choices) > 1, info=reason or None
    )
    return {part.sentence: session.sentence, part.use: use}


def show_run(panel: Panel, run: Run | None) -> Updates:
    """A run."""
    if run is None:
        return {panel.image: None, panel.text: "", panel.view: None}
    return {
        panel.image: run.moment.image,
        panel.text: f"{run.title}\n{run.moment.text}",
        panel.view: run.moment.view,
    }


def _enlarged(image: NDArray[np.uint8]) -> Image.Image:
    return Image.fromarray(image).resize((DEMO_SIZE, DEMO_SIZE), Image.Resampling.NEAREST)
