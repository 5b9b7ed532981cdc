"""The page of `deltaco play` in Chromium, on a desktop and on a phone: `make test-browser`."""

import re
import shutil
import socket
import subprocess
import sys
import time

import pytest
from small_policies import save_tiny_policy

playwright = pytest.importorskip("playwright.sync_api", reason="Playwright's Python package is not installed")
pytest.importorskip("gradio", reason="the extra `play` is not installed")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on the path"),
]

TIMEOUT = 90  # s, also on a busy machine
DESKTOP, PHONE = {"width": 1280, "height": 900}, {"width": 390, "height": 844}
VERDICT = "Success|Wrong|Not done|understood"
NOTE = "#result .note"


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The page, served by the command."""
    folder = tmp_path_factory.mktemp("play")
    save_tiny_policy(folder / "policy")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [
        sys.executable,
        "-m",
        "lerobot_deltaco.cli",
        "play",
        str(folder / "policy"),
        "--port",
        str(port),
    ]
    log, end = folder / "log.txt", time.monotonic() + TIMEOUT
    with log.open("w") as output, subprocess.Popen(command, stdout=output, stderr=output) as server:
        try:
            while socket.socket().connect_ex(("127.0.0.1", port)) != 0:
                assert server.poll() is None, log.read_text()
                assert time.monotonic() < end, log.read_text()
                time.sleep(0.1)
            yield f"http://127.0.0.1:{port}"
        finally:
            server.terminate()


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(params=[DESKTOP, PHONE], ids=["desktop", "phone"])
def page(request, browser, address):
    context = browser.new_context(viewport=request.param)
    page = context.new_page()
    page.set_default_timeout(1000 * TIMEOUT)
    page.on("dialog", lambda dialog: pytest.fail(f"a dialog opened: {dialog.message}"))
    page.goto(f"{address}/?task_id=26&seed=7")
    await_text(page, "#scene", "In the scene")
    yield page
    context.close()


def await_text(page, selector, pattern):
    page.wait_for_function(
        "([selector, text]) => new RegExp(text).test(document.querySelector(selector)?.innerText ?? '')",
        arg=[selector, pattern],
    )
    return page.inner_text(selector)


def run_sentence(page, sentence):
    """Types a sentence, presses Enter, and returns the verdict."""
    page.fill("#sentence textarea", sentence)
    page.press("#sentence textarea", "Enter")
    page.wait_for_url(re.compile(r"instruction=" + re.escape(sentence.split()[0])))
    return await_text(page, NOTE, VERDICT)


def has_video(page, number=0):
    page.wait_for_function(f"document.querySelectorAll('#result video')[{number}]?.readyState >= 2")


def is_cut_off(page, name):
    return page.evaluate(f"(e => e.scrollWidth > e.clientWidth + 1)(document.querySelector('{name}'))")


def test_the_result_stands_beside_the_run_button_and_nothing_is_cut_off(page):
    page.click("#run")
    await_text(page, NOTE, VERDICT)
    has_video(page)
    assert page.locator("#result img").count() == 1
    width, height = page.viewport_size.values()
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.wait_for_timeout(1000)  # a phone scrolls to the result
    for name in (NOTE, "#result video", *(["#run"] if width == DESKTOP["width"] else [])):
        box = page.locator(name).bounding_box()
        assert box["y"] >= -1, name
        assert box["y"] + box["height"] <= height, name
    assert not any(is_cut_off(page, name) for name in ("#new_scene", "#record", "#run", "#compare"))


def test_the_verdict_is_about_the_typed_sentence_and_the_address_keeps_it(page):
    text = run_sentence(page, "put the blue goblet into the red one")
    assert "Understood as: " in text
    assert "Only the benchmark's own sentences are judged" in text
    address = page.url.replace("demo_task=26", "demo_task=4")
    page.goto("about:blank")
    page.goto(address)
    run_sentence(page, "put the blue goblet into the red one")  # at once
    page.focus("#seed input")
    page.keyboard.press("Tab")  # changes nothing
    assert "Read “wavey” as “wave”" in run_sentence(page, "wavey at me")
    assert "task_id=26&seed=7&demo_task=4&" in page.url
    page.fill("#sentence textarea", "")
    page.click("#run")
    page.wait_for_selector("text=Type an instruction first")
    assert page.get_by_text("Error", exact=True).count() == 0


def test_a_recorded_demonstration_and_a_typed_sentence_survive_a_new_scene(page):
    page.click("#record")
    page.wait_for_url(re.compile(r"demo_number=[1-9]"))
    kept = re.search(r"demo_task=26&demo_number=\d+", page.url)[0]
    page.fill("#sentence textarea", "wave at me")
    page.click("#new_scene")
    page.wait_for_url(re.compile("instruction=wave"))
    assert kept in page.url


def test_a_new_scene_brings_what_fits_it_and_chips_fill_in_the_sentence(page):
    page.click("#new_scene")
    page.wait_for_url(lambda url: "task_id=26&" not in url or "seed=7&" not in url)
    task = re.search(r"task_id=(\d+)", page.url)[1]
    assert f"demo_task={task}&" in page.url
    page.click("#chips button >> nth=1")
    page.wait_for_function("/^Put it in/.test(document.querySelector('#sentence textarea').value)")


def test_a_click_points_at_an_object(page):
    page.click("#scene_image", position={"x": 60, "y": 70})
    page.wait_for_selector("#scene .pointed span")
    assert re.search(r"inputs=Point\+and\+instruction&point=\d+%2C\d+", page.url)
    ring, image = (page.locator(f"#scene .pointed {name}").bounding_box() for name in ("span", "img"))
    for side, extent, at in (("x", "width", 60), ("y", "height", 70)):
        assert abs(ring[side] + ring[extent] / 2 - image[side] - at) < 2
    page.click("#run")
    await_text(page, NOTE, VERDICT)


def test_the_comparison_is_one_click_and_four_videos(page):
    page.click("#compare")
    await_text(page, NOTE, r"\d of 4 as asked")
    for number in range(4):
        has_video(page, number)
    assert page.locator("#result img").count() == 4
    assert page.locator("#result .pair .wide + figure, #result .pair figure + figure").count() == 4
    width, height = page.viewport_size.values()
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    if width == DESKTOP["width"]:
        box = page.locator("#result").bounding_box()
        assert box["y"] + box["height"] <= height
