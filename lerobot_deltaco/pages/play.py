"""`deltaco play`: a page on which a policy acts on demonstrations and sentences that you choose."""

from __future__ import annotations

import itertools
import os
import random
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlencode

import numpy as np
from PIL import Image

from gym_deltaco.layout import Layout
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import N_ROWS, TASKS, ContainerWord, get_task, select_tasks
from lerobot_deltaco.data.demonstrations import Demonstration
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.video import (
    benchmark_env,
    find_demonstration,
    load_conditioned,
    record_episode,
)
from lerobot_deltaco.pages.arguments import PlayArguments
from lerobot_deltaco.pages.html import data_uri, picture_uri, render
from lerobot_deltaco.pages.pictures import demonstration_ends, draw_found, encode_video
from lerobot_deltaco.pages.verdict import Verdict, judge, object_name, parse_instruction

# Before Gradio is imported: the page loads nothing from other servers and reports to none.
os.environ.setdefault("GRADIO_ANALYTICS_ENABLED", "False")
try:
    import gradio as gr
except ModuleNotFoundError as error:
    raise UserError(
        "The page needs Gradio. Install the extra `play`: pip install 'lerobot_policy_deltaco[play]'"
    ) from error

TITLE = "DeL-TaCo: show it and say it"
BOTH, DEMONSTRATION, INSTRUCTION = "Both", "Demonstration only", "Instruction only"
_RENDER_SIZE, _DEMONSTRATION_SIZE = 384, 192  # px
_MAX_SEED = 9999


def shipped_checkpoint() -> Path:
    """Returns the folder of the checkpoint that comes with the project."""
    package = Path(__file__).parents[1]
    # In the package in an installed wheel, beside it in a clone.
    folders = [parent / "checkpoints" / "pick_place" for parent in (package, package.parent)]
    return next((folder for folder in folders if folder.is_dir()), folders[-1])


class Choice(NamedTuple):
    """The user's choices, as stored in the page's address.

    Attributes:
        task_id: Task that the scene is drawn for.
        seed: Seed of the scene: that of `lerobot-eval`, and 1000 plus the trial of `deltaco evaluate`.
        demonstrated: Task of the demonstration.
        recorded: Number of a demonstration that the expert records; 0 for the checkpoint's.
        sentence: Instruction.
        use: What the policy receives: `BOTH`, `DEMONSTRATION` or `INSTRUCTION`.
    """

    task_id: int
    seed: int
    demonstrated: int
    recorded: int
    sentence: str
    use: str

    @property
    def query(self) -> str:
        """The choice as the query of the page's address."""
        return f"?{urlencode(self._asdict())}"


class Run(NamedTuple):
    """An episode that was run.

    Attributes:
        choice: What it was run with.
        shown: The object of the demonstration, in words.
        ends: First and last image of the demonstration, as a data URI.
        video: Video, as a data URI.
        picture: Where the policy looked, as a data URI; None for policies that find no locations.
        verdict: Whether it did what was asked.
        confidence: How sure the policy was of the object, and how it understood words; empty if it does not
            say.
        footnote: Success by the benchmark's own criterion, for the scene's task.
    """

    choice: Choice
    shown: str
    ends: str
    video: str
    picture: str | None
    verdict: Verdict
    confidence: str
    footnote: str


