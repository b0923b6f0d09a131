import importlib
import pickle
import pkgutil

import pytest

from skugga import api, selector, shadows, terrain
from skugga.api.errors import (
    ERROR_REPORTS,
    EXIT_FAILURE,
    EXIT_SUCCESS,
    EXIT_WRONG_INPUT,
    NotServedError,
    RetryLaterError,
    error_report_of,
    exit_status,
)
from skugga.api.workers.jobs import Failure
from skugga.terrain import errors
from skugga.terrain.errors import SkuggaError


def every_error() -> list[type[SkuggaError]]:
    """Return every error class that any module defines."""
    for package in (terrain, shadows, selector, api):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)
    error_classes, pending = set(), [SkuggaError]
    while pending:
        error_class = pending.pop()
        error_classes.add(error_class)
        pending += error_class.__subclasses__()
    return sorted(error_classes, key=lambda error_class: error_class.__name__)


def make_error(error_class: type[SkuggaError]) -> SkuggaError:
    """Return an error of a class, with the arguments that its constructor needs."""
    if issubclass(error_class, errors.InputError):
        return error_class("azimuth", 7, "something else")
    return error_class("x", "a message") if error_class is NotServedError else error_class("a message")


def test_the_table_has_every_error_and_no_other():
    error_classes = every_error()
    assert len(error_classes) > 10
    assert set(ERROR_REPORTS) == set(error_classes)


def test_http_statuses_agree_with_exit_statuses():
    for error_class, report in ERROR_REPORTS.items():
        assert 400 <= report.status < 600
        assert report.exit_status in (EXIT_FAILURE, EXIT_WRONG_INPUT)
        if report.status < 500:
            assert report.exit_status == EXIT_WRONG_INPUT, error_class
    assert EXIT_SUCCESS == 0


def test_error_codes_are_unique():
    # Both of these errors share the codes of their bases.
    codes = [report.code for error_class, report in ERROR_REPORTS.items() if error_class not in (NotServedError, RetryLaterError)]
    assert len(set(codes)) == len(codes)


@pytest.mark.parametrize(
    ("error_class", "status", "expected_exit_status"),
    [
        (errors.InputError, 422, 2),
        (errors.UnsupportedError, 422, 2),
        (errors.NotFoundError, 404, 2),
        (errors.LevelError, 500, 2),
        (errors.SourceError, 500, 2),
        (errors.BusyError, 503, 1),
        (errors.RenderError, 500, 1),
        (errors.RenderTimeoutError, 504, 1),
        (errors.GraphicsError, 503, 1),
    ],
)
def test_errors_have_their_documented_statuses(error_class: type[SkuggaError], status: int, expected_exit_status: int):
    error = make_error(error_class)
    assert error_report_of(error).status == status
    assert exit_status(error) == expected_exit_status


@pytest.mark.parametrize("error_class", [error_class for error_class in every_error() if error_class is not NotServedError])
def test_errors_cross_the_pipe(error_class: type[SkuggaError]):
    error = make_error(error_class)
    received = pickle.loads(pickle.dumps(Failure.from_error(error))).to_error()
    assert type(received) is error_class
    assert str(received) == str(error)
    assert getattr(received, "name", None) == getattr(error, "name", None)
