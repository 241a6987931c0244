import io
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import gantry
import numpy as np
import pytest
from PIL import Image

from cgs_jax import viewer
from cgs_jax.errors import InputError
from cgs_jax.samples import SampleSet

PORT = 8470


def gantry_samples(count=12):
    qpos, t, _ = gantry.valid(count)
    made = vars(gantry.sample_set(qpos, t))
    violation = np.random.default_rng(0).uniform(1e-6, 9e-5, (count, 3))
    names = ("Kin(t,q_1)", "Kin(t,q_2)", "Collision(q_2)")
    return SampleSet(**{**made, "violation": violation, "constraints": names})


@pytest.fixture(scope="module")
def samples():
    return gantry_samples()


@pytest.fixture
def page(samples):
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    page = viewer.WebViewer(samples, port=PORT)
    yield page
    page.stop()


def until(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "no answer in time"
        time.sleep(0.05)


# ---------------------------------------------------------------------------------------------------------------------
# Without a browser


@pytest.mark.parametrize("radius, half", [(0.06, 0.2), (0.1, 0.0)])
def test_capsule_mesh_has_the_capsules_size_and_volume_and_looks_outwards(radius, half):
    vertices, triangles = viewer.capsule_mesh(radius, half, rings=24, sides=64)
    np.testing.assert_allclose(vertices.max(axis=0), [radius, radius, half + radius], rtol=1e-9)
    np.testing.assert_allclose(vertices.min(axis=0), [-radius, -radius, -half - radius], rtol=1e-9)
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    volume = np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6
    exact = np.pi * radius**2 * (2 * half + 4 / 3 * radius)
    assert exact * 0.98 < volume < exact


def test_text_names_the_worst_constraint(samples):
    for index in range(len(samples)):
        text = viewer.describe(samples, index)
        worst = samples.violation[index].argmax()
        assert f"**{samples.violation[index, worst]:.1e}** in **{samples.constraints[worst]}**" in text
        assert f"**sample {index}**" in text and samples.sequences[index % 2] in text
    bare = SampleSet(**{**vars(samples), "violation": np.zeros((len(samples), 0)), "constraints": ()})
    assert "no violation recorded" in viewer.describe(bare, 0)


def test_without_viser_one_line_names_the_extra(samples, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r'needs the package viser.*-e "\.\[viewer\]"$') as error:
        viewer.WebViewer(samples)
    assert "\n" not in str(error.value)


def test_wrong_choices_say_what_there_is(samples):
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    for arguments, words in (
        ({"indices": [12]}, "0 to 11"),
        ({"switch": "lift"}, "pick, place"),
        ({"port": 0}, "1 to 65535"),
        ({"host": "no.such.host.invalid"}, "cannot serve"),
    ):
        with pytest.raises(InputError, match=words) as error:
            viewer.WebViewer(samples, **arguments)
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="no samples"):
        viewer.WebViewer(samples.select([]))


def test_page_shows_mujocos_poses_and_prints_nothing(samples, capsys):
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    page = viewer.WebViewer(samples, [5, 2], "place", port=PORT)
    try:
        assert (page.sample, page.switch) == (5, "place")
        gripper = gantry.gripper(samples.qpos[5, 1, :5])
        np.testing.assert_allclose(page.body_pose("gantry")[:3], gripper[0], atol=1e-9)
        # The site is turned half about x against its body.
        body = gantry.product(gripper[1], gantry.inverse(np.array([0.0, 1.0, 0, 0])))
        assert abs(page.body_pose("gantry")[3:] @ body) == pytest.approx(1, abs=1e-9)
        np.testing.assert_allclose(page.body_pose("box"), samples.qpos[5, 1, 5:], atol=1e-9)
        with pytest.raises(InputError, match="no body"):
            page.body_pose("table")
    finally:
        page.stop()
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err == ""


def test_two_pages_find_two_ports(page, samples):
    other = viewer.WebViewer(samples, port=PORT)
    other.stop()
    assert other.url != page.url


# ---------------------------------------------------------------------------------------------------------------------
# In a browser without a display


def open_browser():
    selenium = pytest.importorskip("selenium", reason="selenium is not installed")
    binary = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("no chromium with its chromedriver on this machine")
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--window-size=760,640",
        "--no-first-run",
    ):
        options.add_argument(argument)
    try:
        return webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    except selenium.common.exceptions.WebDriverException as error:
        pytest.skip(f"chromium does not start: {str(error).splitlines()[0]}")


