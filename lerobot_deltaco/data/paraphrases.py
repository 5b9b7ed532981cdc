"""Reads a file of instructions as a policy needs it: by the task strings of the benchmark's datasets."""

from __future__ import annotations

from pathlib import Path

from gym_deltaco.instructions import read_instructions
from gym_deltaco.tasks import get_task


def read_paraphrases(path: str | Path, split: str = "all") -> dict[str, tuple[str, ...]]:
    """Reads the sentences of tasks.

    Args:
        path: CSV file, as `gym_deltaco.instructions.read_instructions` takes it.
        split: Split of the file's sentences: "all", "train" or "held_out".

    Returns:
        By task string, the benchmark's template, its sentences.

    Raises:
        InstructionsError: The file cannot be used.
    """
    return {
        get_task(task_id).instruction: sentences
        for task_id, sentences in read_instructions(path, split).items()
    }
