"""The page in a real browser: somebody signs in and sees a field."""

import pytest
from playwright.sync_api import Browser

pytestmark = pytest.mark.browser


def new_page(browser: Browser):
    page = browser.new_page(viewport={"width": 800, "height": 450})
    page.faults = []
    page.on("pageerror", lambda error: page.faults.append(str(error)))
    return page


def test_somebody_signs_in_and_sees_a_field(running, browser):
    page = new_page(browser)
    page.goto(f"{running.url}/view/?floor=floor-0")
    page.get_by_label("API key").fill("wrong")
    page.get_by_role("button", name="Sign in").click()
    assert page.get_by_role("alert").is_visible()
    page.get_by_label("API key").fill("north-key")
    page.get_by_role("button", name="Sign in").click()
    page.locator("#legend .legend-of").first.wait_for()
    assert page.title() == "Isodyn"
    assert page.get_by_label("Magnitude |B|, µT").is_visible()
    assert page.locator("#words").get_by_text("213 m²").is_visible()
    assert page.evaluate("document.cookie") == ""
    page.get_by_role("button", name="Sign out").click()
    page.get_by_label("API key").wait_for()
    assert page.faults == []
    page.close()


def test_the_client_connects_to_no_other_server(running, browser):
    """viser's client would take the address of any server from its own URL; the page's policy forbids it."""
    page = new_page(browser)
    name, _, value = running.cookie("north-key").partition("=")
    page.context.add_cookies([{"name": name, "value": value, "url": f"{running.url}/view"}])
    page.goto(f"{running.url}/view/scene/view-0001")
    refused = page.evaluate(
        """new Promise((tell) => {
          document.addEventListener("securitypolicyviolation", (event) => tell(event.effectiveDirective));
          new WebSocket("ws://127.0.0.1:9/");
        })"""
    )
    assert refused == "connect-src"
    page.close()
