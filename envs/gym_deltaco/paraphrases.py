"""Sentences for the tasks, other than the template: from the grammar, or from a CSV file.

The paper's authors collected five sentences for each of the 300 tasks from people (appendix H), spelling
mistakes included. Their license is not stated, so the project does not ship them:
`curl -LO https://deltaco-robot.github.io/files/all_human_data.csv`.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import get_args

import numpy as np

from gym_deltaco.phrases import PhraseSplit, paraphrase
from gym_deltaco.tasks import ALL_TASKS, get_task, select_tasks

PARAPHRASES_SPLITS = ("all", "train", "held_out")
GRAMMAR = "grammar"  # in place of a file: sentences from `gym_deltaco.phrases`
_N_FROM_GRAMMAR = 8  # sentences of each task and split
_COLUMNS = ["task_id", "instruction"]
_AUTHORS_COLUMNS = ["", "Task ID", "Instruction"]  # of the authors' file, which also numbers its rows


def read_paraphrases(
    path: str | Path, split: str = "all", task_ids: Iterable[int] | None = None
) -> dict[int, tuple[str, ...]]:
    """Returns the sentences of tasks, from a CSV file or the grammar.

    Args:
        path: "grammar"; or a file in UTF-8 with the columns `task_id` and `instruction`; or the authors'
            file, with the columns "" (number of the row), "Task ID" and "Instruction".
        split: "all"; "held_out", the last sentence of each task (with "grammar", sentences with phrases that
            are in no training sentence); or "train", the sentences that are not held out for any task. Upper
            and lower case do not distinguish sentences.
        task_ids: Tasks for which the grammar makes sentences; None for all that an instruction describes.

    Returns:
        Distinct sentences by task index, in the order of the file; tasks ascending, without tasks that have
        no sentence in the split.

    Raises:
        ValueError: The split is unknown, or the file is missing or invalid; the message names the line.
    """
    if split not in PARAPHRASES_SPLITS:
        raise ValueError(
            f"`paraphrases_split` must be one of {', '.join(PARAPHRASES_SPLITS)}. Got {split!r}."
        )
    if path == GRAMMAR:
        if task_ids is None:
            task_ids = (task.index for task in ALL_TASKS.values() if task.object.index is None)
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


def write_training_sentences(path: Path, source: str | Path, task_ids: Iterable[int]) -> None:
    """Writes the sentences of the split "train" by task string, as `--policy.paraphrases` takes them.

    Args:
        path: CSV file with the columns `task` and `instruction`.
        source: "grammar", or a CSV file, as `read_paraphrases` takes it.
        task_ids: Indices of the tasks; those without a sentence are left out.

    Raises:
        ValueError: `source` is missing or invalid.
    """
    sentences = read_paraphrases(source, "train", task_ids)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["task", "instruction"])
        for task_id in task_ids:
            for sentence in sentences.get(task_id, ()):
                writer.writerow([get_task(task_id).instruction, sentence])


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
        One or more sentences for each task; without file and sentence None, for the templates.

    Raises:
        ValueError: Both a file and a sentence are given, the sentence is empty, or the file is invalid or
            lacks a task.
    """
    if instruction is not None:
        if paraphrases is not None:
            raise ValueError("Give either `paraphrases` (a file) or `instruction` (a sentence), not both.")
        if not instruction.strip():
            raise ValueError("`instruction` must be a sentence. It is empty.")
        return dict.fromkeys(task_ids, (" ".join(instruction.split()),))
    if paraphrases is None:
        return None
    sentences = read_paraphrases(paraphrases, split, task_ids)
    missing = [task_id for task_id in task_ids if task_id not in sentences]
    if missing:
        more = f" and {len(missing) - 1} more tasks" if len(missing) > 1 else ""
        raise ValueError(
            f"{paraphrases} (split {split!r}) has no instruction for task {missing[0]} "
            f"({get_task(missing[0]).instruction!r}){more}. Add some, or choose other tasks."
        )
    return {task_id: sentences[task_id] for task_id in task_ids}


@cache
def _from_grammar(task_id: int, split: str) -> tuple[str, ...]:
    sentences: list[str] = []
    for number, phrase_split in enumerate(get_args(PhraseSplit)):
        if split in (phrase_split, "all"):
            rng = np.random.default_rng((task_id, number))
            drawn = [paraphrase(get_task(task_id), phrase_split, rng) for _ in range(_N_FROM_GRAMMAR)]
            sentences += dict.fromkeys(drawn)
    return tuple(sentences)


def _read_rows(path: str | Path) -> list[tuple[int, str]]:
    """Reads task index and sentence of each row. Runs of white space become one space."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"Cannot read the paraphrases {path}: {error}.") from error
    reader = csv.reader(text.splitlines(keepends=True), strict=True)
    rows = []
    try:
        header = [name.strip() for name in next(reader, [])]
        if header not in (_COLUMNS, _AUTHORS_COLUMNS):
            raise ValueError(
                f"expected the columns {','.join(_COLUMNS)} or {','.join(_AUTHORS_COLUMNS)} (the authors' "
                f"file). Got {','.join(header)!r}."
            )
        for row in filter(None, reader):
            if len(row) != len(header):
                raise ValueError(
                    f"expected {len(header)} columns. Got {len(row)}. Put sentences with a comma between "
                    "double quotes."
                )
            number, sentence = row[-2].strip(), " ".join(row[-1].split())
            if not sentence:
                raise ValueError("the instruction is empty.")
            rows.append((get_task(int(number) if number.isdecimal() else number).index, sentence))  # type: ignore[arg-type]
    except (csv.Error, ValueError) as error:
        raise ValueError(f"{path}, line {max(reader.line_num, 1)}: {error}") from None
    if not rows:
        raise ValueError(f"{path} has no instructions.")
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write sentences for training, for --policy.paraphrases.")
    parser.add_argument("tasks", help="tasks, such as scenario_a_train")
    parser.add_argument("path", type=Path, help="CSV file to write")
    parser.add_argument("--source", default=GRAMMAR, help="grammar, or a CSV file of sentences by task index")
    arguments = parser.parse_args()
    write_training_sentences(arguments.path, arguments.source, select_tasks(arguments.tasks))
