"""`deltaco play`: a page on which a policy acts on demonstrations and sentences that you choose."""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gym_deltaco.containers import ContainerWord
from gym_deltaco.layout import Layout
from gym_deltaco.tasks import TASKS, get_task
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.video import load_conditioned
from lerobot_deltaco.pages.arguments import PlayArguments
from lerobot_deltaco.pages.html import TEMPLATES, picture_uri, render
from lerobot_deltaco.pages.player import MAX_SEED, POINT, Choice, Player
from lerobot_deltaco.pages.verdict import object_name
from lerobot_deltaco.policies.deltaco_match.findings import demonstration_ends

# Before Gradio is imported: the page loads nothing from other servers and reports to none.
os.environ.setdefault("GRADIO_ANALYTICS_ENABLED", "False")
try:
    import gradio as gr
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "The page needs Gradio. Install the extra `play`: pip install 'lerobot_policy_deltaco[play]'"
    ) from error

TITLE = "DeL-TaCo: show it and say it"
_REPLACE_ADDRESS = "(query) => { if (query) history.replaceState(null, '', query); }"
# A click on the scene tells its place in thousandths of the image's sides.
_POINT_AT = """element.addEventListener('click', (event) => {
    if (event.target.id !== 'scene_image') return;
    const box = event.target.getBoundingClientRect();
    const at = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    const point = at.map((each) => Math.round(1000 * Math.min(Math.max(each, 0), 1))).join(',');
    trigger('click', { point });
})"""
# On a phone, the result is below the button.
_SHOW_RESULT = "() => { if (innerWidth < 700) document.querySelector('#run').scrollIntoView(); }"


def shipped_checkpoint() -> Path:
    """Returns the folder of the checkpoint that comes with the project."""
    package = Path(__file__).parents[1]
    # In the package in an installed wheel, beside it in a clone.
    folders = [parent / "checkpoints" / "pick_place" for parent in (package, package.parent)]
    return next((folder for folder in folders if folder.is_dir()), folders[-1])


def suggest_sentences(choice: Choice, layout: Layout) -> list[str]:
    """Returns sentences to try in a scene."""
    target = layout.objects[layout.target_object].label
    others = [item.label for item in layout.objects if item.label != target]
    bins = layout.containers[layout.target_container], layout.containers[1 - layout.target_container]
    words: tuple[ContainerWord, ...] = ("left", "right", "front", "back")
    side = next(word for word in words if bins[1].satisfies(word) and not bins[0].satisfies(word))
    return [
        get_task(choice.task_id).instruction,
        f"Put it in the {bins[1].color} bin.",
        f"Move the {others[0].color} {others[0].shape} shaped object to the {side} bin.",
        f"Place the {others[1].name} into the {bins[0].color} box.",
        f"{target.name} to the {side}",
    ]


