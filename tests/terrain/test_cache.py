"""Caches: size limits, keys, lifetimes, and a check that modules use no other kind of cache."""

from __future__ import annotations

import ast
import gc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.terrain.cache import MISSING, Cache, cached, caches, clear_caches, clear_scene_caches, estimated_bytes

ROOT = Path(__file__).resolve().parents[2]


class FakeElevation:
    """A stand-in for an elevation, compared by identity like scenes and their parts."""


class FakeObject:
    """An object with an elevation."""

    def __init__(self, elevation: FakeElevation) -> None:
        self.elevation = elevation


def test_most_recently_used_values_stay_within_the_limit():
    cache: Cache[bytes] = Cache("test", "process", 30, len)
    for number in range(3):
        cache.put(number, value=bytes(10))
    assert cache.get(0) == bytes(10)
    cache.put(3, value=bytes(10))
    assert [cache.get(number) is not MISSING for number in range(4)] == [True, False, True, True]
    assert (cache.nbytes, len(cache)) == (30, 3)
    cache.put(4, value=bytes(31))
    assert cache.get(4) is MISSING, "larger than the limit: handed through"
    cache.put(0, value=bytes(1))
    assert cache.nbytes == 21, "the same key again replaces its value"
    cache.clear()
    assert (cache.nbytes, len(cache)) == (0, 0)


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 40)), max_size=30), st.integers(1, 60))
def test_byte_count_is_the_sum_of_all_values(puts, limit):
    cache: Cache[bytes] = Cache("test", "process", limit, len)
    for key, size in puts:
        cache.put(key, value=bytes(size))
        assert cache.nbytes == sum(map(len, cache.values)) <= limit


def test_several_keys_are_looked_up_as_single_ones_are():
    owner, other = FakeElevation(), FakeElevation()
    cache = Cache[int]("test several", "process", 100, size_of=lambda _: 1, max_entries=3)
    for number in range(3):
        cache.put(owner, 7, number, value=number)
    assert cache.get_several((owner,), [(7, 2), (7, 5), (7, 0)]) == [2, MISSING, 0]
    assert cache.get_several((other,), [(7, 2)]) == [MISSING]
    cache.put(owner, 7, 3, value=3)  # evicts the entry that was not looked up
    assert cache.get_several((owner,), [(7, 0), (7, 1), (7, 2)]) == [0, MISSING, 2]


def test_evicted_values_are_released_except_the_newest():
    released: list[str] = []
    cache: Cache[str] = Cache("test", "process", 5, len, released.append, max_entries=2)
    for word in ("ab", "cd", "e", "longer than that"):
        cache.put(word, value=word)
    assert released == ["ab", "cd", "e"] and cache.values == ["longer than that"]
    cache.drop("longer than that")
    assert released[-1] == "longer than that"


def test_value_is_dropped_with_its_arguments():
    @cached("scene", 1000)
    def double(ground: FakeElevation, row: np.ndarray, factor: int) -> np.ndarray:
        return factor * row

    ground, row = FakeElevation(), np.arange(4)
    first = double(ground, row, 2)
    assert double(ground, row, 2) is first and double(ground, row, 3) is not first
    assert double(ground, row.copy(), 2) is not first, "arrays go by identity; the copy is gone already"
    assert len(double.cache) == 2 and double.cache.nbytes == 2 * first.nbytes
    del row
    assert len(double.cache) == 0 == double.cache.nbytes


def test_value_may_be_none_and_arguments_may_be_named():
    calls = []

    @cached("process", 1000)
    def return_none(number: int, word: str = "") -> None:
        calls.append((number, word))

    for _ in range(2):
        assert return_none(1) is None and return_none(1, word="a") is None
    assert calls == [(1, ""), (1, "a")]


def test_equal_custom_keys_share_a_value():
    @cached("process", 1000, key=lambda number: (number % 2,))
    def parity(number: int) -> str:
        return f"like {number}"

    assert [parity(number) for number in (1, 2, 3, 4)] == ["like 1", "like 2", "like 1", "like 2"]


