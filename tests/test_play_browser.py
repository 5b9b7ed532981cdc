"""The page in a real browser: `make test-browser`, with Playwright and the system's Chromium."""

import re
import shutil
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest
from test_play import DATASET_TASKS, DEMONSTRATED, save_policy, write_dataset

from lerobot_deltaco.policy.language.encoder_names import MINILM_L3

playwright = pytest.importorskip("playwright.sync_api", reason="Playwright's Python package is not installed")
pytest.importorskip("gradio", reason="the extra `play` is not installed")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on the path"),
]

TIMEOUT = 90  # s, also on a busy machine
STANDS_WITHIN = 60  # s; a few seconds on an idle machine


def free_port():
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("play")
    save_policy(folder / "policy", demo_encoder="correspondence", language_encoder=MINILM_L3)
    dropouts = {"demo_dropout": 0.3, "instruction_dropout": 0.3}
    save_policy(folder / "either", demo_encoder="correspondence", language_encoder=MINILM_L3, **dropouts)
    write_dataset(folder / "dataset")
    broken = shutil.copytree(folder / "policy", folder / "broken")
    (broken / "model.safetensors").write_bytes(b"nothing")
    return folder


@pytest.fixture(scope="module")
def address(folder):
    """The page, served by the command."""
    port = free_port()
    arguments = [
        "--checkpoint",
        str(folder / "policy"),
        "--allow",
        str(folder),
        "--port",
        str(port),
        "--no-hub",
    ]
    command = [sys.executable, "-m", "lerobot_deltaco.commands.play", *arguments]
    log = folder / "log.txt"
    start = time.monotonic()
    with log.open("w") as output, subprocess.Popen(command, stdout=output, stderr=output) as server:
        try:
            while True:
                assert server.poll() is None, log.read_text()
                assert time.monotonic() - start < TIMEOUT, log.read_text()
                with socket.socket() as client:
                    if client.connect_ex(("127.0.0.1", port)) == 0:
                        break
                time.sleep(0.1)
            assert time.monotonic() - start < STANDS_WITHIN
            yield f"http://127.0.0.1:{port}"
        finally:
            server.terminate()


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


class User:
    """Someone who looks at the page."""

    def __init__(self, page):
        self.page = page

    def read(self, name):
        return self.page.input_value(f"#{name} :is(textarea, input)")

    def press(self, name):
        self.page.click(f"#{name}")

    def write(self, name, text):
        self.page.fill(f"#{name} :is(textarea, input)", text)

    def await_text(self, name, pattern):
        """Waits until a field has a text, and returns what was found in it."""
        self.page.wait_for_function(
            "([name, pattern]) => new RegExp(pattern)"
            ".test(document.querySelector(`#${name} :is(textarea, input)`)?.value ?? '')",
            arg=[name, pattern],
        )
        return re.search(pattern, self.read(name))

    def source(self, name):
        return self.page.get_attribute(f"#{name} img", "src")


@contextmanager
def visiting(browser, address):
    context = browser.new_context(viewport={"width": 1300, "height": 1500})
    page = context.new_page()
    page.set_default_timeout(1000 * TIMEOUT)
    page.on("dialog", lambda dialog: pytest.fail(f"a dialog opened: {dialog.message}"))
    page.goto(address)
    user = User(page)
    user.await_text("status", "^Ready")
    user.await_text("sentence", ".")
    try:
        yield user
    finally:
        context.close()


@pytest.fixture
def user(browser, address):
    with visiting(browser, address) as user:
        yield user


OVER = "(S|No s)uccess"


def test_a_run_and_a_swap_stand_side_by_side(user):
    user.press("run")
    user.await_text("latest_text", OVER)
    assert user.source("latest_view")
    first = user.read("latest_text")
    user.press("swap_demo")
    user.await_text("earlier_text", OVER)
    user.await_text("latest_text", OVER)
    assert user.read("earlier_text") == first
    demonstrations = [
        re.search("Demonstration: (.*) \\(", user.read(name))[1] for name in ("earlier_text", "latest_text")
    ]
    assert demonstrations[0] != demonstrations[1]
    assert set(demonstrations) <= set(DEMONSTRATED)
    sentence = user.read("sentence")
    user.press("swap_sentence")
    user.await_text("latest_text", "Instruction: (?!" + re.escape(sentence) + ")[\\s\\S]*uccess")
    assert f"Instruction: {sentence}\n" in user.read("earlier_text")


