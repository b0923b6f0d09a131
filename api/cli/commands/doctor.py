"""``skugga doctor``."""

from __future__ import annotations

import json

import typer

from skugga.api.cli.common_options import JsonOption


def doctor(as_json: JsonOption = False) -> None:
    """Check OpenGL and packages on this machine, and name what is missing."""
    from skugga.api.cli.doctor import run_checks

    findings = run_checks()
    if as_json:
        typer.echo(json.dumps([finding.__dict__ for finding in findings], indent=2))
    else:
        for finding in findings:
            typer.echo(f"{'ok     ' if finding.ok else 'MISSING'}  {finding.subject}: {finding.detail}")
    if not all(finding.ok for finding in findings):
        raise typer.Exit(1)
