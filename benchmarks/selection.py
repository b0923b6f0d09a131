"""How well the selector chooses: every pick of many views measured, and what each policy takes held against the best of them.

    python benchmarks/selection.py measure DATA [--folder build/selection] [--only NAME ...] [--again]
    python benchmarks/selection.py fit DATA [--folder build/selection]

`measure` takes about half an hour on two cores; it goes on where it stopped. DATA is the folder of sample rasters. `fit` writes the
constants of the error model, `selector/error_model.json`, from what was measured.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from selection_fit import cases_of, fitted
from selection_measure import described, measured
from selection_views import instances

MODEL = Path(__file__).parents[1] / "selector" / "error_model.json"


def slug(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name)


def _rounded(value: Any) -> Any:
    """Four digits of every number."""
    return {key: _rounded(each) for key, each in value.items()} if isinstance(value, dict) else float(f"{value:.4g}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("measure", "describe", "fit"))
    parser.add_argument("data", type=Path)
    parser.add_argument("--folder", type=Path, default=Path("build/selection"))
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--again", action="store_true")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    if given.what == "fit":
        views = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(given.folder.glob("*.json"))]
        model = fitted([case for view in views if "rows" in view for case in cases_of(view)])
        rounded = {key: _rounded(value) for key, value in model.model_dump(mode="json").items()}
        MODEL.write_text(json.dumps(rounded, indent=2) + "\n", encoding="utf-8")
        return
    for instance in instances():
        path = given.folder / f"{slug(instance.name)}.{'json' if given.what == 'measure' else 'descriptor.json'}"
        if (path.exists() and not given.again) or (given.only and not any(word in instance.name for word in given.only)):
            continue
        start = time.perf_counter()
        made = (measured if given.what == "measure" else described)(instance, given.data)
        path.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
        print(f"{instance.name}: {time.perf_counter() - start:.1f} s", flush=True)


if __name__ == "__main__":
    main()
