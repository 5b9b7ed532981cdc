"""The page itself: which action each of its parts takes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any

import gradio as gr

from lerobot_deltaco.play.engine import Engine
from lerobot_deltaco.play.errors import PlayError
from lerobot_deltaco.play.layout import (
    CSS,
    THEME,
    TITLE,
    fields,
    lay_out_demonstration,
    lay_out_instruction,
    lay_out_runs,
    lay_out_scene,
    lay_out_start,
)
from lerobot_deltaco.play.session import Actions, Session
from lerobot_deltaco.play.shown import (
    Updates,
    show_demonstration,
    show_instruction,
    show_run,
    show_scene,
    show_start,
)
from lerobot_deltaco.play.videos import VideoFiles

logger = logging.getLogger(__name__)

_HOUR = 3600  # s
# Events that wait for their turn. More are refused, and their users are told that the page is busy.
MAX_WAITING = 32
_FORGOTTEN = (
    "The page has begun anew, with its first checkpoint and a random scene: it forgets what you chose after "
    "an hour without a click."
)
_ONE_AT_A_TIME = {"concurrency_id": "simulator", "concurrency_limit": 1, "api_visibility": "private"}


def launch_options() -> dict[str, Any]:
    """Options of `Blocks.launch` that belong to the page: its look, and what it serves."""
    return {
        "theme": THEME,
        "css": CSS,
        "footer_links": [],
        "show_error": False,
        "max_file_size": 0,
        # Else, Gradio opens a public tunnel on some services by itself.
        "share": False,
    }


def build_page(engine: Engine) -> gr.Blocks:
    """Makes the page.

    Args:
        engine: Runs episodes. It may still be starting.

    Returns:
        The page, with a queue, to be launched with `launch_options()`.
    """
    actions, files = Actions(engine), VideoFiles()
    with gr.Blocks(title=TITLE, analytics_enabled=False, delete_cache=(_HOUR, _HOUR)) as page:
        session_state = gr.State(Session(), time_to_live=_HOUR)
        start = lay_out_start(engine.status.text)
        with gr.Row(equal_height=False):
            with gr.Column(min_width=280):
                scene = lay_out_scene()
            with gr.Column(min_width=280):
                demonstration = lay_out_demonstration()
            with gr.Column(min_width=280):
                instruction = lay_out_instruction()
        earlier, latest = lay_out_runs()

        def everything(session: Session, *sentences: str) -> Updates:
            """Updates of all components, so that what is shown is what the session holds.

            Args:
                session: The session to show.
                sentences: What the page already has. If the session's sentence is among them, its box is left
                    alone: the user may be writing in it.
            """
            updates = {
                **show_start(start, session),
                **show_scene(scene, session),
                **show_demonstration(demonstration, session, files),
                **show_instruction(instruction, session),
                **show_run(earlier, session.earlier),
                **show_run(latest, session.latest),
            }
            if session.sentence in sentences:
                del updates[instruction.sentence]
            return updates

        def shown_message(text: str) -> Updates:
            return {instruction.message: gr.update(value=text, visible=bool(text))}

        def begin(session: Session, notice: str = _FORGOTTEN) -> tuple[Session, Updates]:
            """The session and, if it had to be opened anew, what is then shown, with a notice."""
            resumed = actions.resumed(session)
            if resumed is session:
                return session, {}
            return resumed, {session_state: resumed, **everything(resumed), **shown_message(notice)}

        def changes(action: Callable[..., Session], notice: str = _FORGOTTEN) -> Callable[..., Updates]:
            """An action that changes the session at once, as a handler of an event."""

            def on_event(session: Session, *inputs: Any) -> Updates:
                known = session.sentence
                begun: Updates = {}
                try:
                    session, begun = begin(session, notice)
                    session = action(session, *inputs)
                    shown = everything(session, known)
                except Exception as error:  # whatever it is, the page says so and goes on
                    return {**begun, **shown_message(_explained(error))}
                return {**shown_message(""), **begun, session_state: session, **shown}

            return on_event

        def runs(action: Callable[..., Iterator[Session]]) -> Callable[..., Iterator[Updates]]:
            """An action that runs an episode, as a handler of an event: it shows every step."""

            def on_event(session: Session, *inputs: Any) -> Iterator[Updates]:
                is_first = True
                known = (session.sentence, *inputs)
                yield shown_message("")
                try:
                    session, begun = begin(session)
                    if begun:
                        yield begun
                        known = ()
                    for running in action(session, *inputs):
                        session = running
                        step = show_run(latest, session.latest)
                        yield (
                            everything(session, *known)
                            if is_first
                            else {part: step[part] for part in (latest.image, latest.text)}
                        )
                        is_first = False
                    yield {session_state: session, **everything(session, session.sentence)}
                except Exception as error:  # whatever it is, the page says so and goes on
                    yield shown_message(_explained(error))

            return on_event

        def poll(session: Session) -> Updates:
            """Shows how far the engine is, and opens its checkpoint once it can."""
            now = engine.status
            update: Updates = {start.status: now.text, start.timer: gr.update(active=not now.is_done)}
            if now.is_ready and session.checkpoint is None:
                update |= changes(lambda opened: opened, notice="")(session)
            return update | show_start(start, session)

        everywhere = [
            session_state,
            *(item for part in (start, scene, demonstration, instruction) for item in fields(part)),
        ]
        everywhere += [*earlier, *latest]

        def on(triggers: list[Any], handler: Callable[..., Any], *inputs: Any, **options: Any) -> None:
            options = {"outputs": everywhere, **_ONE_AT_A_TIME, **options}
            gr.on(triggers, handler, inputs=[session_state, *inputs], **options)

        hidden = {"concurrency_id": None, "concurrency_limit": None, "show_progress": "hidden"}
        on([start.timer.tick, page.load], poll, **hidden)
        chosen_scene = (scene.task, scene.seed)
        on(
            [scene.task.input, scene.seed.submit, scene.seed.blur],
            changes(actions.choose_scene),
            *chosen_scene,
        )
        on([scene.random.click], changes(actions.random_scene))
        on(
            [demonstration.task.input, demonstration.number.submit],
            changes(actions.choose_demonstration),
            demonstration.task,
            demonstration.number,
        )
        on([demonstration.use_recorded.click], changes(actions.use_recorded))
        on(
            [demonstration.load.click, demonstration.source.submit],
            changes(actions.open_dataset),
            demonstration.source,
        )
        on([instruction.use.input], changes(actions.choose_use), instruction.use)
        on(
            [instruction.load.click, instruction.source.submit],
            changes(actions.open_checkpoint),
            instruction.source,
        )
        quiet = {"show_progress": "hidden"}
        on(
            [instruction.run.click, instruction.sentence.submit],
            runs(actions.run),
            instruction.sentence,
            **quiet,
        )
        on(
            [instruction.swap_demonstration.click],
            runs(actions.run_with_other_demonstration),
            instruction.sentence,
            **quiet,
        )
        on([instruction.swap_sentence.click], runs(actions.run_with_other_sentence), **quiet)
        on([demonstration.expert.click], runs(actions.run_expert), **quiet)
    return page.queue(max_size=MAX_WAITING)


def _explained(error: Exception) -> str:
    """Message for the user about an error."""
    if isinstance(error, PlayError):
        return str(error)
    logger.error("An action of the page failed.", exc_info=error)
    return "Something went wrong that is not your fault. The terminal of the page has the details."