class Player:
    """A policy, its demonstrations, and a simulator.

    Args:
        checkpoint: Checkpoint, as `load_conditioned` takes it.

    Attributes:
        uses: What the policy may receive, of `BOTH`, `DEMONSTRATION` and `INSTRUCTION`.

    Raises:
        UserError: There is no checkpoint, or its policy is not one for the benchmark.
    """

    def __init__(self, checkpoint: str | Path) -> None:
        self._loaded = load_conditioned(checkpoint)
        self._env = benchmark_env(self._loaded.policy.config, _RENDER_SIZE)
        self._demonstrations: dict[tuple[int, int], Demonstration] = {}
        self.uses = _possible_uses(self._loaded.policy.config)

    def default_choice(self, task_id: int, seed: int) -> Choice:
        """Returns a scene with a demonstration and an instruction that fit it."""
        return Choice(task_id, seed, task_id, 0, get_task(task_id).instruction, self.uses[0])

    def parse_choice(self, query: Mapping[str, str]) -> Choice:
        """Returns the choice in the page's address; missing or invalid parts are filled in to fit."""

        def number(name: str, end: int, default: int) -> int:
            text = query.get(name, "")
            return int(text) if text.isdecimal() and int(text) < end else default

        task_id = number("task_id", len(TASKS), random.choice(select_tasks("scenario_a_test")))
        choice = self.default_choice(task_id, number("seed", _MAX_SEED + 1, 1000))
        use = query.get("use", "")
        return choice._replace(
            demonstrated=number("demonstrated", len(TASKS), task_id),
            recorded=number("recorded", _MAX_SEED + 1, 0),
            sentence=query.get("sentence", choice.sentence),
            use=use if use in self.uses else choice.use,
        )

    def show_scene(self, choice: Choice) -> tuple[np.ndarray, Layout]:
        """Returns an image of a scene, and its objects and containers."""
        self._env.reset(seed=_scene_seed(choice), options={"task_id": choice.task_id})
        image = self._env.render()
        assert image is not None
        return image, self._env.scene.layout

    def demonstration(self, choice: Choice) -> Demonstration:
        """Returns the demonstration of a choice; one that the checkpoint lacks is recorded by the expert."""
        key = choice.demonstrated, choice.recorded
        if key not in self._demonstrations:
            task = get_task(choice.demonstrated)
            self._demonstrations[key] = find_demonstration(
                self._loaded.policy, task, self._env.scene_config, choice.recorded
            )
        return self._demonstrations[key]

    def run(self, choice: Choice) -> Run:
        """Runs an episode.

        Raises:
            UserError: The instruction is needed and empty.
        """
        sentence = "" if choice.use == DEMONSTRATION else " ".join(choice.sentence.split())
        if not sentence and choice.use != DEMONSTRATION:
            raise UserError("Type an instruction first, or use the demonstration only.")
        demonstration = self.demonstration(choice)
        shown = [] if choice.use == INSTRUCTION else [demonstration]
        recording = record_episode(
            self._loaded, self._env, choice.task_id, _scene_seed(choice), sentence, shown
        )
        picture, confidence = None, ""
        if recording.found is not None:
            ends = demonstration_ends(demonstration) if shown else None
            picture = picture_uri(draw_found(recording.frames[0], ends, recording.found))
            words = dict(self._loaded.policy.feature_matching.understood(sentence))
            read = ", ".join(f"“{typed}” as “{word}”" for typed, word in words.items() if typed != word)
            confidence = f"The policy was {recording.found.p_pick.item():.0%} sure of the object"
            confidence += f", and understood {read}." if read else "."
        demonstrated = demonstration.task if shown else ""
        grasped = recording.info["grasped_object"]
        task, is_done = get_task(choice.task_id), recording.info["is_success"]
        return Run(
            choice,
            parse_instruction(demonstration.task).object_phrase,
            picture_uri(ends_image(demonstration)),
            data_uri("video/mp4", encode_video(recording.frames)),
            picture,
            judge(recording.layout, recording.placed, grasped, sentence, demonstrated),
            confidence,
            f"The scene's task {task.index}, “{task.instruction}”: {'done' if is_done else 'not done'}.",
        )

    def comparison(self, choice: Choice) -> list[Choice]:
        """Returns two demonstrations times two sentences in one scene, for `run`.

        The demonstrations show two of the scene's objects, and the sentences name only the bin.

        Raises:
            UserError: The policy does not take both inputs.
        """
        if BOTH not in self.uses:
            raise UserError("The comparison needs a policy that takes a demonstration and an instruction.")
        _, layout = self.show_scene(choice)
        labels = [item.label for item in layout.objects]
        fitting = [label for label in labels if get_task(choice.demonstrated).describes(label)]
        first = choice
        if len(fitting) != 1:  # the chosen demonstration does not single out an object here
            fitting = [labels[layout.target_object]]
            first = choice._replace(demonstrated=choice.task_id, recorded=0)
        other = next(label.index for label in labels if label not in fitting)
        column = get_task(first.demonstrated).column
        second = choice._replace(demonstrated=N_ROWS * column + other, recorded=0)
        return [
            each._replace(sentence=f"Put it in the {color} bin.", use=BOTH)
            for each, color in itertools.product((first, second), ("green", "red"))
        ]


