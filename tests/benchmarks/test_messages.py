"""The list of messages, and the form that all messages have."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.messages import Message, messages, messages_of

SOURCE = """
raise InputError("size", size, f"at most {MAX} pixels")
raise InputError(name, Problem(f"{kind} cannot be read"), "Give a raster")
raise LevelError.conflict("path", other)
warnings.warn(f"{path}: no nodata", SkuggaWarning)
log.info("ready")
print("no message")
"""

PATH = Path("some.py")


def test_messages_of_a_module_are_listed_by_kind():
    assert list(messages_of(SOURCE, PATH)) == [
        Message("InputError", PATH, 2, ("size", "{size}", "at most {MAX} pixels")),
        Message("InputError", PATH, 3, ("{name}", "{kind} cannot be read", "Give a raster")),
        Message("LevelError.conflict", PATH, 4, ("path", "{other}")),
        Message("warning", PATH, 5, ("{path}: no nodata", "{SkuggaWarning}")),
        Message("log", PATH, 6, ("ready",)),
    ]


def form_problems(message: Message) -> list[str]:
    """Return what is wrong with a message by its text alone."""
    last, result = message.texts[-1], []
    if any(word in text for text in message.texts for word in ("; allowed:", "; needed:")):
        result.append("the old form")
    if message.kind == "InputError" and last.startswith(("nothing", "no --")):
        result.append("a conflict with a phrase of allowed values: use InputError.conflict")
    if message.kind in ("InputError", "SourceError", "LevelError") and last.endswith("."):
        result.append("a full stop, which the error adds")
    if message.kind in ("InputError", "SourceError", "LevelError") and "\n" in "".join(message.texts):
        result.append("more than one line")
    return result


@pytest.mark.parametrize(
    "texts", [("--view", "{view}", "nothing beside --path"), ("size", "{size}; allowed: 3", "3"), ("size", "{n}", "At most 3.")]
)
def test_a_message_of_the_wrong_form_is_found(texts):
    assert form_problems(Message("InputError", PATH, 1, texts))


def test_all_messages_have_the_form():
    listed = messages()
    assert len(listed) > 500
    assert not [
        f"{message.path}:{message.line}: {message.texts}: {fault}" for message in listed for fault in form_problems(message)
    ]
