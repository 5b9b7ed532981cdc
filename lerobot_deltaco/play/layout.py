"""What stands where on the page. What its parts do is in `page`.

What a user types is shown in text fields alone, which Gradio does not render as HTML.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import gradio as gr

from gym_deltaco.tasks import TASKS
from lerobot_deltaco.play.modalities import BOTH

TITLE = "DeL-TaCo: show it and say it"
_INTRODUCTION = f"""# {TITLE}

The policy puts one of three objects into one of two containers. It receives a **demonstration** (the first
and the last image of an episode in another scene) and an **instruction**. Choose a scene, press *Run*, then
swap one of the two and compare."""
DEMO_SIZE = 192  # px
_POLL_SECONDS = 1.0
_SOURCE = "Folder, or USER/NAME on the Hugging Face Hub"
CSS = """
.gradio-container { max-width: 1280px !important; margin: 0 auto !important; }
.message textarea { border: 2px solid #c45400 !important; }
.pixels img { image-rendering: pixelated; }
.gradio-container input[role="combobox"] { padding-right: 1.75rem !important; text-overflow: ellipsis; }
"""
# Fonts of the system: the page needs no other server.
THEME = gr.themes.Default(
    font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"], primary_hue="orange"
)


@dataclass(frozen=True)
class Start:
    """The top of the page.

    Attributes:
        status: Progress of the start.
        timer: When to look at the progress.
    """

    status: gr.Textbox
    timer: gr.Timer


@dataclass(frozen=True)
class ScenePart:
    """The choice of a scene."""

    image: gr.Image
    objects: gr.Textbox
    task: gr.Dropdown
    seed: gr.Number
    random: gr.Button


@dataclass(frozen=True)
class DemonstrationPart:
    """The choice of a demonstration.

    Attributes:
        first: Its first image.
        last: Its last image.
        video: All of its images, if they are known.
        no_video: Why there is no video.
        shown: What it shows.
        task: Task string of it.
        number: Number of it among those of the task.
        expert: Lets the expert make one.
        use_recorded: Takes the expert's.
        source: Name of another dataset.
        load: Takes its episodes.
    """

    first: gr.Image
    last: gr.Image
    video: gr.Video
    no_video: gr.Textbox
    shown: gr.Textbox
    task: gr.Dropdown
    number: gr.Number
    expert: gr.Button
    use_recorded: gr.Button
    source: gr.Textbox
    load: gr.Button


@dataclass(frozen=True)
class InstructionPart:
    """The instruction, what is used of it and the demonstration, and who acts on it.

    Attributes:
        sentence: The instruction.
        use: What the next run uses.
        run: Runs an episode.
        swap_demonstration: Runs it with another demonstration.
        swap_sentence: Runs it with another instruction.
        message: What went wrong.
        source: Name of another checkpoint.
        load: Takes it.
    """

    sentence: gr.Textbox
    use: gr.Radio
    run: gr.Button
    swap_demonstration: gr.Button
    swap_sentence: gr.Button
    message: gr.Textbox
    source: gr.Textbox
    load: gr.Button


class Panel(NamedTuple):
    """A run: its episode, what happened, and what the policy saw."""

    image: gr.Image
    text: gr.Textbox
    view: gr.Image


def lay_out_start(status: str) -> Start:
    """Lays out the top of the page."""
    gr.Markdown(_INTRODUCTION)
    field = gr.Textbox(status, label="Status", interactive=False, elem_id="status")
    return Start(field, gr.Timer(_POLL_SECONDS))


def lay_out_scene() -> ScenePart:
    """Lays out the column of the scene."""
    gr.Markdown("### 1. Scene")
    image = gr.Image(label="Scene", interactive=False, height=288, buttons=[], elem_id="scene")
    objects = gr.Textbox(label="Objects there", interactive=False, elem_id="objects")
    task = gr.Dropdown(
        [(f"{item.index}: {item.instruction}", item.index) for item in TASKS],
        label="Task that the scene is drawn for",
        elem_id="task",
    )
    with gr.Row():
        seed = gr.Number(0, label="Seed", precision=None, min_width=100, elem_id="seed")
        random = gr.Button("Random scene", elem_id="random_scene", min_width=120)
    return ScenePart(image, objects, task, seed, random)


def lay_out_demonstration() -> DemonstrationPart:
    """Lays out the column of the demonstration."""
    gr.Markdown("### 2. Demonstration")
    with gr.Row():
        first, last = (
            gr.Image(
                label=label,
                interactive=False,
                height=DEMO_SIZE,
                min_width=120,
                buttons=[],
                elem_id=name,
                elem_classes="pixels",
            )
            for label, name in (("First image", "demo_first"), ("Last image", "demo_last"))
        )
    video = gr.Video(
        label="All of its images",
        interactive=False,
        visible=False,
        height=240,
        buttons=[],
        loop=True,
        elem_id="video",
    )
    no_video = gr.Textbox(label="Video", visible=False, interactive=False, lines=2, elem_id="no_video")
    shown = gr.Textbox(label="Shows", interactive=False, elem_id="shown")
    task = gr.Dropdown([], label="Task of the demonstration", elem_id="demonstrated")
    number = gr.Number(1, label="Which of its demonstrations", precision=0, elem_id="number")
    with gr.Row():
        expert = gr.Button("Let the expert do it", elem_id="expert", min_width=140)
        use_recorded = gr.Button("Use that as the demonstration", elem_id="use", min_width=140)
    with gr.Accordion("Another dataset of demonstrations", open=False):
        source = gr.Textbox(
            label=_SOURCE, placeholder="Empty: the checkpoint's own demonstrations", elem_id="dataset"
        )
        load = gr.Button("Load", elem_id="load_dataset")
    return DemonstrationPart(
        first, last, video, no_video, shown, task, number, expert, use_recorded, source, load
    )


def lay_out_instruction() -> InstructionPart:
    """Lays out the column of the instruction."""
    gr.Markdown("### 3. Instruction")
    sentence = gr.Textbox(label="In any words", lines=2, max_lines=2, elem_id="sentence", max_length=1000)
    use = gr.Radio([BOTH], value=BOTH, label="Use", interactive=False, elem_id="modality")
    run = gr.Button("Run", variant="primary", elem_id="run")
    swap_demonstration = gr.Button("Swap the demonstration and run", elem_id="swap_demo")
    swap_sentence = gr.Button("Swap the instruction and run", elem_id="swap_sentence")
    message = gr.Textbox(
        label="Message",
        interactive=False,
        visible=False,
        elem_id="message",
        elem_classes="message",
        max_lines=6,
    )
    with gr.Accordion("Another checkpoint", open=False):
        source = gr.Textbox(label=_SOURCE, elem_id="checkpoint")
        load = gr.Button("Load", elem_id="load")
    return InstructionPart(sentence, use, run, swap_demonstration, swap_sentence, message, source, load)


def lay_out_runs() -> tuple[Panel, Panel]:
    """Lays out the run before and the latest one, side by side."""
    panels = []
    with gr.Row(equal_height=False):
        for name, label in (("earlier", "Run before"), ("latest", "Latest run")):
            with gr.Column(min_width=400):
                gr.Markdown(f"### {label}")
                image, view = (
                    gr.Image(
                        label=label,
                        show_label=False,
                        interactive=False,
                        height=height,
                        buttons=["fullscreen"],
                        elem_id=f"{name}_{part}",
                    )
                    for part, label, height in (
                        ("image", "Episode", 288),
                        ("view", "What the policy sees: pink is the grasp, blue the release", 240),
                    )
                )
                text = gr.Textbox(label="What happened", lines=5, interactive=False, elem_id=f"{name}_text")
                panels.append(Panel(image, text, view))
    earlier, latest = panels
    return earlier, latest


def fields(part: Any) -> list[Any]:
    """The components of a part."""
    return list(vars(part).values())
