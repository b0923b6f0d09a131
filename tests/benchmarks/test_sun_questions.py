"""The benchmark of sun questions: sun positions of other tools, exact horizons, and verdicts."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.sun_questions.figures import SunAnswer, SunComparison, tool_standings
from benchmarks.sun_questions.many_masks import MASK_COUNT, mask_times, wrong_share
from benchmarks.sun_questions.one_horizon import exact_horizon, triangle_heights_m
from benchmarks.sun_questions.page import answer_table, format_verdict
from benchmarks.sun_questions.sun_paths import hours_before_cliff, r_sun_path, suncalc_path
from skugga.terrain.geo.sun_path import sun_path


def make_answer(tool: str, is_skugga: bool, seconds: float, error: float, question: str = "hours of a day") -> SunAnswer:
    """Return a tool's answer with seconds of computing and an error."""
    return SunAnswer(question, "somewhere", tool, is_skugga, seconds, seconds + 1.0, seconds, error, error, error)


def make_comparison(*answers: SunAnswer) -> SunComparison:
    """Return results with these answers and nothing else."""
    return SunComparison("here", 1.0, 60.0, {}, {}, [], [], list(answers))


def test_suncalc_is_close_to_the_sun_of_its_date():
    """The reference is NREL's sun at the same moments, without refraction. suncalc uses the equinox of 2000 and is up to
    0.2 degrees off.
    """
    azimuth, altitude = suncalc_path(9.0, 46.95, 600.0)
    noon = np.datetime64("2020-03-21T11:24:00")
    times = noon + np.round(np.arange(-43200.0 + 300.0, 43200.0, 600.0)).astype("timedelta64[s]")
    path = sun_path(times, 9.0, 46.95)
    assert np.abs(altitude - (path.altitude_deg - path.refraction_deg)).max() < 0.25
    assert np.abs((azimuth - path.azimuth_deg + 180.0) % 360.0 - 180.0).max() < 0.3


def test_suncalc_gives_whitebox_s_share_on_level_ground():
    """The expected share is from Whitebox Workflows 2.0.6 at 9 degrees east, 46.9535 north, with azimuth bins of 2 degrees.
    A bin is lit if the sun is above the horizon at its centre.
    """
    azimuth, altitude = suncalc_path(9.0, 46.95353, 10.0)
    number = np.rint(azimuth / 2.0)
    sample_count = night_count = 0
    for bin_number in np.unique(number):
        inside = np.flatnonzero(number == bin_number)
        up = int((altitude[inside] >= -0.5).sum())
        middle = inside[np.argmin(np.abs(azimuth[inside] - 2.0 * bin_number))]
        sample_count, night_count = sample_count + up, night_count + (up if altitude[middle] < 0.0 else 0)
    assert 1.0 - night_count / sample_count == pytest.approx(12.126666 / 12.15, abs=2e-4)