def test_clear_caches_by_lifetime_or_scene():
    light_cache, scene_cache, process_cache = (
        Cache(f"test {lifetime}", lifetime, 1000) for lifetime in ("light", "scene", "process")
    )
    elevation, other_elevation = FakeElevation(), FakeElevation()
    all_caches = light_cache, scene_cache, process_cache
    objects = [FakeObject(elevation), FakeObject(other_elevation)]

    def fill() -> None:
        for cache in all_caches:
            for part in (elevation, other_elevation, *objects):
                cache.put(part, "something", value=1.0)

    fill()
    clear_scene_caches(elevation)
    assert [len(cache) for cache in all_caches] == [2, 2, 4]
    fill()
    clear_caches("light")
    assert [len(cache) for cache in all_caches] == [0, 4, 4]
    clear_caches("light", "scene")
    assert [len(cache) for cache in all_caches] == [0, 0, 4]


def test_caches_are_listed_by_name_while_they_live():
    cache: Cache[int] = Cache("a test's own", "light", 1)
    assert cache in caches("light") and cache in caches() and cache not in caches("scene", "process")
    assert [listed.name for listed in caches()] == sorted(listed.name for listed in caches())
    del cache
    gc.collect()
    assert "a test's own" not in [listed.name for listed in caches()]


def test_bytes_of_counts_nested_values_once():
    array = np.zeros(1000)
    assert estimated_bytes(array) == 8000
    assert 8000 < estimated_bytes((array, array)) < 8200, "the same array counts once"
    assert 16000 < estimated_bytes({"a": [array], "b": np.zeros(1000)}) < 16800
    assert estimated_bytes(None) == 0


def own_cache_names(source: str) -> list[str]:
    """Return the names that a module uses for caches of its own."""
    cache_names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module in ("functools", "cachetools"):
            cache_names += [
                alias.name for alias in node.names if alias.name in ("lru_cache", "cache") or node.module == "cachetools"
            ]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "functools":
            cache_names += [node.attr] if node.attr in ("lru_cache", "cache") else []
        elif isinstance(node, ast.Name) and node.id in ("OrderedDict", "WeakKeyDictionary", "WeakValueDictionary"):
            cache_names.append(node.id)
    for node in ast.parse(source).body:  # a dictionary of the module that is filled at run time
        if isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(node.value, ast.Dict) and not node.value.keys:
            cache_names.append("a dictionary")
    return cache_names


MODULES_WITH_QUEUES = {"api/workers/pool.py"}
"""Modules with an ordered dictionary of pending jobs, which does not cache results."""


def test_no_module_has_a_cache_of_its_own():
    for floor in ("terrain", "shadows", "selector", "api"):
        for path in sorted((ROOT / floor).rglob("*.py")):
            name = str(path.relative_to(ROOT))
            if name != "terrain/cache.py" and name not in MODULES_WITH_QUEUES:
                assert own_cache_names(path.read_text(encoding="utf-8")) == [], name


@pytest.mark.parametrize(
    "source",
    [
        "from functools import lru_cache", "from functools import cache", "import functools\n@functools.lru_cache\ndef f(): ...",
        "from cachetools import TTLCache", "_kept: dict[str, int] = {}", "import collections\n_kept = OrderedDict()",
    ],
)  # fmt: skip
def test_other_kinds_of_caches_are_detected(source):
    assert own_cache_names(source)


def test_bytes_outside_of_python_are_counted():
    """Files in memory, PROJ transformations and Embree trees."""
    from skugga.terrain.casters.rays import TRIANGLE_BYTES, RayScene
    from skugga.terrain.geo.world import LONGITUDE_LATITUDE, transformer
    from skugga.terrain.level.bundled import BUNDLED

    file = BUNDLED["jacksboro"]()
    byte_counts = {cache.name: cache.nbytes for cache in caches("process")}
    assert byte_counts["skugga.terrain.level.bundled._jacksboro"] == len(file) > 100_000
    transformer(LONGITUDE_LATITUDE, LONGITUDE_LATITUDE)
    assert transformer.cache.nbytes >= 2**16
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert RayScene(meshes=[(corners, np.array([[0, 1, 2]]))]).nbytes >= TRIANGLE_BYTES