def test_clicking_through_the_page_in_a_browser(page, samples):
    browser = open_browser()
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    def all_of(selector):
        return browser.find_elements(By.CSS_SELECTOR, selector)

    def text():
        return browser.find_element(By.TAG_NAME, "body").text

    def field(label):
        """The input that the label points at."""
        name = browser.find_element(By.XPATH, f"//label[normalize-space()='{label}']").get_attribute("for")
        return browser.find_element(By.ID, name)

    def slide(which, arrived):
        """Presses the right arrow until the page has moved: a key that comes before the page listens is lost."""
        for _ in range(10):
            all_of("[role=slider]")[which].send_keys(Keys.ARROW_RIGHT)
            try:
                return until(arrived, 5)
            except AssertionError:
                continue
        until(arrived)

    def worst(index):
        column = samples.violation[index].argmax()
        return f"worst violation {samples.violation[index, column]:.1e} in {samples.constraints[column]}"

    try:
        browser.get(page.url)
        until(lambda: len(all_of("[role=slider]")) == 2)
        until(lambda: "sample 0" in text() and worst(0) in text())

        # Sliders: two samples on, one mode switch on. The page and the file agree on the box.
        slide(0, lambda: page.sample == 1)
        slide(0, lambda: page.sample == 2)
        slide(1, lambda: page.switch == "place")
        until(lambda: "sample 2" in text() and worst(2) in text())
        np.testing.assert_allclose(page.body_pose("box"), samples.qpos[2, 1, 5:], atol=1e-9)

        # One sequence only: every second sample; the shown one, which is among them, stays.
        field("Sequence").click()
        option = "//*[@role='option'][starts-with(normalize-space(), 't; q_1; q_2 (6)')]"
        until(lambda: any(element.is_displayed() for element in browser.find_elements(By.XPATH, option)))
        browser.find_element(By.XPATH, option).click()
        until(lambda: page.offered.tolist() == [0, 2, 4, 6, 8, 10])
        until(lambda: page.sample == 2 and "2 of 6" in text())
        all_of("[role=slider]")[0].send_keys(Keys.END)
        until(lambda: page.sample == 10 and worst(10) in text())

        # The most diverse of these, by the sample set's own order.
        count = field("How many")
        count.send_keys(Keys.CONTROL, "a")
        count.send_keys("4", Keys.TAB)
        field("Diverse only").click()
        mine = np.arange(0, 12, 2)
        until(lambda: page.offered.tolist() == mine[samples.select(mine).diverse(4)].tolist())
        until(lambda: "of 4" in text() and worst(page.sample) in text())

        # The scene is drawn, and nothing went wrong in the page.
        canvas = max(all_of("canvas"), key=lambda element: element.size["width"])

        def colours():
            pixels = np.asarray(Image.open(io.BytesIO(canvas.screenshot_as_png)).convert("RGB"))
            return len(np.unique(pixels.reshape(-1, 3), axis=0))

        until(lambda: colours() > 50)
        assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    finally:
        browser.quit()


# ---------------------------------------------------------------------------------------------------------------------
# MuJoCo's own viewer


def test_without_a_display_one_line_says_so(samples, monkeypatch):
    if not sys.platform.startswith("linux"):
        pytest.skip("a missing display is a matter of Linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match="needs a display") as error:
        viewer.MujocoWindow(samples)
    assert "\n" not in str(error.value) and "--view" in str(error.value)


WINDOW = """
import sys, threading
sys.path[:0] = sys.argv[1:3]
import test_viewer
from cgs_jax import viewer
samples = test_viewer.gantry_samples()
window = viewer.MujocoWindow(samples, [3, 4, 5], "place")
assert window.is_open()
for key in (262, 262, 262, 263, 265):
    window._press(key)
threading.Timer(1.0, window._handle.close).start()
window.run()
print(abs(window._data.qpos - samples.qpos[4, 0]).max(), window.is_open())
"""


def test_mujocos_viewer_opens_on_a_virtual_display_and_closes_cleanly():
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb is not installed")
    number = next(n for n in range(90, 200) if not Path(f"/tmp/.X{n}-lock").exists())
    screen = subprocess.Popen(
        ["Xvfb", f":{number}", "-screen", "0", "640x480x24"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        until(lambda: Path(f"/tmp/.X11-unix/X{number}").exists(), 10)
        folder = Path(__file__).parent
        kept = {key: value for key, value in os.environ.items() if key not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
        done = subprocess.run(
            [sys.executable, "-c", WINDOW, str(folder), str(folder.parent)],
            env=kept | {"DISPLAY": f":{number}"},
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.split() == ["0.0", "False"]
    finally:
        screen.terminate()
        screen.wait(10)
