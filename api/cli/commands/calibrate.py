"""``skugga calibrate``."""

from __future__ import annotations

import typer

from skugga.api.cli.common_options import JsonOption
from skugga.api.cli.progress import ProgressBar


def calibrate(as_json: JsonOption = False) -> None:
    """Calibrate this device for the policy `predict`."""
    from skugga.api.device_calibration import format_calibration
    from skugga.selector.cost.calibration import calibrate as measure
    from skugga.selector.cost.device_profile import check_profile_file, save_profile
    from skugga.terrain.gl.device import device

    gl = device()
    check_profile_file(gl.renderer, gl.version)
    with ProgressBar("Calibrating") as advance:
        profile = measure(advance)
    path = save_profile(profile)
    typer.echo(profile.model_dump_json(indent=2) if as_json else format_calibration(profile, path))
