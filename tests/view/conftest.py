"""A browser for the tests of a module."""

import pytest
from browser import Browser


@pytest.fixture(scope="module")
def browser():
    with Browser(1000, 700) as browser:
        browser.prefer(color_scheme="light", reduced_motion="reduce")
        yield browser
