"""Write the JSON schemas of plans and descriptors into ``docs/``. The service and ``skugga select --json`` use these models."""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import BaseModel

from skugga.shadows.plan import Plan
from skugga.terrain.facts.descriptor import Descriptor

DOCS_FOLDER = Path(__file__).resolve().parents[1] / "docs"
MODEL_BY_SCHEMA_FILE: dict[str, type[BaseModel]] = {"plan.schema.json": Plan, "descriptor.schema.json": Descriptor}


def schema_text(model: type[BaseModel]) -> str:
    """Return the text of a model's JSON schema file."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **model.model_json_schema()}
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    for name, model in MODEL_BY_SCHEMA_FILE.items():
        (DOCS_FOLDER / name).write_text(schema_text(model), encoding="utf-8")
