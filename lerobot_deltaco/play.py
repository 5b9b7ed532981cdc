"""`deltaco play`: a page on which a policy acts on demonstrations and sentences that you choose."""

from __future__ import annotations

import html
import itertools
import os
import random
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlencode

import numpy as np
from PIL import Image

from gym_deltaco.layout import Layout
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import N_ROWS, TASKS, get_task
from lerobot_deltaco.arguments import PlayArguments
from lerobot_deltaco.deltaco_match.modeling_deltaco_match import Found
from lerobot_deltaco.demonstrations import Demonstration
from lerobot_deltaco.evaluate import Simulators
from lerobot_deltaco.pictures import demonstration_ends, draw_found, write_video
from lerobot_deltaco.recording import benchmark_scene, load_conditioned, record_demonstration, record_episode
from lerobot_deltaco.verdict import Verdict, judge, object_name, parse_instruction

# Before Gradio is imported: the page loads nothing from other servers and reports to none.
os.environ.setdefault("GRADIO_ANALYTICS_ENABLED", "False")
try:
    import gradio as gr
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "The page needs Gradio. Install the extra `play`: pip install 'lerobot_policy_deltaco[play]'"
    ) from error

TITLE = "DeL-TaCo: show it and say it"
BOTH, DEMONSTRATION, INSTRUCTION = "Both", "Demonstration only", "Instruction only"
RENDER_SIZE = 384  # px
_FROM_CHECKPOINT = -1  # instead of the number of a recorded demonstration
_MAX_SEED = 9999
_HOUR = 3600  # s
_DEMONSTRATION_SIZE = 192  # px


def shipped_checkpoint() -> Path:
    """Returns the folder of the checkpoint that comes with the project."""
    package = Path(__file__).parent
    # In the package in an installed wheel, beside it in a clone.
    folders = [parent / "checkpoints" / "pick_place" for parent in (package, package.parent)]
    return next((folder for folder in folders if folder.is_dir()), folders[-1])


