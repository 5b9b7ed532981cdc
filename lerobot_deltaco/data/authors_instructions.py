"""The instructions that the paper's authors collected from people, fetched from their site.

Their license is not stated, so they are not shipped: each user downloads them.
"""

from __future__ import annotations

from pathlib import Path

import httpx

from gym_deltaco.atomic_files import atomic_write
from gym_deltaco.instructions import InstructionsError, check_authors, parse_instructions

AUTHORS_URL = "https://deltaco-robot.github.io/files/all_human_data.csv"
TIMEOUT = 20.0  # s, for connecting and for each part of the answer
MAX_BYTES = 5_000_000  # the file has 82 kB


def fetch_instructions(path: Path, url: str = AUTHORS_URL) -> int:
    """Downloads the authors' instructions, and checks that they are five for each of the 300 tasks.

    Args:
        path: The file to write; nothing is written unless all is well.
        url: Address of the instructions.

    Returns:
        Their number.

    Raises:
        InstructionsError: They cannot be downloaded, or are others than expected.
        OSError: The file cannot be written.
    """
    content = _download(url)
    try:
        rows = parse_instructions(content.decode("utf-8-sig"), url)
    except UnicodeDecodeError as error:
        raise InstructionsError(f"{url} is no text in UTF-8: {error}.") from error
    check_authors(rows, url)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
    return len(rows)


def _download(url: str) -> bytes:
    content = bytearray()
    try:
        with httpx.stream("GET", url, timeout=TIMEOUT, follow_redirects=True) as response:
            response.raise_for_status()
            for part in response.iter_bytes():
                content += part
                if len(content) > MAX_BYTES:
                    raise InstructionsError(
                        f"{url} is no file of instructions: it has over {MAX_BYTES:,} bytes."
                    )
    except httpx.HTTPStatusError as error:
        raise InstructionsError(
            f"{url} cannot be downloaded: the server answers {error.response.status_code} "
            f"{error.response.reason_phrase}. Name another address with --url."
        ) from error
    except (httpx.HTTPError, httpx.InvalidURL) as error:
        raise InstructionsError(
            f"{url} cannot be downloaded: {error or type(error).__name__}. Without a network, download the "
            "file elsewhere, and use it by its path."
        ) from error
    return bytes(content)
