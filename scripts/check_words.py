"""Reject names that only this project uses although graphics or GIS have a term, and commit subjects that are too long.

python scripts/check_words.py                     # all Python files under version control
python scripts/check_words.py FILE...             # some of them
python scripts/check_words.py --commit-message FILE
"""

from __future__ import annotations

import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

MAX_SUBJECT_CHARACTERS = 72
"""Maximum characters of a commit's subject: as many as ``git log --oneline`` shows in a terminal of 80 columns."""

FIELD_TERMS = {
    r"_?(MOST|LEAST)_[A-Z0-9_]+": "MAX_..., MIN_...",
    "SetAside|SetAsideError": "CircuitBreaker",
    "NewSuns": "RateLimiter",
    "SentBefore|Watched": "TileCacheMiddleware, RequestMiddleware",
    "_flights|_land|_landed": "_pending, _finish",
    "_news": "_wake",
    "tally": "counters",
    "stands?_back|give_way|_make_way|_look_round": "is_background, evict_idle, reap_stalled",
    "told_of_compiling|read_the_suns_library|_say_how_it_is": "on_first_compile, import_pvlib, log_status",
    "forget_halves": "remove_partial_files",
    "is_bare|heights_say_all": "is_terrain_only, needs_heights_only",
    "to_look_at|of_points": "is_display",
    "there": "valid",
    "because": "reason",
}
"""Names that only this project used (regular expressions), and the usual terms in graphics and GIS."""

_FORBIDDEN_PATTERNS = {re.compile(pattern): term for pattern, term in FIELD_TERMS.items()}


def forbidden_names(path: Path) -> Iterator[tuple[int, str, str]]:
    """Yield the line number, the name and the usual term for each name in a Python file that ``FIELD_TERMS`` rejects."""
    with tokenize.open(path) as file:
        for token in tokenize.generate_tokens(file.readline):
            if token.type == tokenize.NAME:
                term = next((term for pattern, term in _FORBIDDEN_PATTERNS.items() if pattern.fullmatch(token.string)), None)
                if term is not None:
                    yield token.start[0], token.string, term


def subject_problem(message: str) -> str | None:
    """Return the problem of a commit message's subject, in words; ``None`` without one."""
    subject, _, rest = message.partition("\n")
    if len(subject) > MAX_SUBJECT_CHARACTERS:
        return f"{len(subject)} characters, more than the limit of {MAX_SUBJECT_CHARACTERS}: {subject}"
    if rest.strip() and not rest.startswith("\n"):
        return f"no empty line after it: {subject}"
    return None


def main(arguments: list[str]) -> int:
    """Print all problems and return the exit status: 1 if there are any, else 0."""
    if arguments[:1] == ["--commit-message"]:
        problem = subject_problem(Path(arguments[1]).read_text(encoding="utf-8"))
        if problem is not None:
            print(f"commit subject: {problem}", file=sys.stderr)
        return int(problem is not None)
    listed = subprocess.run(["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    paths = [Path(argument) for argument in arguments] or [ROOT / name for name in listed]
    problems = [
        (path, *name_problem)
        for path in paths
        if path.is_file() and path.name != Path(__file__).name
        for name_problem in forbidden_names(path)
    ]
    for path, line, name, term in problems:
        print(f"{path}:{line}: '{name}' is not a term of the field. Use: {term}.", file=sys.stderr)
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
