"""`deltaco-embed`: embeddings of instructions, for machines without the language model."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from gym_deltaco.atomic_files import atomic_write
from gym_deltaco.tasks import get_task, select_tasks
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.policy.language import InstructionTable, LanguageEncoderError
from lerobot_deltaco.policy.language_encoders import LANGUAGE_ENCODERS
from lerobot_deltaco.policy.task_file import write_task_file


def main(arguments: list[str] | None = None) -> None:
    """Embeds instructions, and writes them to a file."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        instructions = [get_task(index).instruction for index in select_tasks(options.tasks)]
        if options.instructions is not None:
            lines = options.instructions.read_text(encoding="utf-8").splitlines()
            instructions += [line.strip() for line in lines if line.strip()]
    except (ValueError, OSError) as error:
        parser.error(str(error))
    table = InstructionTable(options.language_encoder)
    try:
        table.add(instructions)
        with atomic_write(options.out) as temporary:
            write_task_file(temporary, table)
    except (LanguageEncoderError, OSError) as error:
        parser.exit(1, f"{parser.prog}: {error}\n")
    sys.stdout.write(
        f"{options.out}: {len(table.rows)} instructions. Train with "
        f"--policy.instruction_embeddings={options.out} "
        f"--policy.language_encoder={options.language_encoder}.\n"
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-embed",
        description="Writes embeddings of instructions to a file, with which a machine without the language "
        "model and without a network trains and evaluates.",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="a .safetensors file")
    parser.add_argument(
        "--tasks",
        default="all",
        help="of the benchmark: a task set, or indices and ranges, such as 4,50-73 (%(default)s)",
    )
    parser.add_argument(
        "--instructions",
        type=Path,
        metavar="FILE",
        help="a text file with further instructions, one in a line",
    )
    parser.add_argument(
        "--language-encoder",
        choices=LANGUAGE_ENCODERS,
        default=DeltacoConfig.language_encoder,
        help="(%(default)s)",
    )
    return parser


if __name__ == "__main__":
    main()