def build_page(player: Player, name: str) -> gr.Blocks:
    """Makes the page.

    Args:
        player: The policy and its simulator.
        name: Name of the checkpoint.
    """
    names = [(f"{task.index}: {task.instruction}", task.index) for task in TASKS]
    with gr.Blocks(title=TITLE, analytics_enabled=False) as page:
        gr.Markdown(
            f"# {TITLE}\nThe robot puts one of three objects into one of two bins. The demonstration shows "
            f"which object, the sentence says which bin. Policy: `{name}`",
            elem_id="title",
        )
        demo_number = gr.State(0)
        seen = gr.State((-1, -1, []))  # task and seed of the scene, and the sentences suggested in it
        address = gr.Textbox(visible="hidden")
        point = gr.State("")
        with gr.Row(equal_height=False):
            with gr.Column(scale=4, min_width=340):
                with gr.Row():
                    task = gr.Dropdown(names, label="Scene of task", scale=5, min_width=150, elem_id="task")
                    seed = gr.Number(
                        label="Seed",
                        precision=0,
                        minimum=0,
                        maximum=MAX_SEED,
                        scale=2,
                        min_width=70,
                        elem_id="seed",
                    )
                    new_scene = gr.Button("New scene", scale=2, min_width=100, elem_id="new_scene")
                with gr.Row():
                    demo_task = gr.Dropdown(
                        names, label="Demonstration of task", scale=7, min_width=150, elem_id="demo_task"
                    )
                    record = gr.Button("Record one", scale=2, min_width=100, elem_id="record")
                scene = gr.HTML(elem_id="scene", js_on_load=_POINT_AT)
                received = gr.Radio(
                    player.inputs,
                    label="The policy receives",
                    interactive=len(player.inputs) > 1,
                    elem_id="inputs",
                )
            with gr.Column(scale=6, min_width=340):
                # Nothing runs before the scene of the address is there.
                sentence = gr.Textbox(
                    label="Instruction, in your own words", max_lines=3, interactive=False, elem_id="sentence"
                )
                chips = gr.Dataset(
                    components=[gr.Textbox(visible=False)], samples=[], show_label=False, elem_id="chips"
                )
                with gr.Row():
                    run = gr.Button("Run", variant="primary", min_width=100, interactive=False, elem_id="run")
                    compare = gr.Button("Compare 2 × 2", min_width=100, interactive=False, elem_id="compare")
                result = gr.HTML("Press Run, or Enter in the instruction.", elem_id="result")

        inputs = [task, seed, demo_task, demo_number, sentence, received, point]
        outputs = [*inputs, scene, chips, seen, address]

        def show(choice: Choice) -> dict[Any, Any]:
            """Shows a choice on all components that hold it."""
            image, layout = player.show_scene(choice)
            sentences = suggest_sentences(choice, layout)
            shown = render(
                "scene.html",
                scene=picture_uri(image),
                point=choice.prompt.box[:2] if choice.inputs == POINT and choice.prompt else None,
                can_point=POINT in player.inputs,
                objects=[object_name(item.label) for item in layout.objects],
                ends=[picture_uri(end) for end in demonstration_ends(player.demonstration(choice))],
            )
            return {
                **dict(zip(inputs, choice, strict=True)),
                scene: shown,
                chips: gr.Dataset(samples=[[text] for text in sentences]),
                seen: (choice.task_id, choice.seed, sentences),
                address: choice.query,
            }

        def begin(request: gr.Request) -> dict[Any, Any]:
            choice = player.parse_choice(dict(request.query_params))
            ready = {button: gr.Button(interactive=True) for button in (run, compare)}
            return show(choice) | ready | {sentence: gr.Textbox(choice.instruction, interactive=True)}

        def change_scene(before: tuple[int, int, list[str]], *values: Any) -> dict[Any, Any]:
            """Shows another scene, and replaces what the user did not make with what fits the scene."""
            choice = Choice(*values)
            if (choice.task_id, choice.seed) == before[:2]:
                return gr.skip()
            fitting = player.default_choice(choice.task_id, choice.seed or 0)
            if choice.demo_number:
                fitting = fitting._replace(demo_task=choice.demo_task, demo_number=choice.demo_number)
            if choice.instruction.strip() and choice.instruction not in before[2]:
                fitting = fitting._replace(instruction=choice.instruction)
            return show(fitting._replace(inputs=choice.inputs))

        def draw_scene(before: tuple[int, int, list[str]], *values: Any) -> dict[Any, Any]:
            return change_scene(
                before, random.randrange(len(TASKS)), random.randint(0, MAX_SEED), *values[2:]
            )

        def change_demonstration(*values: Any) -> dict[Any, Any]:
            return show(Choice(*values)._replace(demo_number=0))

        def record_another(*values: Any) -> dict[Any, Any]:
            return show(Choice(*values)._replace(demo_number=random.randint(1, MAX_SEED)))

        def point_at(event: gr.EventData, *values: Any) -> dict[Any, Any]:
            if POINT not in player.inputs:
                return gr.skip()
            return show(Choice(*values)._replace(inputs=POINT, point=event.point))

        def run_episodes(choose: Callable[[Choice], list[Choice]]) -> Callable[..., dict[Any, Any]]:
            """Returns the handler that runs what `choose` makes of the user's choice."""

            def handle(*values: Any, progress: gr.Progress = gr.Progress()) -> dict[Any, Any]:  # noqa: B008
                choice = Choice(*values)
                try:
                    choices = progress.tqdm(choose(choice), desc="Running", unit="episodes")
                    views = [player.run(each) for each in choices]
                except (ValueError, RuntimeError) as error:
                    gr.Warning(str(error))
                    return gr.skip()
                return {result: render("play.html", views=views), address: choice.query}

            return handle

        def on(triggers: list[Any], function: Any, taken: Any, changed: Any, **options: Any) -> None:
            gr.on(triggers, function, taken, changed, concurrency_id="policy", concurrency_limit=1, **options)

        quiet: dict[str, Any] = {"show_progress": "hidden"}
        on([page.load], begin, None, [*outputs, run, compare], **quiet)
        on([task.input, seed.submit, seed.blur], change_scene, [seen, *inputs], outputs, **quiet)
        on([new_scene.click], draw_scene, [seen, *inputs], outputs, **quiet)
        on([demo_task.input], change_demonstration, inputs, outputs, **quiet)
        on([scene.click], point_at, inputs, outputs, **quiet)
        on([record.click], record_another, inputs, outputs, show_progress_on=[scene])
        run_one, run_four = run_episodes(lambda choice: [choice]), run_episodes(player.comparison)
        for triggers, handler in (([run.click, sentence.submit], run_one), ([compare.click], run_four)):
            on(triggers, handler, inputs, [result, address], show_progress_on=[result])
        result.change(None, js=_SHOW_RESULT)
        chips.click(lambda sample: sample[0], chips, sentence, **quiet)
        address.change(None, address, js=_REPLACE_ADDRESS)
    return page


def play(arguments: PlayArguments) -> None:
    """Serves the page on this machine until it is interrupted.

    Raises:
        ValueError: There is no checkpoint, its policy is not one for the benchmark, or the port is taken.
    """
    chosen = Path(arguments.checkpoint) if arguments.checkpoint else shipped_checkpoint()
    page = build_page(Player(load_conditioned(chosen)), arguments.checkpoint or chosen.name)
    # Fonts of the system, so that the page needs no other server.
    theme = gr.themes.Default(
        font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"], primary_hue="orange"
    )
    try:
        page.launch(
            server_name="127.0.0.1",
            server_port=arguments.port,
            share=False,
            theme=theme,
            css_paths=[TEMPLATES / "page.css", TEMPLATES / "play.css"],
            footer_links=[],
        )
    except OSError as error:
        raise UserError(f"Port {arguments.port} is taken. Choose another one with --port.") from error