def test_the_sun_of_r_sun_culminates_in_the_south_at_noon():
    azimuth, altitude = r_sun_path(46.95, 60.0)
    highest = int(np.argmax(altitude))
    assert altitude[highest] == pytest.approx(90.0 - 46.95 + np.degrees(0.004235), abs=1e-3)  # r.sun's declination of day 80
    assert azimuth[highest] == pytest.approx(180.0, abs=0.3)
    assert np.allclose(altitude, altitude[::-1])
    assert azimuth[len(azimuth) // 4] == pytest.approx(90.0, abs=1.0)


def test_a_cliff_in_the_east_shades_the_morning():
    azimuth, altitude = np.array([90.0, 90.0, 180.0, 270.0]), np.array([10.0, 46.0, 30.0, 1.0])
    hours = hours_before_cliff(azimuth, altitude, 3600.0, 300.0, np.array([300.0, 1e9]))
    assert hours.tolist() == [3.0, 4.0]  # the first hour is below the edge, at 45 degrees


def test_a_surface_is_linear_on_its_triangles():
    height_m = np.array([[0.0, 1.0], [1.0, 4.0]])  # cut along the higher diagonal, from the corner of 0 to that of 4
    assert triangle_heights_m(height_m, np.array([0.5, 0.25]), np.array([0.5, 0.75])).tolist() == [2.0, 0.75 + 0.25 * 3.0]
    height_m = np.array([[0.0, 1.0], [1.0, 1.0]])
    assert triangle_heights_m(height_m, np.array([0.5]), np.array([0.5])).tolist() == [1.0]


def test_the_horizon_of_a_ridge_is_at_its_crest():
    """The crest runs along a column. Towards an azimuth between two cells its distance grows by the secant."""
    height_m = np.zeros((41, 41))
    height_m[:, 30] = 50.0
    for angle in (0.0, 0.3, 0.5):
        horizon_deg = exact_horizon(height_m, 20, 10, np.cos(angle), np.sin(angle), 10.0)
        assert horizon_deg == pytest.approx(np.degrees(np.arctan(50.0 * np.cos(angle) / 200.0)))


def test_the_horizon_interpolates_along_crossed_edges():
    """The ray from column 1 to row 2.5, column 3 crosses the diagonal that descends from the peak at six tenths of a
    column. Its height there is six tenths of the peak's.
    """
    height_m = np.zeros((5, 5))
    height_m[2, 3] = 8.0
    direction = np.array([2.0, 0.5]) / np.hypot(2.0, 0.5)
    horizon_deg = exact_horizon(height_m, 2, 1, direction[0], direction[1], 1.0)
    assert horizon_deg == pytest.approx(np.degrees(np.arctan(4.8 / np.hypot(1.6, 0.4))))


def test_earth_curvature_lowers_far_ground():
    height_m = np.zeros((3, 2001))
    horizon_deg = exact_horizon(height_m, 1, 0, 1.0, 0.0, 10.0, radius_m=6_371_000.0)
    assert horizon_deg == pytest.approx(np.degrees(-10.0 / 2 / 6_371_000.0), rel=1e-3)  # the nearest ground is the highest
    height_m[1, 2000] = 100.0
    horizon_deg = exact_horizon(height_m, 1, 0, 1.0, 0.0, 10.0, radius_m=6_371_000.0)
    assert np.tan(np.radians(horizon_deg)) == pytest.approx((100.0 - 20_000.0**2 / 2 / 6_371_000.0) / 20_000.0, rel=1e-3)


def test_times_of_masks_are_centred_on_noon():
    times = mask_times(-117.0)
    assert len(times) == MASK_COUNT
    assert times[MASK_COUNT // 2].isoformat() == "2024-03-21T19:48:00+00:00"


def test_uncertain_points_do_not_count():
    lit, truth, sure = np.array([1, 1, 0, 0], bool), np.array([1, 0, 0, 1], bool), np.array([1, 1, 1, 0], bool)
    assert wrong_share(lit, truth, sure) == pytest.approx(1 / 3)


def test_the_verdict_names_dominated_rows_and_a_lost_front():
    our_answer, peer_answer = make_answer("own", True, 2.0, 1.0), make_answer("peer", False, 1.0, 0.5)
    verdict = format_verdict(make_comparison(our_answer, peer_answer), "hours of a day")
    assert "own by peer (somewhere)" in verdict and "peer beats every row (somewhere)" in verdict
    assert "More accurate than Skugga's best row: peer in 1 of 1 cases, up to 2 times." in verdict
    assert "Faster by computing than Skugga's best row: peer in 1 of 1 cases, up to 2 times." in verdict
    saved = format_verdict(make_comparison(our_answer, make_answer("exact", True, 9.0, 0.1), peer_answer), "hours of a day")
    assert "No peer beats all of its rows" in saved
    assert "More accurate than Skugga's best row: no peer" in saved


def test_a_peer_that_is_only_faster_is_named():
    verdict = format_verdict(
        make_comparison(make_answer("own", True, 2.0, 0.1), make_answer("quick", False, 1.0, 0.5)), "hours of a day"
    )
    assert verdict.count("no peer is both faster and more accurate") == 3
    assert "Faster by the whole process than Skugga's best row: quick in 1 of 1 cases, up to 1.5 times." in verdict


def test_tools_without_times_or_errors_have_no_rank():
    untimed = SunAnswer("masks", "somewhere", "bound", False, None, 1.0, None, 0.1, None)
    silent = SunAnswer("masks", "somewhere", "casts none", False, None, 1.0, 1.0, None, None)
    sun_comparison = make_comparison(untimed, silent, make_answer("own", True, 1.0, 0.2, "masks"))
    assert [place.tool.name for place in tool_standings(sun_comparison, "masks", "the whole process")["somewhere"]] == [
        "bound",
        "own",
    ]
    assert [place.tool.name for place in tool_standings(sun_comparison, "masks", "computing")["somewhere"]] == ["own"]


def test_multiplied_seconds_are_marked():
    scaled = SunAnswer("horizon at a point", "somewhere", "slow", False, 3.0, 3.0, 3.0, 0.25, 1.0, 0.25, scaled=True)
    assert "| ~ 3.0 |" in "\n".join(answer_table(make_comparison(scaled), "horizon at a point"))