def _possible_uses(config: Any) -> tuple[str, ...]:
    """Returns what a policy can receive."""
    takes_sentence = can_drop = True
    if config.type == "deltaco":
        sources = config.conditioning[:2]
        takes_sentence = any("language" in source or source == "one_hot" for source in sources)
        can_drop = config.method == "mcil"
    if not (takes_sentence and config.uses_demonstrations):
        return (INSTRUCTION,) if takes_sentence else (DEMONSTRATION,)
    return (BOTH, DEMONSTRATION, INSTRUCTION) if can_drop else (BOTH,)


def _scene_seed(choice: Choice) -> int:
    return episode_seed(0, "evaluation", choice.task_id, 0, choice.seed)


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


def ends_image(demonstration: Demonstration) -> Image.Image:
    """Returns the first and the last image of a demonstration, side by side."""
    size, gap = _DEMONSTRATION_SIZE, 8
    image = Image.new("RGB", (2 * size + gap, size), "white")
    for n, end in enumerate(demonstration_ends(demonstration)):
        panel = Image.fromarray(end).resize((size, size), Image.Resampling.BICUBIC)
        image.paste(panel, (n * (size + gap), 0))
    return image


# The page

_REPLACE_ADDRESS = "(query) => { if (query) history.replaceState(null, '', query); }"
# On a phone, the result is below the button.
_SHOW_RESULT = "() => { if (innerWidth < 700) document.querySelector('#run').scrollIntoView(); }"