class Choice(NamedTuple):
    """The user's choices, as stored in the page's address.

    Attributes:
        task_id: Task that the scene is drawn for.
        seed: Seed of the scene: that of `lerobot-eval`, and 1000 plus the trial of `deltaco evaluate`.
        demonstrated: Task of the demonstration.
        recorded: Number of the expert's demonstration; -1 for the checkpoint's.
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
        return "?" + urlencode(self._asdict())


class Run(NamedTuple):
    """An episode that was run.

    Attributes:
        video: MP4 file.
        picture: Where the policy looked; None for policies that find no locations.
        verdict: Whether it did what was asked.
        confidence: How sure the policy was of the object, and how it understood words; empty if it does not
            say.
        footnote: Success by the benchmark's own criterion, for the scene's task.
    """

    video: Path
    picture: Image.Image | None
    verdict: Verdict
    confidence: str
    footnote: str


class Player:
    """A policy, its demonstrations, and a simulator.

    Args:
        checkpoint: Checkpoint, as `load_conditioned` takes it.
        folder: Folder for videos.

    Attributes:
        uses: What the policy may receive, of `BOTH`, `DEMONSTRATION` and `INSTRUCTION`.

    Raises:
        ValueError: There is no checkpoint, or its policy is not one for the benchmark.
    """

    def __init__(self, checkpoint: str | Path, folder: Path) -> None:
        self._loaded = load_conditioned(checkpoint)
        self._config = self._loaded.policy.config
        self._scene = benchmark_scene(self._config)
        self._simulators = Simulators(self._scene, RENDER_SIZE)
        self._folder, self._numbers = folder, itertools.count()
        self._recorded: dict[tuple[int, int], Demonstration] = {}
        self.uses = _possible_uses(self._config)
        self.n_steps = self._scene.n_steps

    def default_choice(self, task_id: int, seed: int) -> Choice:
        """Returns a scene with a demonstration and an instruction that fit it."""
        source = self.default_source(task_id)
        return Choice(task_id, seed, task_id, source, get_task(task_id).instruction, self.uses[0])

    def default_source(self, task_id: int) -> int:
        """Returns -1 for a task of which the checkpoint has a demonstration; else 0, the expert's first."""
        bank = self._loaded.policy.demonstrations
        is_known = bank is not None and get_task(task_id).instruction in bank.rows
        return _FROM_CHECKPOINT if is_known else 0

    def parse_choice(self, query: Mapping[str, str]) -> Choice:
        """Returns the choice in the page's address; missing or invalid parts are filled in to fit."""

        def number(name: str, end: int, default: int) -> int:
            text = query.get(name, "")
            return int(text) if text.isdecimal() and int(text) < end else default

        start = random.choice([*(task.index for task in TASKS if self.default_source(task.index) < 0), 4])
        task_id = number("task_id", len(TASKS), start)
        choice = self.default_choice(task_id, number("seed", _MAX_SEED + 1, 1000))
        demonstrated = number("demonstrated", len(TASKS), task_id)
        recorded = number("recorded", _MAX_SEED + 1, self.default_source(demonstrated))
        use = query.get("use", "")
        return choice._replace(
            demonstrated=demonstrated,
            recorded=recorded,
            sentence=query.get("sentence", choice.sentence),
            use=use if use in self.uses else choice.use,
        )

    def show_scene(self, choice: Choice) -> tuple[np.ndarray, Layout]:
        """Returns an image of a scene, and its objects and containers."""
        (env,) = self._simulators.take(1, choice.task_id)
        env.reset(seed=_scene_seed(choice), options={"task_id": choice.task_id})
        image = env.render()
        assert image is not None
        return image, env.scene.layout

    def demonstration(self, task_id: int, recorded: int) -> Demonstration:
        """Returns a demonstration; one that the checkpoint lacks is recorded by the expert.

        Args:
            task_id: Index of its task.
            recorded: Number of the expert's demonstration; -1 for the checkpoint's.
        """
        if recorded < 0 and self.default_source(task_id) < 0:
            return self._loaded.policy.demonstrations.of_task(get_task(task_id).instruction)[0]
        key = (task_id, max(recorded, 0))
        if key not in self._recorded:
            self._recorded[key] = record_demonstration(
                self._config, get_task(task_id), key[1], scene=self._scene
            )
        return self._recorded[key]

    def run(self, choice: Choice, on_step: Callable[[int], None] | None = None) -> Run:
        """Runs an episode.

        Args:
            choice: Scene, demonstration and instruction.
            on_step: Called with the number of steps that have been run.

        Raises:
            ValueError: The instruction is needed and empty.
        """
        sentence = "" if choice.use == DEMONSTRATION else " ".join(choice.sentence.split())
        if not sentence and choice.use != DEMONSTRATION:
            raise ValueError("Type an instruction first, or use the demonstration only.")
        shown = []
        if choice.use != INSTRUCTION:
            shown = [self.demonstration(choice.demonstrated, choice.recorded)]
        recording = record_episode(
            self._loaded,
            choice.task_id,
            _scene_seed(choice),
            sentence,
            shown,
            self._scene,
            RENDER_SIZE,
            on_step,
            self._simulators,
        )
        video = self._folder / f"episode_{next(self._numbers)}.mp4"
        write_video(recording.frames, video)
        picture = None
        if recording.found is not None:
            ends = demonstration_ends(shown[0]) if shown else None
            picture = draw_found(recording.frames[0], ends, recording.found)
        grasped = recording.info["grasped_object"]
        demonstrated = shown[0].task if shown else ""
        verdict = judge(recording.layout, recording.placed, grasped, sentence, demonstrated)
        outcome = "done" if recording.info["is_success"] else "not done"
        task = get_task(choice.task_id)
        footnote = f"The scene's task {task.index}, “{task.instruction}”: {outcome}."
        return Run(video, picture, verdict, self._confidence(recording.found, sentence), footnote)

    def _confidence(self, found: Found | None, sentence: str) -> str:
        if found is None:
            return ""
        mapped = dict(self._loaded.policy.feature_matching.understood(sentence))
        read = ", ".join(f"“{typed}” as “{word}”" for typed, word in mapped.items() if typed != word)
        sure = f"The policy was {found.p_pick.item():.0%} sure of the object"
        return f"{sure}, and understood {read}." if read else f"{sure}."

    def comparison(self, choice: Choice) -> list[Choice]:
        """Returns two demonstrations times two sentences in one scene, for `run`.

        The demonstrations show two of the scene's objects, and the sentences name only the bin.

        Raises:
            ValueError: The policy does not take both inputs.
        """
        if BOTH not in self.uses:
            raise ValueError("The comparison needs a policy that takes a demonstration and an instruction.")
        _, layout = self.show_scene(choice)
        labels = [item.label for item in layout.objects]
        meant = parse_instruction(get_task(choice.demonstrated).instruction).objects or frozenset()
        shown = [n for n, label in enumerate(labels) if label.index in meant]
        demonstrations = [(choice.demonstrated, choice.recorded)]
        if len(shown) != 1:  # the present demonstration does not single out an object here
            shown = [layout.target_object]
            demonstrations = [(choice.task_id, self.default_source(choice.task_id))]
        others = [label for n, label in enumerate(labels) if n not in shown]
        by_name = [task_id for label in others for task_id in range(label.index, len(TASKS), N_ROWS)]
        other = min(by_name, key=self.default_source)  # one of the checkpoint's, if there is one
        demonstrations.append((other, self.default_source(other)))
        return [
            choice._replace(
                demonstrated=task_id, recorded=recorded, sentence=f"Put it in the {color} bin.", use=BOTH
            )
            for color in ("green", "red")
            for task_id, recorded in demonstrations
        ]