def test_the_experts_episode_is_used_as_the_demonstration(user):
    user.press("expert")
    user.await_text("latest_text", "Expert. " + OVER)
    user.press("use")
    user.await_text("shown", "by the expert")


def test_what_is_being_written_is_not_overwritten(user):
    user.press("expert")
    user.write("sentence", "what I write")
    user.await_text("latest_text", "Expert. " + OVER)
    user.press("use")
    user.await_text("shown", "by the expert")
    assert user.read("sentence") == "what I write"


def await_video(user):
    """Waits until the video of the demonstration can be played, and returns its length in seconds."""
    user.page.wait_for_function("document.querySelector('#video video')?.readyState >= 2")
    return user.page.evaluate("document.querySelector('#video video').duration")


def test_the_experts_demonstration_is_a_video_and_a_checkpoints_is_not(user):
    assert "a checkpoint keeps only 2 images" in user.read("no_video")
    assert user.page.locator("#video video").count() == 0
    user.press("expert")
    user.await_text("latest_text", "Expert. " + OVER)
    user.press("use")
    user.await_text("shown", "by the expert")
    assert await_video(user) > 1
    assert not user.page.locator("#no_video").is_visible()


def test_the_episodes_of_a_dataset_are_shown_and_used(user, folder):
    user.page.click("text=Another dataset of demonstrations")
    user.write("dataset", str(folder / "policy"))
    user.press("load_dataset")
    user.await_text("message", "not a LeRobotDataset: meta/info.json is missing")
    user.write("dataset", str(folder / "dataset"))
    user.press("load_dataset")
    shown = user.await_text("shown", r"^(.*) \(1 of \d in .*dataset\)$")[1]
    assert shown in DATASET_TASKS
    assert await_video(user) > 1
    user.press("run")
    user.await_text("latest_text", OVER)
    assert f"Demonstration: {shown} (1 of" in user.read("latest_text")


def test_one_of_the_two_can_be_left_out_if_that_was_learned(user, folder):
    assert user.page.locator("#modality input").count() == 1
    assert user.page.locator("#modality input").is_disabled()
    assert "has not learned to do without either" in user.page.inner_text("#modality")
    user.page.click("text=Another checkpoint")
    user.write("checkpoint", str(folder / "either"))
    user.press("load")
    user.await_text("status", "either")
    user.write("sentence", "")
    user.page.click("#modality >> text=demonstration alone")
    user.press("run")
    user.await_text("latest_text", "Instruction: left out[\\s\\S]*uccess")
    user.page.click("#modality >> text=instruction alone")
    user.write("sentence", "go there")
    user.press("run")
    user.await_text("latest_text", "Instruction: go there\\nDemonstration: left out[\\s\\S]*uccess")


def test_a_bad_sentence_gets_a_message_and_markup_stays_text(user):
    user.write("sentence", "   ")
    user.press("run")
    user.await_text("message", "The instruction is empty")
    markup = "<img src=x onerror=alert(1)><script>alert(2)</script>"
    user.write("sentence", markup)
    user.press("run")
    user.await_text("latest_text", OVER)
    assert markup in user.read("latest_text")
    assert user.page.locator("img[src=x]").count() == 0


def test_a_broken_checkpoint_gets_a_message_and_the_page_goes_on(user, folder):
    user.page.click("text=Another checkpoint")
    for name, message in (
        (str(folder / "broken"), "cannot be loaded"),
        ("/etc", "'/etc' that this page may load"),
        ("USER/NAME", "'USER/NAME' that this page may load"),
    ):
        user.write("checkpoint", name)
        user.press("load")
        user.await_text("message", message)
    assert str(folder / "policy") in user.read("status")
    user.press("run")
    user.await_text("latest_text", OVER)


def test_two_users_at_a_time_see_their_own_runs(browser, address):
    with visiting(browser, address) as one, visiting(browser, address) as other:
        for user, sentence in ((one, "first sentence"), (other, "second sentence")):
            user.write("sentence", sentence)
            user.press("run")
        for user, sentence in ((one, "first sentence"), (other, "second sentence")):
            user.await_text("latest_text", OVER)
            assert f"Instruction: {sentence}\n" in user.read("latest_text")


def test_files_of_the_machine_are_not_served(user, address):
    for path in ("/etc/passwd", str(__file__)):
        response = user.page.request.get(f"{address}/gradio_api/file={path}")
        assert response.status in (403, 404)
