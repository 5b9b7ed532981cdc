"""The page itself: what stands where, and which action each button takes.

What a user types is shown in text fields alone, which Gradio does not render as HTML.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any

import gradio as gr
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gym_deltaco.tasks import TASKS
from lerobot_deltaco.play.engine import Engine
from lerobot_deltaco.play.errors import PlayError
from lerobot_deltaco.play.session import Actions, Run, Session

logger = logging.getLogger(__name__)

TITLE = "DeL-TaCo: show it and say it"
_INTRODUCTION = f"""# {TITLE}

The policy puts one of three objects into one of two bins. It receives a **demonstration** (the first and the
last image of an episode in another scene) and an **instruction**. Choose a scene, press *Run*, then swap one
of the two and compare."""
_DEMO_SIZE = 192  # px
_POLL_SECONDS = 1.0
_HOUR = 3600  # s
_ONE_AT_A_TIME = {"concurrency_id": "simulator", "concurrency_limit": 1, "api_visibility": "private"}
_CSS = """
.gradio-container { max-width: 1280px !important; margin: 0 auto !important; }
.message textarea { border: 2px solid #c45400 !important; }
.pixels img { image-rendering: pixelated; }
"""
# Fonts of the system: the page needs no other server.
_THEME = gr.themes.Default(
    font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"], primary_hue="orange"
)

Updates = dict[Any, Any]


def launch_options() -> dict[str, Any]:
    """Options of `Blocks.launch` that belong to the page: its look, and what it serves."""
    return {"theme": _THEME, "css": _CSS, "footer_links": [], "show_error": False, "max_file_size": 0}


def build_page(engine: Engine) -> gr.Blocks:
    """Makes the page.

    Args:
        engine: Runs episodes. It may still be starting.

    Returns:
        The page, with a queue, to be launched with `launch_options()`.
    """
    actions = Actions(engine)
    with gr.Blocks(title=TITLE, analytics_enabled=False, delete_cache=(_HOUR, _HOUR)) as page:
        session_state = gr.State(Session(), time_to_live=_HOUR)
        gr.Markdown(_INTRODUCTION)
        status = gr.Textbox(engine.status.text, label="Status", interactive=False, elem_id="status")
        timer = gr.Timer(_POLL_SECONDS)
        with gr.Row(equal_height=False):
            with gr.Column(min_width=280):
                gr.Markdown("### 1. Scene")
                scene_image = gr.Image(
                    label="Scene", interactive=False, height=288, buttons=[], elem_id="scene"
                )
                objects = gr.Textbox(label="Objects there", interactive=False, elem_id="objects")
                task = gr.Dropdown(
                    [(f"{item.index}: {item.instruction}", item.index) for item in TASKS],
                    label="Task that the scene is drawn for",
                    elem_id="task",
                )
                with gr.Row():
                    seed = gr.Number(0, label="Seed", precision=None, min_width=100, elem_id="seed")
                    random_scene = gr.Button("Random scene", elem_id="random_scene", min_width=120)
            with gr.Column(min_width=280):
                gr.Markdown("### 2. Demonstration")
                with gr.Row():
                    first, last = (
                        gr.Image(
                            label=label,
                            interactive=False,
                            height=_DEMO_SIZE,
                            min_width=120,
                            buttons=[],
                            elem_id=name,
                            elem_classes="pixels",
                        )
                        for label, name in (("First image", "demo_first"), ("Last image", "demo_last"))
                    )
                shown = gr.Textbox(label="Shows", interactive=False, elem_id="shown")
                demonstrated = gr.Dropdown([], label="Task of the demonstration", elem_id="demonstrated")
                number = gr.Number(1, label="Which of its demonstrations", precision=0, elem_id="number")
                with gr.Row():
                    expert = gr.Button("Let the expert do it", elem_id="expert", min_width=140)
                    use_recorded = gr.Button("Use that as the demonstration", elem_id="use", min_width=140)
            with gr.Column(min_width=280):
                gr.Markdown("### 3. Instruction")
                sentence = gr.Textbox(
                    label="In any words", lines=2, max_lines=2, elem_id="sentence", max_length=1000
                )
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
                    checkpoint = gr.Textbox(
                        label="Folder, or USER/NAME on the Hugging Face Hub", elem_id="checkpoint"
                    )
                    load = gr.Button("Load", elem_id="load")
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
                    text = gr.Textbox(
                        label="What happened", lines=5, interactive=False, elem_id=f"{name}_text"
                    )
                    panels.append((image, text, view))
        earlier, latest = panels

        def shown_run(run: Run | None, panel: tuple[Any, Any, Any]) -> Updates:
            image, text, view = panel
            if run is None:
                return {image: None, text: "", view: None}
            return {
                image: run.moment.image,
                text: f"{run.title}\n{run.moment.text}",
                view: run.moment.view,
            }

        def everything(session: Session) -> Updates:
            """Updates of all components, so that what is shown is what the session holds."""
            demonstration = session.demonstration
            ends = None if demonstration is None else demonstration.ends
            counts = session.demonstrated_tasks or {}
            chosen, place = session.demonstrated or (None, 1)
            return {
                scene_image: None if session.view is None else session.view.image,
                objects: "" if session.view is None else ", ".join(session.view.objects),
                task: None if session.scene is None else session.scene.task_id,
                seed: 0 if session.scene is None else session.scene.seed,
                first: None if ends is None else _enlarged(ends[0]),
                last: None if ends is None else _enlarged(ends[1]),
                shown: "Nothing is chosen." if demonstration is None else demonstration.title,
                demonstrated: gr.update(choices=list(counts), value=chosen),
                number: place,
                sentence: session.sentence,
                **shown_run(session.earlier, earlier),
                **shown_run(session.latest, latest),
            }

        def shown_message(text: str) -> Updates:
            return {message: gr.update(value=text, visible=bool(text))}

        def changes(action: Callable[..., Session]) -> Callable[..., Updates]:
            """An action that changes the session at once, as a handler of an event."""

            def on_event(session: Session, *inputs: Any) -> Updates:
                try:
                    session = action(session, *inputs)
                except Exception as error:  # whatever it is, the page says so and goes on
                    return shown_message(_explained(error))
                return {session_state: session, **everything(session), **shown_message("")}

            return on_event

        def runs(action: Callable[..., Iterator[Session]]) -> Callable[..., Iterator[Updates]]:
            """An action that runs an episode, as a handler of an event: it shows every step."""

            def on_event(session: Session, *inputs: Any) -> Iterator[Updates]:
                is_first = True
                yield shown_message("")
                try:
                    for running in action(session, *inputs):
                        session = running
                        assert session.latest is not None
                        image, text, _ = latest
                        step = shown_run(session.latest, latest)
                        yield everything(session) if is_first else {image: step[image], text: step[text]}
                        is_first = False
                except Exception as error:  # whatever it is, the page says so and goes on
                    yield shown_message(_explained(error))
                    return
                yield {session_state: session, **everything(session)}

            return on_event

        def poll(session: Session) -> Updates:
            """Shows how far the engine is, and opens its checkpoint once it can."""
            now = engine.status
            update: Updates = {status: now.text, timer: gr.update(active=not now.is_done)}
            if now.is_ready and session.checkpoint is None:
                update |= changes(actions.open_checkpoint)(session, engine.default_checkpoint)
                update[status] = f"Ready. The checkpoint is {engine.default_checkpoint}."
            return update

        def open_checkpoint(session: Session, name: str) -> Updates:
            update = changes(actions.open_checkpoint)(session, name)
            return (
                {**update, status: f"Ready. The checkpoint is {name}."} if session_state in update else update
            )

        everywhere = [
            *(session_state, status, timer, message, scene_image, objects, task, seed),
            *(first, last, shown, demonstrated, number, sentence, *earlier, *latest),
        ]

        def on(triggers: list[Any], handler: Callable[..., Any], *inputs: Any, **options: Any) -> None:
            options = {"outputs": everywhere, **_ONE_AT_A_TIME, **options}
            gr.on(triggers, handler, inputs=[session_state, *inputs], **options)

        hidden = {"concurrency_id": None, "concurrency_limit": None, "show_progress": "hidden"}
        on([timer.tick, page.load], poll, **hidden)
        on([task.input, seed.submit, seed.blur], changes(actions.choose_scene), task, seed)
        on([random_scene.click], changes(actions.random_scene))
        on([demonstrated.input, number.submit], changes(actions.choose_demonstration), demonstrated, number)
        on([use_recorded.click], changes(actions.use_recorded))
        on([load.click, checkpoint.submit], open_checkpoint, checkpoint)
        quiet = {"show_progress": "hidden"}
        on([run.click, sentence.submit], runs(actions.run), sentence, **quiet)
        on([swap_demonstration.click], runs(actions.run_with_other_demonstration), sentence, **quiet)
        on([swap_sentence.click], runs(actions.run_with_other_sentence), **quiet)
        on([expert.click], runs(actions.run_expert), **quiet)
    return page.queue()


def _enlarged(image: NDArray[np.uint8]) -> Image.Image:
    return Image.fromarray(image).resize((_DEMO_SIZE, _DEMO_SIZE), Image.Resampling.NEAREST)


def _explained(error: Exception) -> str:
    """Message for the user about an error."""
    if isinstance(error, PlayError):
        return str(error)
    logger.error("An action of the page failed.", exc_info=error)
    return "Something went wrong that is not your fault. The terminal of the page has the details."
