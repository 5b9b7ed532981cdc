"""`deltaco-embed`: embeds instructions for machines without the language encoder."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from gym_deltaco.atomic_files import atomic_write
from gym_deltaco.tasks import get_task, select_tasks
from lerobot_deltaco.commands.command_errors import exit_on_error
from lerobot_deltaco.policy.language.encoder_names import DEFAULT_LANGUAGE_ENCODER, LANGUAGE_ENCODERS


def main(arguments: list[str] | None = None) -> None:
    """Embeds instructions, and writes the embeddings to a file."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        instructions = [get_task(index).instruction for index in select_tasks(options.tasks)]
        if options.instructions is not None:
            lines = options.instructions.read_text(encoding="utf-8").splitlines()
            instructions += [line.strip() for line in lines if line.strip()]
    except (ValueError, OSError) as error:
        parser.error(str(error))
    # Only here, since they take seconds to import.
    from lerobot_deltaco.policy.language.instruction_table import InstructionTable, LanguageEncoderError
    from lerobot_deltaco.policy.task_file import write_task_file

    table = InstructionTable(options.language_encoder)
    with exit_on_error(parser, LanguageEncoderError, OSError):
        table.add(instructions)
        with atomic_write(options.out) as temporary:
            write_task_file(temporary, table.contents())
    sys.stdout.write(
        f"{options.out}: {len(table.rows)} instructions. Train with "
        f"--policy.instruction_embeddings={options.out} "
        f"--policy.language_encoder={options.language_encoder}.\n"
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="deltaco-embed",
        description="Writes embeddings of instructions to a file. With it, a machine without the language "
        "encoder and without a network can train and evaluate.",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=".safetensors file to write")
    parser.add_argument(
        "--tasks",
        default="all",
        help="task set of the benchmark, or indices and ranges, such as 4,50-73 (default: %(default)s)",
    )
    parser.add_argument(
        "--instructions",
        type=Path,
        metavar="FILE",
        help="text file with further instructions, one per line",
    )
    parser.add_argument(
        "--language-encoder",
        choices=LANGUAGE_ENCODERS,
        default=DEFAULT_LANGUAGE_ENCODER,
        help="sentence encoder (default: %(default)s)",
    )
    return parser


if __name__ == "__main__":
    main()
