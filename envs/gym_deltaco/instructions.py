"""Instructions written by people: sentences for tasks, read from a CSV file.

The benchmark's own instruction of a task is a template. The paper's authors also collected five sentences for
each of the 300 tasks from people (appendix H), spelling mistakes included. Nothing here depends on a
simulator.
"""

from __future__ import annotations

import csv
import io
import reprlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from gym_deltaco.atomic_files import atomic_write
from gym_deltaco.tasks import N_TASKS, OBJECTS, TASKS, get_task

INSTRUCTION_SPLITS = ("all", "train", "held_out")

# A file's columns: ours, and those of the authors' file, which also numbers its rows.
COLUMNS = ("task_id", "instruction")
AUTHORS_COLUMNS = ("", "Task ID", "Instruction")
AUTHORS_SENTENCES_PER_TASK = 5


class InstructionsError(ValueError):
    """A file of instructions cannot be used; the message says what is wrong with it."""


def read_instructions(path: str | Path, split: str = "all") -> dict[int, tuple[str, ...]]:
    """Reads the sentences of tasks from a CSV file.

    Args:
        path: The file, in UTF-8, with the columns `task_id` (0..299, or 1000..1479 for those by color and
            shape) and `instruction`; or the authors' file, with the columns "" (the row's number), "Task ID"
            and "Instruction".
        split: Split of the sentences; see `split_instructions`.

    Returns:
        By index of the task, its distinct sentences in the order of the file. Runs of spaces are one space.

    Raises:
        InstructionsError: The file is missing, or is no such file; the message names the line.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InstructionsError(f"The instructions {path} cannot be read: {error}.") from error
    return split_instructions(by_task(parse_instructions(text, str(path))), split)


def choose_instructions(
    task_ids: Sequence[int],
    path: str | Path | None = None,
    split: str = "all",
    sentence: str | None = None,
) -> dict[int, tuple[str, ...]] | None:
    """The sentences that tasks are run with, from a file or one that a person typed.

    Args:
        task_ids: Indices of the tasks.
        path: A CSV file, as `read_instructions` takes it.
        split: Split of the file's sentences; see `split_instructions`.
        sentence: A sentence for all of the tasks, in whatever words.

    Returns:
        At least one sentence for each task; None if there is neither a file nor a sentence.

    Raises:
        InstructionsError: The file has no sentence for a task, or cannot be used.
        ValueError: There are both a file and a sentence, or the sentence is empty.
    """
    check_wording(path, split, sentence)
    if sentence is not None:
        return dict.fromkeys(task_ids, (" ".join(sentence.split()),))
    if path is None:
        return None
    found = read_instructions(path, split)
    check_tasks(found, task_ids, f"The split {split!r} of {path}" if split != "all" else str(path))
    return {task_id: found[task_id] for task_id in task_ids}


def check_wording(path: str | Path | None, split: str, sentence: str | None) -> None:
    """Checks the arguments of `choose_instructions`, without reading the file.

    Raises:
        ValueError: There is no such split, or there are both a file and a sentence, or it is empty.
    """
    if split not in INSTRUCTION_SPLITS:
        raise ValueError(
            f"`instructions_split` must be one of {', '.join(INSTRUCTION_SPLITS)}. Got {split!r}."
        )
    if sentence is not None and path is not None:
        raise ValueError("`instructions` (a file) and `instruction` (a sentence) exclude each other.")
    if sentence is not None and not sentence.strip():
        raise ValueError("`instruction` must be a sentence. It is empty.")


def parse_instructions(text: str, source: str) -> list[tuple[int, str]]:
    """Reads the rows of a CSV file.

    Args:
        text: Content of the file.
        source: Name of the file, for error messages.

    Returns:
        Index of the task and sentence, of each row.

    Raises:
        InstructionsError: It is no such file; the message names the line.
    """
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows = []
    try:
        header = tuple(name.strip() for name in next(reader, []))
        if header not in (COLUMNS, AUTHORS_COLUMNS):
            raise InstructionsError(
                f"{source} must begin with a line that names the columns: {','.join(COLUMNS)} or "
                f"{','.join(AUTHORS_COLUMNS)} (the authors' file). It begins with {','.join(header)!r}."
            )
        for row in reader:
            if not row:
                continue
            if len(row) != len(header):
                raise InstructionsError(
                    f"{source}, line {reader.line_num}: there must be {len(header)} columns. Got {len(row)}; "
                    "a sentence with a comma is put between double quotes."
                )
            task_id, sentence = row[-2:]
            rows.append(_parse_row(task_id, sentence, f"{source}, line {reader.line_num}"))
    except csv.Error as error:
        raise InstructionsError(f"{source}, line {reader.line_num}: {error}.") from error
    if not rows:
        raise InstructionsError(f"{source} has no instructions.")
    return rows


def _parse_row(task_id: str, sentence: str, place: str) -> tuple[int, str]:
    sentence = " ".join(sentence.split())
    if not sentence:
        raise InstructionsError(f"{place}: the instruction is empty.")
    if not task_id.strip().isdecimal():
        raise InstructionsError(f"{place}: a task is a number from 0 to {N_TASKS - 1}. Got {task_id!r}.")
    try:
        return get_task(int(task_id)).index, sentence
    except ValueError as error:
        raise InstructionsError(f"{place}: {error}") from None


def by_task(rows: Iterable[tuple[int, str]]) -> dict[int, tuple[str, ...]]:
    """The distinct sentences of each task, in the order of the rows, tasks ascending."""
    found: dict[int, dict[str, str]] = {}
    for task_id, sentence in rows:
        found.setdefault(task_id, {}).setdefault(_key(sentence), sentence)
    return {task_id: tuple(found[task_id].values()) for task_id in sorted(found)}


def split_instructions(instructions: Mapping[int, tuple[str, ...]], split: str) -> dict[int, tuple[str, ...]]:
    """Chooses sentences for training, or those that are held out of it.

    Args:
        instructions: The sentences of each task.
        split: "held_out": the last sentence of each task. "train": every sentence that is held out for no
            task, whatever its capital letters, so that no held-out one is trained on as another task's.
            "all": both, and training sentences that another task holds out.

    Returns:
        The sentences of each task that has some.

    Raises:
        ValueError: There is no such split.
    """
    check_wording(None, split, None)
    if split == "all":
        return dict(instructions)
    if split == "held_out":
        return {task_id: sentences[-1:] for task_id, sentences in instructions.items()}
    held_out = {_key(sentences[-1]) for sentences in instructions.values()}
    kept = {
        task_id: tuple(sentence for sentence in sentences if _key(sentence) not in held_out)
        for task_id, sentences in instructions.items()
    }
    return {task_id: sentences for task_id, sentences in kept.items() if sentences}


def bare_name_instructions() -> dict[int, str]:
    """Instructions that give an object's bare name, as the authors' code does in ambiguity scheme (ii).

    Returns:
        By index of the task, such as "Put smushed dumbbell in green bin."; tasks of colors and shapes have no
        other name, and keep their template.
    """
    found = {}
    for task in TASKS:
        phrase = OBJECTS[task.row].name if task.kind == "name" else task.object_phrase
        found[task.index] = f"Put {phrase} in {task.container} bin."
    return found


def write_instructions(path: Path, instructions: Mapping[int, str]) -> None:
    """Writes a CSV file with one instruction for each task.

    Args:
        path: The file to write.
        instructions: Instruction of each task.
    """
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows(instructions.items())


def check_instructions(instructions: Mapping[int, Sequence[str]]) -> None:
    """Checks that there are lists of sentences, by task.

    Args:
        instructions: The sentences of each task.

    Raises:
        ValueError: They are something else, or a sentence is empty; the message says what.
    """
    needed = (
        '`instructions` must be a dictionary of lists of sentences by task, such as {4: ["Put it into the '
        'green bin."]}; `gym_deltaco.instructions.read_instructions` makes one from a file.'
    )
    if not isinstance(instructions, Mapping):
        raise ValueError(f"{needed} Got {reprlib.repr(instructions)}.")
    for task_id, sentences in instructions.items():
        try:
            get_task(task_id)
        except ValueError as error:
            raise ValueError(f"`instructions` has sentences for what is no task: {error}") from None
        if (
            not isinstance(sentences, Sequence)
            or isinstance(sentences, str)
            or not sentences
            or not all(isinstance(sentence, str) and sentence.strip() for sentence in sentences)
        ):
            raise ValueError(f"{needed} Got {reprlib.repr(sentences)} for task {task_id}.")


def check_tasks(instructions: Mapping[int, Sequence[str]], task_ids: Iterable[int], source: str) -> None:
    """Checks that there are sentences for tasks.

    Args:
        instructions: The sentences of each task.
        task_ids: Indices of the tasks.
        source: Origin of the sentences, for the error message.

    Raises:
        InstructionsError: A task has none.
    """
    missing = [task_id for task_id in task_ids if not instructions.get(task_id)]
    if missing:
        others = f" and {len(missing) - 1} others" if len(missing) > 1 else ""
        raise InstructionsError(
            f"{source} has no instruction for task {missing[0]} ({get_task(missing[0]).instruction!r})"
            f"{others}. Add some, or choose other tasks."
        )


def check_authors(rows: Iterable[tuple[int, str]], source: str) -> None:
    """Checks that rows are as many as the authors': five for each of the 300 tasks.

    Args:
        rows: Index of the task and sentence, of each row.
        source: Origin of the rows, for the error message.

    Raises:
        InstructionsError: A task has more or fewer, or is none of these.
    """
    counts = Counter(task_id for task_id, _ in rows)
    others = sorted(counts.keys() - range(N_TASKS))
    if others:
        raise InstructionsError(
            f"{source} has instructions for task {others[0]}. The authors' tasks are 0 to {N_TASKS - 1}."
        )
    wrong = [task_id for task_id in range(N_TASKS) if counts[task_id] != AUTHORS_SENTENCES_PER_TASK]
    if wrong:
        raise InstructionsError(
            f"{source} must have {AUTHORS_SENTENCES_PER_TASK} instructions for each of the {N_TASKS} tasks. "
            f"It has {counts.total()} in all, and {counts[wrong[0]]} for task {wrong[0]}."
        )


def _key(sentence: str) -> str:
    """Equal for sentences that differ in nothing but capital letters, which encoders do not see."""
    return sentence.casefold()
