"""No page of this server breaks its own content policy, and the contract's page needs no other server."""

from typing import Any

import pytest
from playwright.sync_api import Browser

pytestmark = pytest.mark.browser


def test_the_contract_is_shown_without_a_network_and_within_its_policy(town: Any, browser: Browser) -> None:
    page = browser.new_page()
    said: list[str] = []
    elsewhere: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: elsewhere.append(request.url) if not request.url.startswith(town.url) else None)
    page.goto(f"{town.url}/docs")
    page.get_by_text("Locate a window anywhere in a building").first.wait_for(timeout=60_000)
    page.get_by_text("Locate a window anywhere in a building").first.click()
    page.get_by_role("button", name="Try it out").first.wait_for(timeout=60_000)
    assert [each for each in elsewhere if not each.startswith(("data:", "blob:"))] == []
    assert [each for each in said if "Content Security Policy" in each or "Refused" in each] == []
    page.close()


def test_the_pages_of_the_viewer_keep_to_their_policy(town: Any, browser: Browser) -> None:
    page = browser.new_page()
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.goto(f"{town.url}/view/")
    page.get_by_label("API key").or_(page.locator("input[name=key]")).first.fill(town.key)
    page.keyboard.press("Enter")
    page.wait_for_url(f"{town.url}/view/**")
    page.locator("iframe").first.wait_for(timeout=60_000)
    page.wait_for_timeout(2000)
    assert [each for each in said if "Content Security Policy" in each or "Content-Security-Policy" in each] == []
    page.close()
