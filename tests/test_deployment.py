"""Files of ``examples/deployment``: everything that they name exists. ``tests/clients`` runs nginx with its configuration."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from skugga.api.cli.graphics_card import NVIDIA_VENDOR, NVIDIA_VENDOR_FILE, CardPlaces
from skugga.api.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
DEPLOYMENT = ROOT / "examples" / "deployment"
DEPLOYMENT_FILES = sorted(path for path in DEPLOYMENT.iterdir() if path.is_file())


@pytest.mark.parametrize("path", DEPLOYMENT_FILES, ids=lambda path: path.name)
def test_deployment_files_use_existing_settings(path: Path):
    names = {f"SKUGGA_{name.upper()}" for name in Settings.model_fields}
    assert set(re.findall(r"SKUGGA_[A-Z_]*[A-Z]", path.read_text(encoding="utf-8"))) <= names


def test_all_files_are_listed():
    listed = re.findall(r"\| \[[^]]*\]\((.*?)\)", (DEPLOYMENT / "README.md").read_text(encoding="utf-8"))
    assert sorted(listed) == [path.name for path in DEPLOYMENT_FILES if path.name != "README.md"]


def test_sources_of_images_exist_and_are_in_the_build_context():
    context_paths = {line[1:] for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines() if line.startswith("!")}
    copied_paths = set()
    for line in (DEPLOYMENT / "Dockerfile").read_text(encoding="utf-8").splitlines():
        if line.startswith("COPY ") and "--from=" not in line:
            copied_paths.update(line.split()[1:-1])
    assert copied_paths <= context_paths and all((ROOT / name).exists() for name in context_paths)
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")} - {"benchmarks", "tests"}
    assert packages <= copied_paths, "the image must contain every package"


def test_containers_have_restricted_privileges():
    services = YAML(typ="safe").load((DEPLOYMENT / "compose.yaml").read_text(encoding="utf-8"))["services"]
    for name, service in services.items():
        assert service["read_only"] and service["cap_drop"] == ["ALL"] and "no-new-privileges:true" in service["security_opt"], name
        assert service["mem_limit"] and service["cpus"] and service["pids_limit"], name
    assert "ports" not in services["service"] and "outside" not in services["service"]["networks"], "only nginx publishes ports"
    dockerfile = (DEPLOYMENT / "Dockerfile").read_text(encoding="utf-8")
    for target in re.split(r"^FROM ", dockerfile, flags=re.MULTILINE)[1:]:
        if "CMD" in target:
            assert re.search(r"^USER (?!root)", target, re.MULTILINE), target.splitlines()[0]


def test_the_image_has_what_a_card_of_nvidia_needs():
    dockerfile = (DEPLOYMENT / "Dockerfile").read_text(encoding="utf-8")
    (service,) = (stage for stage in re.split(r"^FROM ", dockerfile, flags=re.MULTILINE) if stage.startswith("python AS service"))
    packages = re.search(r"apt-get install -y --no-install-recommends (.*) \\\n", service)
    assert packages and {"libegl1", "libgl1", "libxext6"} <= set(packages[1].split())
    vendor_file = re.search(r"echo '(.*)' \\\n *> (\S+)", service)
    assert vendor_file and json.loads(vendor_file[1]) == NVIDIA_VENDOR
    path = Path(vendor_file[2])
    assert path.name == NVIDIA_VENDOR_FILE and path.parent in CardPlaces().vendor_folders
    capabilities = re.search(r"NVIDIA_DRIVER_CAPABILITIES=(\S+)", service)
    assert capabilities and "graphics" in capabilities[1].split(",")


def test_nginx_waits_longer_than_a_picture_may_take():
    """A picture may wait for its level and for its turn, and may be drawn twice."""
    settings = Settings.model_construct()
    longest_s = settings.level_timeout_s + settings.queue_timeout_s + 2 * settings.render_timeout_s
    text = (DEPLOYMENT / "nginx.conf").read_text(encoding="utf-8")
    for name in ("proxy_read_timeout", "proxy_cache_lock_age", "proxy_cache_lock_timeout"):
        (waits_s,) = re.findall(rf"{name} (\d+)s;", text)
        assert int(waits_s) > longest_s, name
