"""Reads instructions that people wrote, from CSV files.

The benchmark's own instruction of a task is a template. The paper's authors also collected five sentences
for each of the 300 tasks from people (appendix H), spelling mistakes included. Their license is not stated,
so the project does not ship them: `curl -LO https://deltaco-robot.github.io/files/all_human_data.csv`.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import get_args

import numpy as np

from gym_deltaco.phrases import PhraseSplit, paraphrase
from gym_deltaco.tasks import COLOR_SHAPE_TASKS, TASKS, get_task
from lerobot_deltaco.errors import UserError

PARAPHRASES_SPLITS = ("all", "train", "held_out")
GRAMMAR = "grammar"  # in place of a file: sentences that the benchmark makes from phrases
_N_FROM_GRAMMAR = 8  # sentences of each task and split
# Columns of our files, and of the authors' file, which also numbers its rows
_COLUMNS = ["task_id", "instruction"]
_AUTHORS_COLUMNS = ["", "Task ID", "Instruction"]


def read_paraphrases(
    path: str | Path, split: str = "all", task_ids: Iterable[int] | None = None
) -> dict[int, tuple[str, ...]]:
    """Reads the sentences of tasks from a CSV file, or makes them from the benchmark's phrases.

    Args:
        path: "grammar" for the benchmark's phrases; or a file in UTF-8 with the columns `task_id` (0..299, or
            1000..1479 for tasks by color and shape) and `instruction`; or the authors' file, with the columns
            "" (number of the row), "Task ID" and "Instruction".
        split: "all"; "held_out", the last sentence of each task (with "grammar", sentences with phrases that
            are in no other); or "train", the sentences that are not held out for any task. Upper and lower
            case do not distinguish sentences.
        task_ids: Tasks for which sentences are made with "grammar"; None for all.

    Returns:
        Distinct sentences by task index, in the order of the file; tasks ascending, without tasks that have
        no sentence in the split.

    Raises:
        UserError: The split is unknown, or the file is missing or invalid; the message names the line.
    """
    if split not in PARAPHRASES_SPLITS:
        raise UserError(f"`paraphrases_split` must be one of {', '.join(PARAPHRASES_SPLITS)}. Got {split!r}.")
    if path == GRAMMAR:
        if task_ids is None:
            task_ids = (task.index for task in (*TASKS, *COLOR_SHAPE_TASKS))
        return {task_id: _from_grammar(task_id, split) for task_id in sorted(task_ids)}
    distinct: dict[int, dict[str, str]] = {}
    for task_id, sentence in _read_rows(path):
        distinct.setdefault(task_id, {}).setdefault(sentence.casefold(), sentence)
    sentences = {task_id: tuple(distinct[task_id].values()) for task_id in sorted(distinct)}
    if split == "held_out":
        return {task_id: all_of_task[-1:] for task_id, all_of_task in sentences.items()}
    if split == "train":
        held_out = {all_of_task[-1].casefold() for all_of_task in sentences.values()}
        kept = {
            task_id: tuple(sentence for sentence in all_of_task if sentence.casefold() not in held_out)
            for task_id, all_of_task in sentences.items()
        }
        return {task_id: of_task for task_id, of_task in kept.items() if of_task}
    return sentences


def choose_instructions(
    task_ids: Sequence[int],
    paraphrases: str | Path | None = None,
    split: str = "all",
    instruction: str | None = None,
) -> dict[int, tuple[str, ...]] | None:
    """Returns the instructions with which tasks are evaluated, as `PickPlaceEnv` takes them.

    Args:
        task_ids: Indices of the tasks.
        paraphrases: CSV file, as `read_paraphrases` takes it.
        split: Split of the file.
        instruction: One sentence for all tasks, instead of a file.

    Returns:
        One or more sentences for each task; without file and sentence None, for the benchmark's templates.

    Raises:
        UserError: Both a file and a sentence are given, the sentence is empty, or the file is invalid or
            lacks a task.
    """
    if instruction is not None:
        if paraphrases is not None:
            raise UserError("Give either `paraphrases` (a file) or `instruction` (a sentence), not both.")
        if not instruction.strip():
            raise UserError("`instruction` must be a sentence. It is empty.")
        return dict.fromkeys(task_ids, (" ".join(instruction.split()),))
    if paraphrases is None:
        return None
    sentences = read_paraphrases(paraphrases, split, task_ids)
    missing = [task_id for task_id in task_ids if task_id not in sentences]
    if missing:
        more = f" and {len(missing) - 1} more tasks" if len(missing) > 1 else ""
        raise UserError(
            f"{paraphrases} (split {split!r}) has no instruction for task {missing[0]} "
            f"({get_task(missing[0]).instruction!r}){more}. Add some, or choose other tasks."
        )
    return {task_id: sentences[task_id] for task_id in task_ids}


@cache
def _from_grammar(task_id: int, split: str) -> tuple[str, ...]:
    found: list[str] = []
    for number, own in enumerate(get_args(PhraseSplit)):
        if split in (own, "all"):
            rng = np.random.default_rng((task_id, number))
            sentences = [paraphrase(get_task(task_id), own, rng) for _ in range(_N_FROM_GRAMMAR)]
            found += dict.fromkeys(sentences)
    return tuple(found)


def _read_rows(path: str | Path) -> list[tuple[int, str]]:
    """Reads task index and sentence of each row. Runs of white space become one space."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"Cannot read the paraphrases {path}: {error}.") from error
    reader = csv.reader(text.splitlines(keepends=True), strict=True)
    rows = []
    try:
        header = [name.strip() for name in next(reader, [])]
        if header not in (_COLUMNS, _AUTHORS_COLUMNS):
            raise UserError(
                f"expected the columns {','.join(_COLUMNS)} or {','.join(_AUTHORS_COLUMNS)} (the authors' "
                f"file). Got {','.join(header)!r}."
            )
        for row in filter(None, reader):
            if len(row) != len(header):
                raise UserError(
                    f"expected {len(header)} columns. Got {len(row)}. Put sentences with a comma between "
                    "double quotes."
                )
            number, sentence = row[-2].strip(), " ".join(row[-1].split())
            if not sentence:
                raise UserError("the instruction is empty.")
            rows.append((get_task(int(number) if number.isdecimal() else number).index, sentence))  # type: ignore[arg-type]
    except (csv.Error, ValueError) as error:
        raise UserError(f"{path}, line {max(reader.line_num, 1)}: {error}") from None
    if not rows:
        raise UserError(f"{path} has no instructions.")
    return rows
