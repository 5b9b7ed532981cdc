"""`deltaco-play`: a page in the browser to play with a trained policy."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from lerobot_deltaco.play.checkpoints import DEFAULT_NAME, checkpoints_folder
from lerobot_deltaco.play.engine import Engine


def main(arguments: list[str] | None = None) -> None:
    """Serves the page until it is interrupted."""
    parser = argparse.ArgumentParser(
        prog="deltaco-play",
        description="Serves a page on which a trained policy acts in scenes, with demonstrations and "
        "instructions that you choose. Stop it with Ctrl+C.",
    )
    parser.add_argument(
        "--checkpoint",
        metavar="DIR|USER/NAME",
        help=f"folder or Hub id of the checkpoint to begin with (default: the project's own, {DEFAULT_NAME})",
    )
    parser.add_argument(
        "--allow",
        type=Path,
        action="append",
        default=[],
        metavar="DIR",
        help="folder of checkpoints and datasets for the page; may be repeated (default: the current folder)",
    )
    parser.add_argument("--no-hub", action="store_true", help="download nothing from the Hub")
    parser.add_argument("--host", default="127.0.0.1", help="address to serve at (default: %(default)s)")
    parser.add_argument("--port", type=int, default=7860, help="port to serve at (default: %(default)s)")
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    options = parser.parse_args(arguments)
    own = checkpoints_folder() / DEFAULT_NAME
    if options.checkpoint is None and not own.is_dir():
        parser.exit(
            2,
            f"{parser.prog}: The project's own checkpoint is not at {own}. Name another one with "
            "--checkpoint: the folder `pretrained_model` of a training, or its id on the Hub.\n",
        )
    name = options.checkpoint or str(own)
    roots = [checkpoints_folder(), *(options.allow or [Path.cwd()])]
    if Path(name).is_dir():
        roots.append(Path(name))
    engine = Engine(name, roots, is_hub_allowed=not options.no_hub)
    # The page loads nothing from other servers and reports to none.
    os.environ.setdefault("GRADIO_ANALYTICS_ENABLED", "False")
    try:
        from lerobot_deltaco.play.page import build_page, launch_options
    except ModuleNotFoundError as error:
        if error.name != "gradio":
            raise
        parser.exit(2, f"{parser.prog}: Gradio is missing. Install this project's extra `play`.\n")
    page = build_page(engine)
    try:
        page.launch(
            server_name=options.host,
            server_port=options.port,
            inbrowser=options.open,
            prevent_thread_lock=True,
            **launch_options(),
        )
        engine.start()
        page.block_thread()
    except OSError as error:
        parser.exit(1, f"{parser.prog}: {error}\n")
    sys.stdout.write("\nThe page has stopped.\n")


if __name__ == "__main__":
    main()