def _possible_uses(config: Any) -> tuple[str, ...]:
    """Returns what a policy can receive."""
    if config.type == "deltaco":
        sources = config.conditioning[:2]
        takes_sentence = any("language" in source or source == "one_hot" for source in sources)
        can_drop = (config.method == "mcil", config.method == "mcil")
    else:
        takes_sentence, can_drop = True, (True, True)
    if not (takes_sentence and config.uses_demonstrations):
        return (INSTRUCTION,) if takes_sentence else (DEMONSTRATION,)
    alone = [use for use, can in zip((DEMONSTRATION, INSTRUCTION), can_drop, strict=True) if can]
    return (BOTH, *alone)


def _scene_seed(choice: Choice) -> int:
    return episode_seed(0, "evaluation", choice.task_id, 0, choice.seed)


def suggest_sentences(choice: Choice, layout: Layout) -> list[str]:
    """Returns sentences to try in a scene."""
    target = layout.objects[layout.target_object].label
    others = [item.label for n, item in enumerate(layout.objects) if n != layout.target_object]
    other_bin = layout.containers[1 - layout.target_container]
    side = ("right", "left")[other_bin.quadrant.i]
    if layout.containers[layout.target_container].quadrant.i == other_bin.quadrant.i:
        side = ("back", "front")[other_bin.quadrant.j]
    return [
        get_task(choice.task_id).instruction,
        f"Put it in the {other_bin.color} bin.",
        f"Move the {others[0].color} {others[0].shape} to the {side} bin.",
        f"Place the {others[1].name} into the {layout.containers[layout.target_container].color} box.",
        f"{target.name} {side}",
    ]


# The page

_CSS = """
.gradio-container { max-width: 1280px !important; margin: 0 auto !important; }
#title h1 { font-size: 1.4rem; margin: 0; }
#title p { margin: .2rem 0 0; }
.verdict { border-left: 6px solid #888; padding: .2rem .8rem; }
#verdict .verdict { min-height: 4rem; }
.verdict.yes { border-color: #1a9850; } .verdict.no { border-color: #d95f02; }
.verdict h3 { margin: 0; font-size: 1.15rem; } .verdict p { margin: .1rem 0; }
.verdict small { opacity: .75; }
.beside { align-self: flex-end; max-height: 2.8rem; }
.beside, #run, #compare { white-space: nowrap; padding-inline: .4rem; }
@media (max-width: 640px) { .gradio-container .main.fillable { padding: 1rem .8rem !important; } }
#objects { margin-top: -.6rem; font-size: .9rem; }
.gradio-container input[role="combobox"] { padding-right: 1.75rem !important; text-overflow: ellipsis; }
"""
_REPLACE_ADDRESS = "(query) => { if (query) history.replaceState(null, '', query); }"