def build_page(player: Player, name: str) -> gr.Blocks:
    """Makes the page.

    Args:
        player: The policy and its simulator.
        name: Name of the checkpoint.
    """
    names = [(f"{task.index}: {task.instruction}", task.index) for task in TASKS]
    with gr.Blocks(title=TITLE, analytics_enabled=False) as page:
        gr.Markdown(
            f"# {TITLE}\nThe robot puts one of three objects into one of two bins: which object, the "
            f"demonstration shows; which bin, the sentence says. Policy: `{name}`",
            elem_id="title",
        )
        recorded = gr.State(0)
        seen = gr.State((-1, -1, []))  # task and seed of the scene, and the sentences suggested in it
        address = gr.Textbox(visible="hidden")
        with gr.Row(equal_height=False):
            with gr.Column(scale=4, min_width=340):
                with gr.Row():
                    task = gr.Dropdown(names, label="Scene of task", scale=5, min_width=150, elem_id="task")
                    seed = gr.Number(
                        label="Seed",
                        precision=0,
                        minimum=0,
                        maximum=_MAX_SEED,
                        scale=2,
                        min_width=70,
                        elem_id="seed",
                    )
                    new_scene = gr.Button("New scene", scale=2, min_width=100, elem_id="new_scene")
                with gr.Row():
                    demonstrated = gr.Dropdown(
                        names, label="Demonstration of task", scale=7, min_width=150, elem_id="demonstrated"
                    )
                    record = gr.Button("Record one", scale=2, min_width=100, elem_id="record")
                with gr.Row():
                    scene, ends = (
                        gr.Image(
                            label=label, scale=scale, min_width=100, height=160, interactive=False, buttons=[]
                        )
                        for label, scale in (("Scene", 1), ("Demonstration", 2))
                    )
                objects = gr.Markdown(elem_id="objects")
                use = gr.Radio(
                    player.uses, label="The policy receives", interactive=len(player.uses) > 1, elem_id="use"
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

        inputs = [task, seed, demonstrated, recorded, sentence, use]
        outputs = [*inputs, scene, objects, ends, chips, seen, address]

        def show(choice: Choice) -> dict[Any, Any]:
            """Shows a choice on all components that hold it."""
            image, layout = player.show_scene(choice)
            sentences = suggest_sentences(choice, layout)
            return {
                **dict(zip(inputs, choice, strict=True)),
                scene: image,
                objects: f"In the scene: {', '.join(object_name(item.label) for item in layout.objects)}.",
                ends: ends_image(player.demonstration(choice)),
                chips: gr.Dataset(samples=[[text] for text in sentences]),
                seen: (choice.task_id, choice.seed, sentences),
                address: choice.query,
            }

        def begin(request: gr.Request) -> dict[Any, Any]:
            choice = player.parse_choice(dict(request.query_params))
            ready = {button: gr.Button(interactive=True) for button in (run, compare)}
            return show(choice) | ready | {sentence: gr.Textbox(choice.sentence, interactive=True)}

        def change_scene(before: tuple[int, int, list[str]], *values: Any) -> dict[Any, Any]:
            """Shows another scene, and replaces what the user did not make with what fits the scene."""
            choice = Choice(*values)
            if (choice.task_id, choice.seed) == before[:2]:
                return gr.skip()
            fitting = player.default_choice(choice.task_id, choice.seed or 0)
            if choice.recorded:
                fitting = fitting._replace(demonstrated=choice.demonstrated, recorded=choice.recorded)
            if choice.sentence.strip() and choice.sentence not in before[2]:
                fitting = fitting._replace(sentence=choice.sentence)
            return show(fitting._replace(use=choice.use))

        def draw_scene(before: tuple[int, int, list[str]], *values: Any) -> dict[Any, Any]:
            return change_scene(
                before, random.randrange(len(TASKS)), random.randint(0, _MAX_SEED), *values[2:]
            )

        def change_demonstration(*values: Any) -> dict[Any, Any]:
            return show(Choice(*values)._replace(recorded=0))

        def record_another(*values: Any) -> dict[Any, Any]:
            return show(Choice(*values)._replace(recorded=random.randint(1, _MAX_SEED)))

        def run_episodes(choose: Callable[[Choice], list[Choice]]) -> Callable[..., dict[Any, Any]]:
            """Returns the handler that runs what `choose` makes of the user's choice."""

            def handle(*values: Any, progress: gr.Progress = gr.Progress()) -> dict[Any, Any]:  # noqa: B008
                choice = Choice(*values)
                try:
                    choices = progress.tqdm(choose(choice), desc="Running", unit="episodes")
                    runs = [player.run(each) for each in choices]
                except (ValueError, RuntimeError) as error:
                    gr.Warning(str(error))
                    return gr.skip()
                return {result: render("play.html", runs=runs), address: choice.query}

            return handle

        def on(triggers: list[Any], function: Any, taken: Any, changed: Any, **options: Any) -> None:
            gr.on(triggers, function, taken, changed, concurrency_id="policy", concurrency_limit=1, **options)

        quiet: dict[str, Any] = {"show_progress": "hidden"}
        on([page.load], begin, None, [*outputs, run, compare], **quiet)
        on([task.input, seed.submit, seed.blur], change_scene, [seen, *inputs], outputs, **quiet)
        on([new_scene.click], draw_scene, [seen, *inputs], outputs, **quiet)
        on([demonstrated.input], change_demonstration, inputs, outputs, **quiet)
        on([record.click], record_another, inputs, outputs, show_progress_on=[ends])
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
        UserError: There is no checkpoint, its policy is not one for the benchmark, or the port is taken.
    """
    chosen = Path(arguments.checkpoint) if arguments.checkpoint else shipped_checkpoint()
    page = build_page(Player(chosen), arguments.checkpoint or chosen.name)
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
            css_paths=Path(__file__).with_name("templates") / "play.css",
            footer_links=[],
        )
    except OSError as error:
        raise UserError(f"Port {arguments.port} is taken. Choose another one with --port.") from error
