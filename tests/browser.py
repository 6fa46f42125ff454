"""A headless Chromium for the tests of pages: the machine's own, because test runs download nothing."""

import contextlib
import os
import shutil

import cv2
import numpy as np
import pytest

#: Names of Chromium on the machines of Linux distributions, and of Chrome.
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
#: WebGL by software: machines that test have no graphics card.
ARGUMENTS = [
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--no-sandbox",  # root, in containers
]


@contextlib.contextmanager
def open_browser(arguments=ARGUMENTS):
    """A browser of Playwright; without Chromium the test fails, or is skipped if PSOTRACK_NO_BROWSER is 1."""
    path = next((found for name in NAMES if (found := shutil.which(name))), None)
    if path is None:
        if os.environ.get("PSOTRACK_NO_BROWSER") == "1":
            pytest.skip("PSOTRACK_NO_BROWSER is 1")
        pytest.fail(f"none of {', '.join(NAMES)} is installed; PSOTRACK_NO_BROWSER=1 leaves these tests out")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as programs:
        browser = programs.chromium.launch(executable_path=path, args=arguments)
        try:
            yield browser
        finally:
            browser.close()


@contextlib.contextmanager
def open_page(browser, path, *, width=1600, dark=False, offline=True):
    """A page of a file, without a network; at the end of the block, the page must not have reported any error."""
    context = browser.new_context(
        viewport={"width": width, "height": 900}, color_scheme="dark" if dark else "light", offline=offline
    )
    page = context.new_page()
    errors = []
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: errors.append(f"{error}"))
    page.on("request", lambda request: errors.append(request.url) if request.url.startswith("http") else None)
    page.goto(path.as_uri())
    try:
        yield page
        assert errors == []
    finally:
        context.close()


def screenshot(locator):
    """(height, width, 3), what an element of a page shows, BGR."""
    return cv2.imdecode(np.frombuffer(locator.screenshot(), np.uint8), cv2.IMREAD_COLOR)
