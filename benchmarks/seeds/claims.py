"""Results of an experiment: claims of the texts with our measurements, and their format in Markdown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

Figures = dict[str, Any]
"""An experiment's measurements, JSON values only, so that the page can be written again without measuring."""


@dataclass(frozen=True)
class Claim:
    """A claim of a text, and our result.

    Attributes
    ----------
    source
        The text and its section.
    statement
        The claim in our words.
    measured_result
        Our figures, and the condition of the verdict.
    verdict
        Whether the claim holds here; ``None`` if the experiment cannot decide it.
    reason
        The reason for the verdict.
    """

    source: str
    statement: str
    measured_result: str
    verdict: bool | None
    reason: str


Tables = list[tuple[str, list[dict[str, str]]]]
"""Titles of tables with their rows. The keys of the rows are the columns."""


@dataclass(frozen=True)
class Section:
    """A section of the page.

    Attributes
    ----------
    title
        Heading.
    method
        Description of the experiment.
    tables, claims
        Tables of figures, and the claims that they decide.
    pictures
        Names of files in ``docs/images`` with their captions.
    """

    title: str
    method: str
    tables: Tables = field(default_factory=list)
    claims: list[Claim] = field(default_factory=list)
    pictures: list[tuple[str, str]] = field(default_factory=list)


@dataclass(frozen=True)
class Experiment:
    """An experiment: ``measure`` returns its figures, ``make_section`` formats stored figures as a section of the page."""

    measure: Callable[[], Figures]
    make_section: Callable[[Figures], Section]


def format_section(section: Section) -> str:
    """Format a section as Markdown."""
    parts = [f"## {section.title}", section.method]
    for title, rows in section.tables:
        parts.append("\n".join([f"**{title}**", "", *markdown_table(rows)]))
    if section.claims:
        parts.append("\n".join(format_claims(section.claims)))
    parts += [f"![{caption}](../images/{name})\n\n*{caption}*" for name, caption in section.pictures]
    return "\n\n".join(parts) + "\n"


def format_claims(claims: list[Claim]) -> list[str]:
    """Return the lines of a Markdown table of claims."""
    verdict_texts = {True: "held", False: "**not held**", None: "open"}
    return markdown_table(
        [
            {
                "claim": f"{claim.statement} ({claim.source})",
                "found here": claim.measured_result,
                "": verdict_texts[claim.verdict],
                "why": claim.reason,
            }
            for claim in claims
        ]
    )


def markdown_table(rows: list[dict[str, str]]) -> list[str]:
    """Return lines of a Markdown table; the keys of the first row are the columns."""
    if not rows:
        return []
    columns = list(rows[0])
    lines = ["| " + " | ".join(columns) + " |", "|" + " --- |" * len(columns)]
    return lines + ["| " + " | ".join(str(row[column]) for column in columns) + " |" for row in rows]
