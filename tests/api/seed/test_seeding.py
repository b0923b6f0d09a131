"""Runs of ``skugga seed``: their outputs, resumption, and handling of failures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pmtiles.reader import MmapSource, Reader
from pmtiles.tile import tileid_to_zxy

from skugga.api.errors import TooCostlyError
from skugga.api.request import ProductRequest
from skugga.api.seed import planning
from skugga.api.seed.archive import ShardIndex
from skugga.api.seed.messages import TaskFailure
from skugga.api.seed.publishing import MANIFEST_NAME
from skugga.api.seed.running import shard_name
from skugga.api.seed.seeding import FAILED_TASKS_FILE_NAME
from skugga.api.seed.task_table import TaskTable
from skugga.api.workers.jobs import BlockJob, LevelKey
from skugga.api.workers.render_worker import run_job
from skugga.api.workers.worker_state import WorkerState
from skugga.shadows import render
from skugga.terrain.errors import InputError, RenderError
from skugga.terrain.level.parts import SunSpec
from tests.api.seed.pmtiles_checker import check_archive
from tests.api.seed.runs import LOW_SUN, Run, rough_ground, write_ground

ZOOMS = 11, 14


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """A run over rough ground that has not started."""
    level = write_ground(tmp_path / "dem.tif", rough_ground(120))
    return Run(level, tmp_path / "out.pmtiles", ZOOMS)


def tiles_of(archive: Path) -> dict[tuple[int, int, int], bytes]:
    """Return every tile by zoom, column and row, as the reader of the ``pmtiles`` package finds it."""
    from pmtiles.reader import all_tiles

    with archive.open("rb") as file:
        return {place: bytes(content) for place, content in all_tiles(MmapSource(file))}


def task_table_of(seed_run: Run) -> TaskTable:
    """Return the open table of a run's tasks."""
    return TaskTable(seed_run.work / "tasks.sqlite")


def test_seeded_tiles_equal_those_of_a_service(run: Run):
    run.layer = "color"
    result, drawn_tasks = run()
    assert result.written_paths == [run.output] and result.drawn_count == len(drawn_tasks) > 4
    check_archive(run.output)
    with run.output.open("rb") as file:
        header, metadata = (reader := Reader(MmapSource(file))).header(), reader.metadata()
    assert (header["min_zoom"], header["max_zoom"]) == ZOOMS
    assert metadata["skugga"] == {
        "level": "dem", "layer": "color", "format": "png", "tms": "WebMercatorQuad", "query": "azimuth=225.0&altitude=12.0",
    }  # fmt: skip
    service_tiles: dict[tuple[int, int, int], bytes] = {}
    state = WorkerState("any")
    level = LevelKey(**{**run.request.level.model_dump(), "version": "1"})
    for task in drawn_tasks:
        job = BlockJob(
            level=level, matrix_set="WebMercatorQuad", zoom=task.zoom, block_x=task.x, block_y=task.y,
            request=ProductRequest(sun=LOW_SUN),
        )  # fmt: skip
        tiles = run_job(job, state).tiles
        service_tiles |= {(task.zoom, 4 * task.x + col, 4 * task.y + row): body for (row, col), body in tiles.items()}
    archive_tiles = tiles_of(run.output)
    assert set(archive_tiles) < set(service_tiles) and all(service_tiles[place] == body for place, body in archive_tiles.items())
    assert len({body for place, body in service_tiles.items() if place not in archive_tiles}) == 1, (
        "tiles that the archive leaves out are the empty tile"
    )