def _verdict_html(verdict: Verdict, confidence: str = "", footnote: str = "") -> str:
    kind, sign = {True: ("yes", "✓ "), False: ("no", "✗ "), None: ("", "")}[verdict.is_success]
    texts = (verdict.moved, verdict.asked, confidence, footnote)
    moved, asked, sure, small = map(html.escape, texts)
    if not verdict.headline:
        return f'<div class="verdict {kind}"><p>{sign}{moved}</p></div>'
    return (
        f'<div class="verdict {kind}"><h3>{sign}{verdict.headline}</h3><p>{moved} {sure}</p>'
        f"<p>{asked}</p><p><small>{small}</small></p></div>"
    )


def _message_html(headline: str, text: str) -> str:
    return _verdict_html(Verdict(None, headline, text, ""))


def _ends_image(demonstration: Demonstration) -> Image.Image:
    """Returns the first and the last image of a demonstration, side by side."""
    size = (_DEMONSTRATION_SIZE, _DEMONSTRATION_SIZE)
    image = Image.new("RGB", (2 * size[0] + 8, size[1]), "white")
    for n, end in enumerate(demonstration_ends(demonstration)):
        image.paste(Image.fromarray(end).resize(size, Image.Resampling.BICUBIC), (n * (size[0] + 8), 0))
    return image


def _reporter(progress: gr.Progress, n_before: int, n_steps: int) -> Callable[[int], None]:
    """Returns a function that shows the progress of an episode."""

    def report(step: int) -> None:
        progress((n_before + step, n_steps), desc="Running", unit="steps")

    return report


def _image(name: str, **options: Any) -> gr.Image:
    return gr.Image(interactive=False, elem_id=name, **{"buttons": [], **options})


def _video(name: str, **options: Any) -> gr.Video:
    return gr.Video(interactive=False, buttons=[], autoplay=True, loop=True, elem_id=name, **options)


def _small_button(text: str, name: str) -> gr.Button:
    return gr.Button(text, scale=2, min_width=100, size="md", elem_id=name, elem_classes="beside")


