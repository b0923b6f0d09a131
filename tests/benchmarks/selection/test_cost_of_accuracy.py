"""Cost of accuracy, computed by hand for made-up views, and agreement of the pages with the table in the repository."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.selection.cost_of_accuracy import MARK, cheapest_ms, figure_svg, prices, replace_part, sentence, table

ROOT = Path(__file__).parents[3]


def view(family: str, *rows: tuple[float, float], interior: float = 0.0) -> dict:
    """Return a view whose rows are (milliseconds, share of the cast shadow that is wrong)."""
    row_by_name = {
        f"row {n}": {"ms": ms, "wrong_cast": wrong_cast, "interior": interior} for n, (ms, wrong_cast) in enumerate(rows)
    }
    return {"name": family, "family": family, "error": "wrong_cast", "noise_floor": 0.0, "rows": row_by_name}


def test_the_cheapest_plan_is_the_fastest_that_meets_the_goal():
    assert cheapest_ms(view("a", (10.0, 0.09), (20.0, 0.02), (15.0, 0.05), (40.0, 0.001))) == {
        "10 %": 10.0, "3 %": 20.0, "1 %": 40.0, "0.3 %": 40.0,
    }  # fmt: skip


def test_unreachable_goals_have_no_price():
    views = [view("a", (10.0, 0.09), (20.0, 0.002)), view("a", (10.0, 0.09), (20.0, 0.05)), view("a", (5.0, 0.2), (6.0, 0.3))]
    finest = prices(views)[-1]
    assert finest.ratios.tolist() == [2.0]
    assert finest.views == 3


def test_prices_respect_interior_errors_and_noise_of_truth():
    assert cheapest_ms(view("a", (10.0, 0.0), (20.0, 0.0), interior=0.01)) == {}
    noisy = view("a", (10.0, 0.008), (20.0, 0.002)) | {"noise_floor": 0.003}
    assert cheapest_ms(noisy) == dict.fromkeys(("10 %", "3 %", "1 %"), 10.0), "0.3 % is within the noise of the reference"


def test_sentence_and_table_have_median_and_90th_percentile():
    views = [view("a", (10.0, 0.09), (10.0 * ratio, 0.001)) for ratio in range(1, 12)]
    finest = prices(views)[-1]
    assert (finest.median, finest.p90) == (6.0, 10.0)
    assert "take 6.0 times as long" in sentence(views)
    assert "more than 10.0 times in one view of ten (11 of 11" in sentence(views)
    assert table(views).splitlines()[-1].endswith("| 6.00, 10.00 (11) |")


def test_only_the_part_between_the_marks_is_replaced():
    text = f"a\n<!-- {MARK} -->\nold\n<!-- end of {MARK} -->\nb\n"
    assert replace_part(text, "new\n") == text.replace("old", "new")
    with pytest.raises(ValueError, match="the page has no"):
        replace_part("a", "new\n")


def test_the_figure_is_reproducible_with_a_point_per_view():
    views = [view(family, (10.0, 0.09), (10.0 * ratio, 0.001)) for ratio in (1, 2, 3) for family in ("a", "b")]
    svg = figure_svg(views)
    assert svg == figure_svg(views)
    assert svg.count("<use") - figure_svg(views[:-1]).count("<use") == 2 * 3, "in its family and in all, for three goals"


def test_pages_agree_with_the_table(stored_table):
    """``python -m benchmarks.selection judge --write`` updates them."""
    views, _ = stored_table
    text = " ".join(sentence(views).split())
    for name in ("README.md", "docs/accuracy.md"):
        assert text in " ".join((ROOT / name).read_text(encoding="utf-8").split()), name
    assert table(views) in (ROOT / "docs/accuracy.md").read_text(encoding="utf-8")
    assert np.isfinite(prices(views)[-1].median)