def test_a_pyramid_has_the_style_of_its_request(run: Run):
    """Workers, the archive and a service agree on the style; a resumed run keeps it, and another style redraws all tiles."""
    run.layer, run.zooms, run.style = "color", (13, 13), {"style": "natural", "ramp": "0:ff0000", "slope_exaggeration": 2.0}
    _, drawn_tasks = run()
    with run.output.open("rb") as file:
        query = Reader(MmapSource(file)).metadata()["skugga"]["query"]
    assert query == "azimuth=225.0&altitude=12.0&style=natural&slope_exaggeration=2.0&ramp=0%3Aff0000"
    level = LevelKey(**{**run.request.level.model_dump(), "version": "1"})
    task, styled_tiles = drawn_tasks[0], tiles_of(run.output)
    request = ProductRequest(sun=LOW_SUN, **run.style)
    tiles = run_job(
        BlockJob(level=level, matrix_set="WebMercatorQuad", zoom=13, block_x=task.x, block_y=task.y, request=request),
        WorkerState("any"),
    ).tiles
    served_tiles = {(13, 4 * task.x + col, 4 * task.y + row): body for (row, col), body in tiles.items()}
    assert served_tiles.keys() & styled_tiles.keys()
    assert all(served_tiles[place] == body for place, body in styled_tiles.items() if place in served_tiles)
    assert run()[0].drawn_count == 0, "a resumed run draws nothing again"
    run.style = {}
    assert run()[0].drawn_count == len(drawn_tasks) and tiles_of(run.output) != styled_tiles


def test_an_unchanged_level_draws_nothing(run: Run):
    run()
    before = run.output.stat()
    result, drawn_tasks = run()
    assert (result.drawn_count, result.written_paths, drawn_tasks) == (0, [], [])
    assert run.output.stat() == before
    run.output.unlink()
    assert run()[0].written_paths == [run.output], "a deleted archive is written again from the stored tiles"