def build_page(player: Player, name: str) -> gr.Blocks:
    """Makes the page.

    Args:
        player: The policy and its simulator.
        name: Name of the checkpoint.
    """
    names = [(f"{task.index}: {task.instruction}", task.index) for task in TASKS]
    with gr.Blocks(title=TITLE, analytics_enabled=False, delete_cache=(_HOUR, _HOUR)) as page:
        gr.Markdown(
            f"# {TITLE}\nThe robot puts one of three objects into one of two bins: which object, the "
            f"demonstration shows; which bin, the sentence says. Policy: `{name}`",
            elem_id="title",
        )
        recorded = gr.State(_FROM_CHECKPOINT)
        shown = gr.State((-1, -1, []))  # task and seed of the scene, and the sentences suggested in it
        address = gr.Textbox(visible="hidden")
        with gr.Row(equal_height=False):
            with gr.Column(scale=4, min_width=340):
                with gr.Row(equal_height=False):
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
                    new_scene = _small_button("New scene", "new_scene")
                with gr.Row(equal_height=True):
                    scene = _image("scene", label="Scene", height=160, min_width=100, scale=1)
                    ends = _image("ends", label="Demonstration", height=160, min_width=200, scale=2)
                objects = gr.Markdown(elem_id="objects")
                with gr.Row(equal_height=False):
                    demonstrated = gr.Dropdown(
                        names, label="Demonstration", scale=5, min_width=150, elem_id="demonstrated"
                    )
                    record = _small_button("Record one", "record")
                sentence = gr.Textbox(label="Instruction, in your own words", max_lines=3, elem_id="sentence")
                chips = gr.Dataset(
                    components=[gr.Textbox(visible=False)], samples=[], show_label=False, elem_id="chips"
                )
                use = gr.Radio(
                    player.uses,
                    value=player.uses[0],
                    label="The policy receives",
                    interactive=len(player.uses) > 1,
                    elem_id="use",
                )
                with gr.Row():
                    run = gr.Button("Run", variant="primary", min_width=100, elem_id="run")
                    compare = gr.Button("Compare 2 × 2", min_width=100, elem_id="compare")
            with gr.Column(scale=6, min_width=340):
                start = _message_html("Ready", "Press Run, or Enter in the instruction.")
                verdict = gr.HTML(start, elem_id="verdict")
                with gr.Row(equal_height=False) as single:
                    video = _video("video", label="Episode")
                    picture = _image("picture", label="Where the policy looked", buttons=["fullscreen"])
                grid: list[Any] = []
                with gr.Column(visible=False) as comparison:
                    with gr.Row(equal_height=False):
                        grid += [_image(f"ends_{n}", height=84, min_width=120) for n in range(2)]
                    for row in range(2):
                        with gr.Row(equal_height=False):
                            for number in (2 * row, 2 * row + 1):
                                with gr.Column(min_width=120):
                                    grid.append(_video(f"video_{number}", height=190))
                                    grid.append(gr.HTML(elem_id=f"verdict_{number}"))

        inputs = [task, seed, demonstrated, recorded, sentence, use]
        outputs = [*inputs, scene, objects, ends, chips, shown, address]

        def show(choice: Choice) -> dict[Any, Any]:
            """Shows a choice on all components that hold it."""
            image, layout = player.show_scene(choice)
            sentences = suggest_sentences(choice, layout)
            names_there = ", ".join(object_name(item.label) for item in layout.objects)
            demonstration = player.demonstration(choice.demonstrated, choice.recorded)
            source = "comes with the checkpoint" if choice.recorded < 0 else "was recorded by the expert"
            return {
                **dict(zip(inputs, choice, strict=True)),
                scene: image,
                objects: f"In the scene: {names_there}. The demonstration {source}.",
                ends: _ends_image(demonstration),
                chips: gr.Dataset(samples=[[text] for text in sentences]),
                shown: (choice.task_id, choice.seed, sentences),
                address: choice.query,
            }

        def begin(request: gr.Request) -> dict[Any, Any]:
            return show(player.parse_choice(dict(request.query_params)))

        def change_scene(known: tuple[int, int, list[str]], *values: Any) -> dict[Any, Any]:
            """Shows another scene, and replaces what the user did not make with what fits the scene."""
            choice = Choice(*values)
            if (choice.task_id, choice.seed) == known[:2]:
                return {}
            fitting = player.default_choice(choice.task_id, choice.seed or 0)
            if choice.recorded > 0:
                fitting = fitting._replace(demonstrated=choice.demonstrated, recorded=choice.recorded)
            if choice.sentence.strip() and choice.sentence not in known[2]:
                fitting = fitting._replace(sentence=choice.sentence)
            return show(fitting._replace(use=choice.use))

        def draw_scene(known: tuple[int, int, list[str]], *values: Any) -> dict[Any, Any]:
            task_id, seed = random.randrange(len(TASKS)), random.randint(0, _MAX_SEED)
            return change_scene(known, task_id, seed, *values[2:])

        def change_demonstration(*values: Any) -> dict[Any, Any]:
            choice = Choice(*values)
            return show(choice._replace(recorded=player.default_source(choice.demonstrated)))

        def record_another(*values: Any) -> dict[Any, Any]:
            return show(Choice(*values)._replace(recorded=random.randint(1, _MAX_SEED)))

        def run_one(*values: Any, progress: gr.Progress = gr.Progress()) -> dict[Any, Any]:  # noqa: B008
            choice = Choice(*values)
            try:
                done = player.run(choice, _reporter(progress, 0, player.n_steps))
            except (ValueError, RuntimeError) as error:
                return {verdict: _message_html("This cannot be run", str(error))}
            return {
                verdict: _verdict_html(done.verdict, done.confidence, done.footnote),
                single: gr.Row(visible=True),
                comparison: gr.Column(visible=False),
                video: str(done.video),
                picture: gr.Image(done.picture, visible=done.picture is not None),
                address: choice.query,
            }

        def run_four(*values: Any, progress: gr.Progress = gr.Progress()) -> dict[Any, Any]:  # noqa: B008
            choice, n_steps = Choice(*values), player.n_steps
            cells: list[Any] = []
            n_right = 0
            try:
                four = player.comparison(choice)
                for each in four[:2]:
                    demonstration = player.demonstration(each.demonstrated, each.recorded)
                    meant = parse_instruction(demonstration.task).phrase
                    cells.append(gr.Image(_ends_image(demonstration), label=f"Shows {meant}"))
                for n, each in enumerate(four):
                    done = player.run(each, _reporter(progress, n * n_steps, 4 * n_steps))
                    n_right += bool(done.verdict.is_success)
                    cells += [
                        gr.Video(str(done.video), label=f"“{each.sentence}”"),
                        _verdict_html(done.verdict._replace(headline="", asked="")),
                    ]
            except (ValueError, RuntimeError) as error:
                return {verdict: _message_html("This cannot be compared", str(error))}
            text = "One scene; the columns differ in the demonstration, the rows in the sentence."
            return {
                verdict: _message_html(f"{n_right} of 4 as asked", text),
                single: gr.Row(visible=False),
                comparison: gr.Column(visible=True),
                **dict(zip(grid, cells, strict=True)),
                address: choice.query,
            }

        def on(trigger: Any, function: Any, taken: Any, changed: Any, **options: Any) -> None:
            trigger(function, taken, changed, concurrency_id="policy", concurrency_limit=1, **options)

        results = [verdict, single, comparison, video, picture, address, *grid]
        quiet = {"show_progress": "hidden"}
        on(page.load, begin, None, outputs, **quiet)
        for trigger in (task.input, seed.submit, seed.blur):
            on(trigger, change_scene, [shown, *inputs], outputs, **quiet)
        on(new_scene.click, draw_scene, [shown, *inputs], outputs, **quiet)
        on(demonstrated.input, change_demonstration, inputs, outputs, **quiet)
        on(record.click, record_another, inputs, outputs, show_progress_on=[ends])
        for trigger in (run.click, sentence.submit):
            on(trigger, run_one, inputs, results, show_progress_on=[verdict])
        on(compare.click, run_four, inputs, results, show_progress_on=[verdict])
        chips.click(lambda sample: sample[0], chips, sentence, show_progress="hidden")
        address.change(None, address, None, js=_REPLACE_ADDRESS)
    return page


def play(arguments: PlayArguments) -> None:
    """Serves the page on this machine until it is interrupted.

    Raises:
        ValueError: There is no checkpoint, its policy is not one for the benchmark, or the port is taken.
    """
    checkpoint, port = arguments.checkpoint, arguments.port
    with tempfile.TemporaryDirectory(prefix="deltaco-play-") as folder:
        chosen = Path(checkpoint) if checkpoint else shipped_checkpoint()
        page = build_page(Player(chosen, Path(folder)), checkpoint or chosen.name)
        # Fonts of the system, so that the page needs no other server.
        theme = gr.themes.Default(
            font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"], primary_hue="orange"
        )
        try:
            page.queue().launch(
                server_name="127.0.0.1",
                server_port=port,
                share=False,
                theme=theme,
                head=f"<style>{_CSS}</style>",
                footer_links=[],
            )
        except OSError as error:
            raise ValueError(f"Port {port} is taken. Choose another one with --port.") from error
