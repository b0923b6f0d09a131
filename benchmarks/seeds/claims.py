"""Claims of the texts and our findings: the results that an experiment gives to its page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

Figures = dict[str, Any]
"""An experiment's measurements, JSON values only, so that the page can be written again without measuring."""


@dataclass(frozen=True)
class Claim:
    """A claim of a source in our words, our finding with its figures, whether the claim holds here, and the reason.

    ``verdict`` is ``None`` if the experiment cannot decide the claim.
    """

    source: str
    statement: str
    finding: str
    verdict: bool | None
    reason: str


Tables = list[tuple[str, list[dict[str, str]]]]
"""Titles, and rows with the same keys: the columns."""


@dataclass(frozen=True)
class Section:
    """A part of the page: its method, tables, claims, pictures.

    Pictures are names of files in ``docs/images`` with their captions.
    """

    title: str
    method: str
    tables: Tables = field(default_factory=list)
    claims: list[Claim] = field(default_factory=list)
    pictures: list[tuple[str, str]] = field(default_factory=list)


@dataclass(frozen=True)
class Experiment:
    """An experiment. ``measure`` takes seconds to minutes; ``section`` formats its figures for the page and measures nothing."""

    measure: Callable[[], Figures]
    section: Callable[[Figures], Section]


def markdown(section: Section) -> str:
    """Format a section as Markdown."""
    parts = [f"## {section.title}", section.method]
    for title, rows in section.tables:
        parts.append("\n".join([f"**{title}**", "", *table(rows)]))
    if section.claims:
        parts.append("\n".join(claims_table(section.claims)))
    parts += [f"![{caption}](images/{name})\n\n*{caption}*" for name, caption in section.pictures]
    return "\n\n".join(parts) + "\n"


def claims_table(claims: list[Claim]) -> list[str]:
    """Return the lines of a Markdown table of claims."""
    words = {True: "held", False: "**not held**", None: "open"}
    return table(
        [
            {
                "claim": f"{claim.statement} ({claim.source})",
                "found here": claim.finding,
                "": words[claim.verdict],
                "why": claim.reason,
            }
            for claim in claims
        ]
    )


def table(rows: list[dict[str, str]]) -> list[str]:
    """Return lines of a Markdown table; the keys of the first row are the columns."""
    if not rows:
        return []
    columns = list(rows[0])
    lines = ["| " + " | ".join(columns) + " |", "|" + " --- |" * len(columns)]
    return lines + ["| " + " | ".join(str(row[column]) for column in columns) + " |" for row in rows]
