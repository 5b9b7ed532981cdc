"""Tables of the documentation's pages that are made from the committed records."""

from __future__ import annotations


class PageTableError(ValueError):
    """A table cannot be made, or a page has no place for it; the message says why."""


def replaced(page: str, begin: str, end: str, table: str) -> str:
    """A page with a new table between two of its lines.

    Args:
        page: Text of the page.
        begin: Line above the table.
        end: Line below it.
        table: Table in Markdown.

    Raises:
        PageTableError: The page lacks one of the lines.
    """
    before, found_begin, rest = page.partition(begin)
    _, found_end, after = rest.partition(end)
    if not found_begin or not found_end:
        raise PageTableError(
            f"The page needs the lines {begin!r} and {end!r}, between which the table stands."
        )
    return f"{before}{begin}\n\n{table}\n{end}{after}"