def test_the_order_of_tasks_does_not_change_the_archive(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run()
    original_waiting = TaskTable.waiting_tasks
    monkeypatch.setattr(TaskTable, "waiting_tasks", lambda table: original_waiting(table)[::-1])
    other = Run(run.level, tmp_path / "other.pmtiles", ZOOMS)
    other()
    assert other.output.read_bytes() == run.output.read_bytes()


def test_the_most_expensive_tasks_come_first(run: Run):
    with task_table_of(run) as table:
        planned = planning.plan_run(table, run.request, lambda text: None)
        expected = [
            table._db.execute("SELECT expected_s FROM tasks WHERE id = ?", (number,)).fetchone()[0]
            for number in table.waiting_tasks()
        ]
    assert planned.zooms.last == 14 and expected == sorted(expected, reverse=True) and len(set(expected)) > 3


def test_an_interrupted_run_resumes(run: Run, tmp_path: Path):
    count = 0

    def interrupt_fourth_task(task):
        nonlocal count
        count += 1
        if count == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(interrupt_fourth_task)
    assert not run.output.exists()
    result, drawn_tasks = run()
    complete_run = Run(run.level, tmp_path / "whole.pmtiles", ZOOMS)
    tasks_of_full_run = complete_run()[1]
    assert len(drawn_tasks) == len(tasks_of_full_run) - 3
    assert run.output.read_bytes() == complete_run.output.read_bytes()


def test_failed_tasks_are_listed_and_retried_on_request(run: Run):
    def fails(task):
        return TaskFailure(task.id, "a part that cannot be read", "failed") if task.zoom == 12 else None

    with pytest.raises(RenderError, match=r"of \d+ tasks failed.*--retry-failed.*a part that cannot be read"):
        run(fails)
    listed = (run.work / FAILED_TASKS_FILE_NAME).read_text(encoding="utf-8").splitlines()
    assert listed and all(line.startswith("zoom 12 block ") for line in listed)
    assert not run.output.exists()
    with pytest.raises(RenderError, match="tasks failed"):
        run()  # tasks stay failed
    result, drawn_tasks = run(retry_failed=True)
    assert {task.zoom for task in drawn_tasks} == {12} and len(drawn_tasks) == len(listed)
    assert result.written_paths == [run.output] and not (run.work / FAILED_TASKS_FILE_NAME).exists()


@pytest.mark.parametrize(("deaths", "fails"), [(2, False), (3, True)])
def test_a_task_is_retried_when_its_worker_dies(run: Run, deaths: int, fails: bool):
    left = deaths

    def dies(task):
        nonlocal left
        if task.zoom == 11 and left:
            left -= 1
            return TaskFailure(task.id, "its render process ended", "died")
        return None

    run.zooms = 11, 11
    if fails:
        with pytest.raises(RenderError, match="1 of 1 tasks failed"):
            run(dies)
    else:
        assert len(run(dies)[1]) == 1


def test_a_run_stops_when_shards_cannot_be_written(run: Run):
    def full(task):
        return TaskFailure(task.id, "/shards: No space left on device", "stopped") if task.zoom < 14 else None

    with pytest.raises(RenderError, match="No space left"):
        run(full)
    assert len(run()[1]) >= 2 and run.output.exists()


def test_more_tasks_than_allowed_are_refused(run: Run):
    with pytest.raises(InputError, match=r"--max-tasks.*--dry-run"):
        run(max_tasks=2)
    assert not (run.work / "shards").exists()
    assert run(max_tasks=1000)[0].written_paths


def test_blocks_over_the_limit_are_refused(gl, run: Run, monkeypatch: pytest.MonkeyPatch):
    """The limit is that of a service, or the caller's. Drawn tasks do not count."""
    with pytest.raises(TooCostlyError, match=r"a block of zoom \d+ by .* expected to take .* \(--max-ms\)"):
        run(max_ms=1e-4)
    monkeypatch.setenv("SKUGGA_RENDER_TIMEOUT_S", "1e-7")
    with pytest.raises(TooCostlyError, match="a block of zoom"):
        run()
    assert not (run.work / "shards").exists()
    assert run(max_ms=1e6)[0].written_paths
    assert run()[0].drawn_count == 0


def test_lost_and_broken_shards_are_redrawn(run: Run):
    run()
    archive = run.output.read_bytes()
    with task_table_of(run) as table:
        names = [shard_name(key) for _, key in table.tasks_with_shards()]
    lost_shard, broken_shard = (run.work / "shards" / name for name in names[:2])
    lost_shard.unlink()
    broken_shard.write_bytes(broken_shard.read_bytes()[:-1] + b"x")
    run.output.unlink()
    assert len(run()[1]) == 2
    assert run.output.read_bytes() == archive


def test_a_level_that_changes_during_a_run_is_an_error(run: Run, tmp_path: Path):
    drawn_before = 0

    def changes(task):
        nonlocal drawn_before
        drawn_before += 1
        if drawn_before == 3:
            write_ground(run.level, rough_ground(120, seed=4))

    with pytest.raises(RenderError, match="has changed during the run"):
        run(changes)
    assert not run.output.exists()
    run()
    fresh_run = Run(run.level, tmp_path / "fresh.pmtiles", ZOOMS)
    fresh_run()
    assert run.output.read_bytes() == fresh_run.output.read_bytes()


def test_an_output_has_the_requested_zooms(run: Run):
    tasks_of_full_run = run()[1]
    run.zooms = 12, 13
    assert run()[1] == []
    assert {place[0] for place in tiles_of(run.output)} == {12, 13}
    run.zooms = ZOOMS
    assert run()[1] == [] and len(tasks_of_full_run) > 4, "stored tiles of other zooms are kept"
    assert {place[0] for place in tiles_of(run.output)} == {11, 12, 13, 14}


def test_suns_have_an_archive_each(run: Run):
    run.suns, run.zooms = (LOW_SUN, SunSpec(azimuth=90.0, altitude=30.0)), (12, 13)
    run()
    first_tiles, second_tiles = (tiles_of(run.output_of(number)) for number in (0, 1))
    assert set(first_tiles) == set(second_tiles) and first_tiles != second_tiles
    run.suns = (*run.suns, SunSpec(azimuth=180.0, altitude=45.0))
    assert {task.sun for task in run()[1]} == {2}, "an additional sun draws only its own tiles"


@pytest.mark.parametrize("layer", ["mask", "terrain-rgb", "terrarium"])
def test_data_layers_are_written_as_png(run: Run, layer: str):
    run.layer, run.zooms = layer, (13, 13)
    run()
    tiles = tiles_of(run.output)
    assert tiles and all(body.startswith(b"\x89PNG") for body in tiles.values())
    run.layer = "shadow"
    assert len(run()[1]) > 0, "the tiles of another layer are drawn"


def test_plans_are_reused_for_changed_ground(run: Run, monkeypatch: pytest.MonkeyPatch):
    run()

    def fail(*_: object, **__: object):
        raise AssertionError("a plan was made again")

    monkeypatch.setattr(planning, "select_view_plan", fail)
    write_ground(run.level, rough_ground(120, seed=4))
    assert run()[1], "the ground has changed"
    run.zooms = 11, 15
    with pytest.raises(AssertionError, match="made again"):
        run()


def test_waiting_totals_give_reasons_for_tasks(run: Run, monkeypatch: pytest.MonkeyPatch):
    run.zooms = 11, 12

    def reasons() -> set[str]:
        with task_table_of(run) as table:
            planning.plan_run(table, run.request, lambda text: None)
            return {row[2] for row in table.waiting_totals()}

    assert reasons() == {"not drawn yet"}
    run()
    assert reasons() == set()
    ground = rough_ground(120)
    ground[50:54, 50:54] = 600.0
    write_ground(run.level, ground)
    assert reasons() == {"ground that affects the tiles has changed"}
    run()
    ground[50, 50] = 2000.0
    write_ground(run.level, ground)
    assert reasons() == {"the level's lowest or highest ground has changed"}
    run()
    run.settings = {"algorithm": "shadow_map"}
    assert reasons() == {"the level or the request has changed"}
    run()
    monkeypatch.setattr(planning, "RENDERER_VERSION", render.RENDERER_VERSION + 1)
    assert reasons() == {"the renderer has changed"}


def test_changed_metadata_redraws_nothing(run: Run, tmp_path: Path):
    level = tmp_path / "level.yaml"
    level.write_text("version: 1\ntitle: One\nterrain: {source: dem.tif}\n", encoding="utf-8")
    run.level = level
    run()
    level.write_text("# said\nversion: 1\ntitle: Other\nattribution: Me\nterrain: {source: dem.tif}\n", encoding="utf-8")
    result, drawn_tasks = run()
    assert drawn_tasks == [] and result.written_paths == [run.output], "the title is stored in the archive, not in the tiles"
    level.write_text("version: 1\nterrain: {source: dem.tif, exaggeration: 1.5}\n", encoding="utf-8")
    assert run()[1] != []


def test_a_folder_has_the_same_tiles_as_an_archive(run: Run, tmp_path: Path):
    run()
    folder = Run(run.level, tmp_path / "tiles", ZOOMS)
    folder()
    existing = {
        tuple(map(int, path.relative_to(folder.output).with_suffix("").parts)): path.read_bytes()
        for path in folder.output.rglob("*.png")
    }
    assert existing == tiles_of(run.output)
    manifest = json.loads((folder.output / MANIFEST_NAME).read_text(encoding="utf-8"))
    assert (manifest["minzoom"], manifest["maxzoom"], manifest["tiles"]) == (11, 14, ["{z}/{x}/{y}.png"])
    folder.zooms = 12, 13
    folder()
    assert {int(path.parts[-3]) for path in folder.output.rglob("*.png")} == {12, 13}


def test_a_table_for_another_renderer_is_refused(run: Run, monkeypatch: pytest.MonkeyPatch):
    run()
    monkeypatch.setattr(planning, "local_renderer", lambda: "another renderer")
    with pytest.raises(RenderError, match=r"planned for the renderer '.*another renderer.*delete"):
        run()


def test_a_table_has_one_run_at_a_time(run: Run):
    with task_table_of(run), pytest.raises(InputError, match=r"--work.*in use by process \d+.*that run"):
        run()
    run()


def test_a_broken_table_is_an_error(run: Run):
    run.work.mkdir()
    (run.work / "tasks.sqlite").write_bytes(b"no table" * 1000)
    with pytest.raises(InputError, match="--work.*Delete the folder"):
        run()


def test_zooms_beyond_the_data_are_refused(run: Run):
    run.zooms = 11, 22
    with pytest.raises(InputError, match=r"--zooms: '11-22'.*zooms 0 to 1\d"):
        run()


def test_tiles_of_a_task_are_one_range_of_ids(run: Run):
    _, drawn_tasks = run()
    with task_table_of(run) as table:
        (name,) = {row[0] for row in table._db.execute("SELECT sun FROM tasks")}
        ranges = [ShardIndex.from_bytes(tiles).ids for _, _, tiles in table.finished_tasks(name)]
    for before, after in zip(ranges, ranges[1:], strict=False):
        assert before.size == 0 or after.size == 0 or before[-1] < after[0]
    assert all(ids.size == 0 or ids[-1] - ids[0] < 16 for ids in ranges)
    assert {tileid_to_zxy(int(ids[0]))[0] for ids in ranges if ids.size} == {11, 12, 13, 14}
