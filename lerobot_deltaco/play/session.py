"""What one user of the page has chosen and seen, and what the page's buttons do, without the page."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from gym_deltaco.tasks import TASKS
from lerobot_deltaco.play.engine import Engine
from lerobot_deltaco.play.errors import PlayError
from lerobot_deltaco.play.modalities import (
    BOTH,
    DEMONSTRATION_ALONE,
    INSTRUCTION_ALONE,
    Uses,
    learned_uses,
)

if TYPE_CHECKING:
    from lerobot_deltaco.play.demonstrations import Demonstration
    from lerobot_deltaco.play.episodes import Moment, Scene, SceneView

TASK_OF_INSTRUCTION = {task.instruction: task.index for task in TASKS}
_MAX_RANDOM_SEED = 9999


@dataclass(frozen=True)
class Run:
    """An episode that runs or has run, for the page.

    Attributes:
        title: Description: who acts, in which scene, by which demonstration and instruction.
        moment: The latest moment of the episode.
    """

    title: str
    moment: Moment


@dataclass(frozen=True)
class Session:
    """The choices of one user. Every action returns a new one, so that users cannot mix.

    Attributes:
        checkpoint: Name of the checkpoint; None until the first is loaded.
        uses: What the checkpoint can do with and without.
        use: What the next run uses, one of the choices of `uses`.
        dataset: Name of the dataset whose episodes are the demonstrations; None for the checkpoint's own.
        demonstrated_tasks: Number of those demonstrations by task string.
        scene: The scene.
        view: View of the scene.
        demonstration: The demonstration; None if the checkpoint has none, or none is chosen.
        demonstrated: Task string and number of a demonstration of the checkpoint's or the dataset's; None for
            another one.
        sentence: The instruction.
        recorded: Demonstration that the expert made last.
        earlier: The run before the latest.
        latest: The latest run.
    """

    checkpoint: str | None = None
    uses: Uses = Uses()
    use: str = BOTH
    dataset: str | None = None
    demonstrated_tasks: dict[str, int] | None = None
    scene: Scene | None = None
    view: SceneView | None = None
    demonstration: Demonstration | None = None
    demonstrated: tuple[str, int] | None = None
    sentence: str = ""
    recorded: Demonstration | None = None
    earlier: Run | None = None
    latest: Run | None = None


class Actions:
    """Actions of the users. Each action takes a session and returns the next one, or yields several.

    All of them raise `PlayError` with a message for the user.

    Args:
        engine: Runs episodes.
        rng: Source of what is drawn at random.
    """

    def __init__(self, engine: Engine, rng: random.Random | None = None) -> None:
        self._engine = engine
        self._random = rng or random.Random()

    def resumed(self, session: Session) -> Session:
        """The session; one with the first checkpoint if it has none, since it is new or was forgotten."""
        if session.checkpoint is None and self._engine.status.is_ready:
            return self.open_checkpoint(session, self._engine.default_checkpoint)
        return session

    def open_checkpoint(self, session: Session, name: str) -> Session:
        """Takes another checkpoint, its own demonstrations, and a first scene and demonstration for it."""
        name = name.strip()
        uses = self._engine.call(name, lambda player: learned_uses(player.policy.config))
        use = session.use if session.use in uses.choices else BOTH
        return self._take_demonstrations(replace(session, checkpoint=name, uses=uses, use=use), name, None)

    def open_dataset(self, session: Session, name: str) -> Session:
        """Takes the episodes of a dataset as demonstrations; without a name, the checkpoint's own again."""
        checkpoint, _ = _opened(session)
        return self._take_demonstrations(session, checkpoint, name.strip() or None)

    def _take_demonstrations(self, session: Session, checkpoint: str, dataset: str | None) -> Session:
        counts = self._engine.demonstrated_tasks(checkpoint, dataset)
        session = replace(
            session, dataset=dataset, demonstrated_tasks=counts, demonstration=None, demonstrated=None
        )
        if session.scene is None:
            session = self.random_scene(session)
        task = TASKS[session.scene.task_id].instruction if session.scene else ""
        if task not in counts:
            task = next(iter(counts), "")
        return self.choose_demonstration(session, task, 1) if task else session

    def choose_use(self, session: Session, use: str) -> Session:
        """Takes the demonstration, the instruction, or both for the next run."""
        if use not in session.uses.choices:
            raise PlayError(f"This checkpoint can use {' or '.join(session.uses.choices)}. Got {use!r}.")
        return replace(session, use=use)

    def random_scene(self, session: Session) -> Session:
        """Draws a scene of a task that there are demonstrations of, with one of them."""
        checkpoint, counts = _opened(session)
        tasks = [TASK_OF_INSTRUCTION[task] for task in counts if task in TASK_OF_INSTRUCTION]
        task_id = self._random.choice(tasks or [task.index for task in TASKS])
        session = self.choose_scene(session, task_id, self._random.randint(0, _MAX_RANDOM_SEED))
        instruction = TASKS[task_id].instruction
        if instruction in counts:
            number = self._random.randint(1, counts[instruction])
            session = self.choose_demonstration(session, instruction, number)
        return session

    def choose_scene(self, session: Session, task_id: int, seed: Any) -> Session:
        """Takes the scene of a task and a seed, and the task's own instruction, unless it is that already."""
        from lerobot_deltaco.play.episodes import checked_scene, view_scene

        checkpoint, _ = _opened(session)
        scene = checked_scene(task_id, seed)
        if scene == session.scene:
            return session
        view = self._engine.call(checkpoint, lambda _: view_scene(scene))
        return replace(session, scene=scene, view=view, sentence=TASKS[scene.task_id].instruction)

    def choose_demonstration(self, session: Session, task: str, number: int) -> Session:
        """Takes a demonstration of the checkpoint's or the dataset's."""
        checkpoint, _ = _opened(session)
        demonstration = self._engine.demonstration(checkpoint, session.dataset, task, number)
        return replace(session, demonstration=demonstration, demonstrated=(task, number))

    def use_recorded(self, session: Session) -> Session:
        """Takes the demonstration that the expert made last."""
        if session.recorded is None:
            raise PlayError("There is no episode of the expert yet. Let the expert do it first.")
        return replace(session, demonstration=session.recorded, demonstrated=None)

    def run(self, session: Session, sentence: str) -> Iterator[Session]:
        """Lets the policy perform the task of the demonstration and the sentence."""
        from lerobot_deltaco.play.episodes import checked_sentence

        checkpoint, _ = _opened(session)
        scene, demonstration = session.scene, session.demonstration
        if scene is None:
            raise PlayError("There is no scene yet. Choose one.")
        use = session.use
        if use == DEMONSTRATION_ALONE:
            instruction_text = "left out"
        else:
            instruction_text = sentence = checked_sentence(sentence)
        session = replace(session, sentence=sentence, earlier=session.latest)
        if use == INSTRUCTION_ALONE:
            demonstration_text = "left out"
        else:
            demonstration_text = demonstration.title if demonstration is not None else "none"
        title = (
            f"Policy, seed {scene.seed}\nInstruction: {instruction_text}\nDemonstration: {demonstration_text}"
        )
        moments = self._engine.stream(
            checkpoint, lambda player: player.run(scene, demonstration, sentence, use)
        )
        for moment in moments:
            yield replace(session, latest=Run(title, moment))

    def run_with_other_demonstration(self, session: Session, sentence: str) -> Iterator[Session]:
        """The same scene and sentence, with the demonstration of another task that makes sense there."""
        from lerobot_deltaco.play.episodes import other_demonstration

        _, counts = _opened(session)
        if session.view is None:
            raise PlayError("There is no scene yet. Choose one.")
        _check_used(session, INSTRUCTION_ALONE, "demonstration")
        task, number = other_demonstration(counts, session.view, session.demonstrated, self._random)
        yield from self.run(self.choose_demonstration(session, task, number), sentence)

    def run_with_other_sentence(self, session: Session) -> Iterator[Session]:
        """The same scene and demonstration, with the instruction of another task that makes sense there."""
        from lerobot_deltaco.play.episodes import other_instruction

        if session.view is None:
            raise PlayError("There is no scene yet. Choose one.")
        _check_used(session, DEMONSTRATION_ALONE, "instruction")
        yield from self.run(session, other_instruction(session.view, session.sentence, self._random))

    def run_expert(self, session: Session) -> Iterator[Session]:
        """Lets the scripted expert do the scene's own task, and keeps that as a demonstration."""
        from lerobot_deltaco.play.demonstrations import Demonstration

        checkpoint, _ = _opened(session)
        scene = session.scene
        if scene is None:
            raise PlayError("There is no scene yet. Choose one.")
        session = replace(session, earlier=session.latest)
        title = f"Scripted expert, seed {scene.seed}\nInstruction: {TASKS[scene.task_id].instruction}"
        for step in self._engine.stream(checkpoint, lambda player: player.expert_demonstration(scene)):
            if isinstance(step, Demonstration):
                session = replace(session, recorded=step)
            else:
                session = replace(session, latest=Run(title, step))
            yield session


def _check_used(session: Session, unused_by: str, word: str) -> None:
    """Checks that what is to be swapped matters."""
    if session.use == unused_by:
        raise PlayError(f"The {word} is left out, so another one changes nothing. Choose another use first.")


def _opened(session: Session) -> tuple[str, dict[str, int]]:
    """The session's checkpoint and its demonstrations."""
    if session.checkpoint is None or session.demonstrated_tasks is None:
        raise PlayError("No checkpoint is loaded yet. See the top of the page.")
    return session.checkpoint, session.demonstrated_tasks
