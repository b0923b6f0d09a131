"""Reconstruction of the running command line, for messages that suggest a variant of it."""

from __future__ import annotations

import shlex

import typer


def command_line_without(context: typer.Context, *omitted_parameters: str) -> str:
    """Return the running command line as shell text, without the options ``omitted_parameters`` (parameter names)."""
    words = ["skugga", context.info_name or ""]
    for parameter in context.command.params:
        name, value = parameter.name or "", context.params.get(parameter.name or "")
        if name in omitted_parameters or value is None or value is False or value == parameter.default:
            continue
        values = value if isinstance(value, (list, tuple)) else [value]
        if parameter.param_type_name == "argument":
            words += map(_shell_word, values)
        elif value is True:
            words.append(parameter.opts[0])
        else:
            words += (word for item in values for word in (parameter.opts[-1], _shell_word(item)))
    return shlex.join(words)


def _shell_word(value: object) -> str:
    """Return a value as a user types it: 246 instead of 246.0."""
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)
