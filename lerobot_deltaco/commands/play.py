"""`deltaco-play`: a page in the browser to play with a trained policy."""

from __future__ import annotations

import argparse
import errno
import ipaddress
import os
import socket
import sys
from collections.abc import Sequence
from pathlib import Path

from lerobot_deltaco.commands.command_errors import exit_on_error
from lerobot_deltaco.play.checkpoints import DEFAULT_NAME, checkpoints_folder
from lerobot_deltaco.play.engine import Engine
from lerobot_deltaco.play.errors import PlayError

MAX_PORT = 65535


def main(arguments: list[str] | None = None) -> None:
    """Serves the page until it is interrupted."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if not 1 <= options.port <= MAX_PORT:
        parser.error(f"--port must be 1 to {MAX_PORT}. Got {options.port}.")
    for folder in options.allow:
        if not folder.is_dir():
            parser.error(f"--allow must be a folder. There is none at {folder}.")
    own = checkpoints_folder() / DEFAULT_NAME
    if options.checkpoint is None and not own.is_dir():
        parser.exit(
            2,
            f"{parser.prog}: The project's own checkpoint is not at {own}. Name another one with "
            "--checkpoint: the folder `pretrained_model` of a training, or its id on the Hub.\n",
        )
    name = options.checkpoint or str(own)
    with exit_on_error(parser, PlayError, interrupted="Interrupted."):
        _check_address(options.host, options.port)
        roots = allowed_folders(options.host, options.allow, name)
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
                server_name=f"[{options.host.strip('[]')}]" if ":" in options.host else options.host,
                server_port=options.port,
                inbrowser=options.open,
                prevent_thread_lock=True,
                **launch_options(),
            )
        except OSError as error:
            _check_address(options.host, options.port)
            raise PlayError(f"The page cannot be served: {error}") from error
        engine.start()
        page.block_thread()
    sys.stdout.write("\nThe page has stopped.\n")
    if not engine.close():
        # The end of the interpreter would abort native code that still runs in the engine's thread.
        sys.stdout.flush()
        os._exit(0)


def allowed_folders(host: str, allowed: Sequence[Path], checkpoint: str) -> list[Path]:
    """Folders from which the page may load checkpoints and datasets.

    Args:
        host: Address that the page is served at. The current folder is among them only where no other machine
            reaches the page.
        allowed: Folders that the user named, instead of the current one.
        checkpoint: Name of the first checkpoint, which is among them if it is a folder.
    """
    default = [Path.cwd()] if _is_loopback(host) else []
    first = [Path(checkpoint)] if Path(checkpoint).is_dir() else []
    return [checkpoints_folder(), *(allowed or default), *first]


def _is_loopback(host: str) -> bool:
    """Whether an address can be reached from this machine alone."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def _check_address(host: str, port: int) -> None:
    """Checks that the page can be served, before Gradio is imported, which takes seconds.

    Raises:
        PlayError: It cannot.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host.strip("[]"), port), family=family).close()
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise _port_taken(port) from error
        reason = (error.strerror or str(error)).partition(" (")[0]  # without the address again
        raise PlayError(
            f"The page cannot be served at {host}, port {port}: {reason}. Choose another --host or --port."
        ) from error


def _port_taken(port: int) -> PlayError:
    return PlayError(f"Port {port} is taken. Choose another with --port.")


def _parser() -> argparse.ArgumentParser:
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
        help="folder of checkpoints and datasets for the page; may be repeated (default: the current folder, "
        "or none if other machines reach the page by --host)",
    )
    parser.add_argument("--no-hub", action="store_true", help="download nothing from the Hub")
    parser.add_argument("--host", default="127.0.0.1", help="address to serve at (default: %(default)s)")
    parser.add_argument("--port", type=int, default=7860, help="port to serve at (default: %(default)s)")
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    return parser


if __name__ == "__main__":
    main()
