"""What the browser tests share: a report opened and settled, its texts, how much of a picture is drawn or differs."""

from __future__ import annotations

import numpy as np

HOSTILE = "</script><script>window.pwned = 1</script><img src=x onerror='window.pwned = 1'>"


def show(browser, path, still=True):
    browser.errors.clear()
    browser.requests.clear()
    browser.open(path)
    browser.wait("document.documentElement.dataset.ready === 'true'")
    if still:
        settle(browser)


def settle(browser):
    """Wait until what was asked for is on the screen."""
    browser.evaluate(
        "(async () => { while (window.report?.viewer.drawing) await report.viewer.drawing;"
        " for (let i = 0; i < 3; i++) await new Promise(requestAnimationFrame); })()"
    )


def texts(browser, selector):
    return browser.evaluate(f"[...document.querySelectorAll({selector!r})].map(node => node.textContent)")


def drawn(picture):
    """The share of the pixels that are not background."""
    return (np.abs(picture.astype(int) - picture[-2, 2].astype(int)).max(axis=2) > 24).mean()


def differ(one, other):
    """The share of the pixels that differ clearly."""
    return (np.abs(one.astype(int) - other.astype(int)).max(axis=2) > 24).mean()
