"""Cost of accuracy, computed by hand for made-up views, and agreement of the pages with the table in the repository."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.selection.cost_of_accuracy import (
    MARK_NAME,
    cheapest_rows,
    device_name,
    figure_svg,
    finest_price,
    format_sentence,
    format_table,
    prices,
    replace_between_marks,
)

ROOT = Path(__file__).parents[3]


def view(family: str, *rows: tuple[float, float], interior: float = 0.0) -> dict:
    """Return a view whose rows are (milliseconds, share of the cast shadow that is wrong)."""
    row_by_name = {
        f"row {n}": {"ms": ms, "wrong_cast": wrong_cast, "interior": interior} for n, (ms, wrong_cast) in enumerate(rows)
    }
    return {"name": family, "family": family, "error": "wrong_cast", "noise_floor": 0.0, "rows": row_by_name}


def test_the_cheapest_plan_is_the_fastest_that_meets_the_goal():
    assert cheapest_rows(view("a", (10.0, 0.09), (20.0, 0.02), (15.0, 0.05), (40.0, 0.001))) == {
        "10 %": ("row 0", 10.0), "3 %": ("row 1", 20.0), "1 %": ("row 3", 40.0), "0.3 %": ("row 3", 40.0),
    }  # fmt: skip


def test_unreachable_goals_have_no_price():
    views = [view("a", (10.0, 0.09), (20.0, 0.002)), view("a", (10.0, 0.09), (20.0, 0.05)), view("a", (5.0, 0.2), (6.0, 0.3))]
    finest = prices(views)[-1]
    assert finest.ratios.tolist() == [2.0]
    assert finest.view_count == 3


def test_prices_respect_interior_errors_and_noise_of_truth():
    assert cheapest_rows(view("a", (10.0, 0.0), (20.0, 0.0), interior=0.01)) == {}
    noisy = view("a", (10.0, 0.008), (20.0, 0.002)) | {"noise_floor": 0.003}
    assert cheapest_rows(noisy) == dict.fromkeys(("10 %", "3 %", "1 %"), ("row 0", 10.0)), (
        "0.3 % is within the noise of the reference"
    )


def test_views_with_the_same_plan_for_both_goals_have_no_price():
    """Such views are counted, but the median of the prices omits them."""
    views = [view("a", (10.0, 0.001), (20.0, 0.0))] * 3 + [view("a", (10.0, 0.09), (40.0, 0.001)), view("a", (5.0, 0.2))]
    finest = prices(views)[-1]
    assert (finest.ratios.tolist(), finest.same_plan_views, finest.omitted_views, finest.view_count) == ([4.0], 3, 1, 5)
    text = format_sentence(views, "a device")
    assert "in 3 of 5 measured views nothing" in text and "In 1 views it has a price" in text
    assert "The other 1 are left out" in text and "no plan reaches 3 % (a: 1)" in text


def test_the_sentence_takes_each_view_at_the_finest_goal_that_it_can_be_judged_by():
    """A view with noisy truth counts at 3 %, one without a plan for 0.3 % at 1 %, and one that is too noisy for 3 % not at all."""
    noisy = view("wood", (10.0, 0.09), (30.0, 0.001)) | {"noise_floor": 0.009}
    coarse = view("plain", (10.0, 0.09), (20.0, 0.008))
    too_noisy = view("wood", (10.0, 0.09), (90.0, 0.001)) | {"noise_floor": 0.02}
    price = finest_price([noisy, coarse, too_noisy])
    assert price.ratios.tolist() == [2.0, 3.0]
    assert price.views_by_goal == {"0.3 %": 0, "1 %": 1, "3 %": 1}
    assert (price.same_plan_views, price.omitted_views) == (0, 1)
    assert "(1 % in 1, 3 % in 1 views)" in format_sentence([noisy, coarse, too_noisy], "a device")


def test_sentence_and_table_have_median_and_90th_percentile():
    views = [view("a", (10.0, 0.09), (10.0 * ratio, 0.001)) for ratio in range(2, 13)]
    finest = prices(views)[-1]
    assert (finest.median, finest.p90) == (7.0, 11.0)
    text = format_sentence(views, "a device on 2 cores")
    assert "take 7.0 times as long" in text and "more than 11.0 times in one view of ten" in text
    assert "where it has a price: a: 7.0; a device on 2 cores" in text
    assert format_table(views).splitlines()[-1].endswith("| 7.00, 11.00 (11), 0 |")


def test_only_the_part_between_the_marks_is_replaced():
    text = f"a\n<!-- {MARK_NAME} -->\nold\n<!-- end of {MARK_NAME} -->\nb\n"
    assert replace_between_marks(text, "new\n") == text.replace("old", "new")
    with pytest.raises(ValueError, match="the page has no"):
        replace_between_marks("a", "new\n")


def test_the_figure_is_reproducible_with_a_point_per_view():
    views = [view(family, (10.0, 0.09), (10.0 * ratio, 0.001)) for ratio in (2, 3, 4) for family in ("a", "b")]
    svg = figure_svg(views)
    assert svg == figure_svg(views)
    assert svg.count("<use") - figure_svg(views[:-1]).count("<use") == 2 * 3, (
        "each view has one point in the plot of its family and one in the plot of all views, for each of three goals"
    )


def test_pages_agree_with_the_table(stored_table):
    """``python -m benchmarks.selection judge --write`` updates them."""
    views, profile = stored_table
    text = " ".join(format_sentence(views, device_name(profile)).split())
    for name in ("README.md", "docs/accuracy.md"):
        assert text in " ".join((ROOT / name).read_text(encoding="utf-8").split()), name
    assert format_table(views) in (ROOT / "docs/accuracy.md").read_text(encoding="utf-8")
    assert np.isfinite(prices(views)[-1].median)
