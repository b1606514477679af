"""The page in a real browser: what it shows, says, offers to copy and to download."""

import base64
import contextlib
import functools
import io
import re
import shlex
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from lenses_live import CHROMIUM, KEYS, preset
from PIL import Image

import camtorch as ct
from camtorch.cli.main import main
from camtorch.viewer.viewer import models, page

sync_api = pytest.importorskip("playwright.sync_api")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed here")]

ARGUMENTS = [
    *("--no-sandbox", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
]
IN_SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SECOND = 1000
THEME = Path(__file__).parents[2] / "docs" / "theme"


@pytest.fixture(scope="module")
def browsers():
    with sync_api.sync_playwright() as playwright:
        ways = {"webgl": IN_SOFTWARE, "canvas": ["--disable-gpu"]}
        launch = functools.partial(playwright.chromium.launch, executable_path=CHROMIUM)
        launched = {way: launch(args=ARGUMENTS + more) for way, more in ways.items()}
        yield launched
        for each in launched.values():
            each.close()


@pytest.fixture
def opened(browsers, tmp_path):
    """Opens a page of a camera, or of presets; it fails for requests to elsewhere and for errors in the page."""
    trouble, contexts = [], []

    def show(camera=None, image=None, address="#", draw="canvas", **options):
        path = tmp_path / "viewer.html"
        path.write_text(page(camera, image), encoding="utf-8")
        contexts.append(browsers[draw].new_context(**options))
        tab = contexts[-1].new_page()
        tab.set_default_timeout(20 * SECOND)
        tab.on("request", lambda r: r.url.startswith(("file:", "data:", "blob:")) or trouble.append(r.url))
        tab.on("pageerror", lambda error: trouble.append(str(error)))
        tab.on("console", lambda message: message.type == "error" and trouble.append(message.text))
        tab.goto(f"{path.as_uri()}{address}&draw={draw}")
        settled(tab)
        return tab

    yield show
    for context in contexts:
        context.close()
    assert trouble == []


def settled(tab):
    tab.locator("#python").filter(has_text=re.compile(".")).wait_for(state="attached")
    # what was asked for is drawn
    tab.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def fisheye():
    intrinsics = torch.tensor([130.0, 131.0, 159.0, 121.0], dtype=torch.float64)
    return ct.KannalaBrandt(intrinsics, [0.02, -0.01, 0.003, -0.001], image_size=(240, 320))


def photograph(path, height=240, width=320):
    v, u = np.mgrid[:height, :width].astype(float)
    planes = [np.sin(u / 25), np.cos(v / 20), np.sin((u + v) / 30)]
    Image.fromarray((127.5 + 120 * np.stack(planes, -1)).astype(np.uint8)).save(path)


@pytest.mark.parametrize("key", KEYS)
def test_every_model_is_shown_by_its_address(key, opened):
    tab = opened(address=f"#model={key}")
    assert tab.input_value("#model") == key
    assert f"ct.{models()[key]['class']}(" in tab.inner_text("#python")
    assert tab.inner_text("#message") == ""
    # every file that it offers is that camera
    camera = preset(key)
    files = tab.evaluate("() => Object.keys(Viewer.FORMATS).map(Viewer.file).filter(Boolean)")
    assert files
    for name, text in files:
        loaded = read(name, text)
        assert (type(loaded), loaded.image_size) == (type(camera), camera.image_size)
        torch.testing.assert_close(loaded.intrinsics.detach(), camera.intrinsics.detach(), rtol=0, atol=1e-11)
        torch.testing.assert_close(loaded.distortion.detach(), camera.distortion.detach(), rtol=0, atol=0)


def read(name, text):
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / name).write_text(text)
        return ct.load(Path(folder) / name).camera


WAYS = [
    "#view=perspective&fov=90",
    "#view=cylindrical&fov=150&yaw=20&pitch=-10",
    "#view=equirectangular&fov=360",
    "#view=stereographic&fov=170&yaw=-30.5",
    "#view=double_sphere&yaw=15&pitch=5",
]


@pytest.mark.parametrize("renderer", ["webgl", "canvas"])
@pytest.mark.parametrize("way", WAYS)
def test_the_lines_run_and_make_the_image_on_the_right(way, renderer, opened, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    photograph("photo.png")
    tab = opened(fisheye(), address=way, draw=renderer)
    assert tab.evaluate("Viewer.renderer().kind") == renderer
    tab.set_input_files("#file", "photo.png")
    tab.locator("#message").filter(has_text="photo.png: 320 x 240").wait_for()
    settled(tab)
    width, height = tab.evaluate("Viewer.viewSize")
    data = tab.evaluate("Viewer.renderer().canvas.toDataURL('image/png').split(',')[1]")
    shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"), float)
    assert shown.shape == (height, width, 3)

    Image.open("photo.png").save("photo.jpg", quality=100, subsampling=0)
    names = {}
    exec(tab.inner_text("#python"), names)
    made, seen = names["moved"][0].permute(1, 2, 0).double().numpy(), names["warp"].valid_mask()[0, 0].numpy()
    assert seen.mean() > 0.1
    assert names["there"].all()
    # away from the rim of the photograph, where Python blends with the black around it
    inner, edge = seen.copy(), ~seen
    for step in (-12, -8, -4, 4, 8, 12):
        for axis in (0, 1):
            inner &= np.roll(seen, step, axis)
            edge &= np.roll(~seen, step, axis)
    assert np.abs(shown - made)[inner].max() < (12 if renderer == "webgl" else 25)  # the nearest pixel by canvas
    if edge.any():
        assert (np.abs(shown - [84, 92, 97]) < 1.5).all(-1)[edge].mean() > 0.9999


def test_the_command_runs(opened, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tab = opened(fisheye(), address="#view=stereographic&fov=120")
    with tab.expect_download() as found:
        tab.click("#download")
    found.value.save_as(tmp_path / found.value.suggested_filename)
    photograph("photo.jpg")
    program, *words = shlex.split(tab.inner_text("#command"))
    assert program == "camtorch"
    with contextlib.redirect_stdout(io.StringIO()):
        assert not main(words)
    with Image.open("moved.png") as made:
        assert made.size == (640, 480)


def test_a_camera_with_its_photograph_is_what_it_opens_with_and_keys_move_its_labels(opened, tmp_path):
    photograph(tmp_path / "photo.png")
    tab = opened(fisheye(), tmp_path / "photo.png")
    assert tab.input_value("#picture") == "photograph"
    assert "ct.KannalaBrandt([130.0, 131.0, 159.0, 121.0], [0.02, -0.01, 0.003, -0.001], image_size=(240, 320))" in (
        tab.inner_text("#python")
    )
    assert tab.inner_text("#message") == ""
    before = tab.evaluate("Viewer.labels().box")
    tab.focus("#left")
    tab.keyboard.press("ArrowLeft")
    assert tab.evaluate("Viewer.labels().box")[0] == pytest.approx(before[0] - 3.2)


def test_a_surface_of_a_grid_of_its_own_is_what_it_opens_with(opened):
    grid = ct.Splined.with_grid(columns=9, rows=7, fov_x=150)
    camera = fisheye().convert(grid).camera
    tab = opened(camera)
    assert "ct.Splined.with_grid(columns=9, rows=7, fov_x=150, order=3)([130" in tab.inner_text("#python")
    assert tab.input_value("#model") == camera.key
    assert tab.locator("#sliders input[type=range]").count() == 4
    loaded = read(*tab.evaluate("Viewer.file('camtorch (JSON)')"))
    assert type(loaded) is grid
    torch.testing.assert_close(loaded.distortion, camera.distortion, rtol=0, atol=0)


def test_a_photograph_of_another_size_scales_the_lens(opened, tmp_path):
    for name, size in (("double", (480, 640)), ("square", (300, 300))):
        photograph(tmp_path / f"{name}.png", *size)
    tab = opened(fisheye())
    tab.set_input_files("#file", tmp_path / "double.png")
    tab.locator("#message").filter(has_text="was scaled to the photograph's 640 x 480").wait_for()
    settled(tab)
    camera = read(*tab.evaluate("Viewer.file('camtorch (JSON)')"))
    torch.testing.assert_close(camera.intrinsics.detach(), fisheye().resize(480, 640).intrinsics.detach())
    tab.set_input_files("#file", tmp_path / "square.png")
    tab.locator("#message.trouble").filter(has_text="another shape").wait_for()


def test_trouble_is_a_sentence(opened, tmp_path):
    (tmp_path / "notes.jpg").write_text("no image")
    photograph(tmp_path / "whole.jpg")
    (tmp_path / "broken.jpg").write_bytes((tmp_path / "whole.jpg").read_bytes()[:300])
    tab = opened(fisheye())
    for name in ("notes.jpg", "broken.jpg"):
        tab.set_input_files("#file", tmp_path / name)
        tab.locator("#message.trouble").filter(has_text=f"{name}: this file is no image").wait_for()
    tab.evaluate("Viewer.takePhotograph({ size: 1e9 }, 'huge.png')")
    tab.locator("#message.trouble").filter(has_text="huge.png: a file of 1000 MB is more than").wait_for()
    number = tab.get_by_label("fx, as a number")
    number.fill("-3")
    tab.locator("#message.trouble").filter(has_text="Focal lengths must be above 0").wait_for()
    assert tab.inner_text("#python") == "# Focal lengths must be above 0."
    number.fill("130")
    tab.get_by_label("k1, as a number").fill("-1000")
    tab.locator("#message.trouble").filter(has_text=re.compile(r"folds 1.05° from its axis")).wait_for()
    tab.click("#reset")
    settled(tab)
    assert tab.inner_text("#message") == ""


@pytest.mark.parametrize(
    ("address", "text"),
    [
        ("#model=telepathic", "asks for the model telepathic"),
        ("#model=double_sphere&k=1,2,3", "another number of coefficients"),
        ("#model=kannala_brandt&size=0x0", "no size"),
        ("#model=double_sphere&k=-2,0.5", "xi must be above -1"),
        ("#model=double_sphere&k=one,two", "must be finite"),
    ],
)
def test_a_wrong_address_is_told(address, text, opened):
    for camera, image in ((None, None), (fisheye(), np.zeros((240, 320, 3), np.uint8))):
        tab = opened(camera, image, address)
        assert text in tab.inner_text("#message")
        assert tab.locator("#left").bounding_box()["height"] > 50


def test_an_address_puts_nothing_into_the_lines_that_are_copied(opened):
    tab = opened(address="#lens=GoPro%0Aimport os%E2%80%A8%0D<img src=x onerror=alert(1)>&view=constructor&pitch=1e9")
    names = [line for line in tab.locator("#python").text_content().splitlines() if "import os" in line]
    assert [line[0] for line in names] == ["#"]
    assert tab.evaluate("[Viewer.state.projection, Viewer.state.pitch]") == ["perspective", 90]


def test_keys_and_pointers_turn_and_widen(opened):
    tab = opened(fisheye())
    tab.focus("#right")
    for key in ("ArrowRight", "ArrowRight", "ArrowUp", "-"):
        tab.keyboard.press(key)
    settled(tab)
    assert tab.evaluate("[Viewer.state.yaw, Viewer.state.pitch, Viewer.state.fov]") == [10, 5, 110]
    assert "rotation=rotation" in tab.inner_text("#python")
    tab.keyboard.press("0")
    box = tab.locator("#right").bounding_box()
    tab.mouse.move(box["x"] + 50, box["y"] + 50)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 50 + box["width"] / 2, box["y"] + 50)
    tab.mouse.up()
    assert tab.evaluate("Viewer.state.yaw") == pytest.approx(-55, abs=1)
    # the address keeps what is seen
    tab.wait_for_timeout(SECOND / 2)
    assert "yaw=-5" in tab.evaluate("location.hash")


def test_real_lenses_are_found_by_name(opened):
    tab = opened()
    tab.fill("#search", "gopro hero9 wide")
    tab.locator("#found button").first.click()
    settled(tab)
    text = tab.inner_text("#python")
    title = re.search(r"^# (GoPro.*): numbers rounded", text, re.M)[1]
    shown = read(*tab.evaluate("Viewer.file('camtorch (JSON)')"))
    exact = [lens.camera() for lens in ct.lenses.search(title) if lens.name == title]
    rays = torch.nn.functional.normalize(torch.tensor([[0.3, 0.2, 1], [0.5, -0.4, 1.0], [0, 0, 1]]).double(), dim=-1)
    assert min((shown.project(rays)[0] - camera.project(rays)[0]).abs().max() for camera in exact) < 0.5
    tab.fill("#search", "no such lens anywhere")
    tab.locator("#message.trouble").filter(has_text="No lens has all of these words").wait_for()


@pytest.mark.parametrize("options", [{}, {"color_scheme": "dark"}, {"viewport": {"width": 360, "height": 740}}])
def test_the_page_is_accessible_and_a_phone_shows_it_without_scrolling_aside(options, opened):
    tab = opened(fisheye(), bypass_csp=True, **options)
    if "viewport" in options:
        assert tab.evaluate("document.documentElement.scrollWidth") <= 360
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = axe.Axe().run(tab).response
    assert [(v["id"], [n["html"] for n in v["nodes"]]) for v in found["violations"]] == []


def test_where_webgl_is_slow_or_missing_the_canvas_draws(browsers, tmp_path):
    (tmp_path / "viewer.html").write_text(page(fisheye()), encoding="utf-8")
    for browser in browsers.values():  # one has it in software, the other one not at all
        tab = browser.new_page()
        tab.goto((tmp_path / "viewer.html").as_uri())
        settled(tab)
        assert tab.evaluate("Viewer.renderer().kind") == "canvas"
        assert tab.evaluate("Viewer.viewSize") == [640, 480]
        tab.close()


@pytest.mark.parametrize("width", [400, 1280])
def test_frames_of_the_site_show_all_of_their_page(width, browsers):
    css, js = ((THEME / f"site.{kind}").read_text() for kind in ("css", "js"))
    frame = '<iframe class="viewer" src="viewer.html#model=kannala_brandt"></iframe>'
    files = {"viewer.html": page(), "": f'<style>{css}</style><body class="md-typeset">{frame}<script>{js}</script>'}
    tab = browsers["canvas"].new_page(viewport={"width": width, "height": 700})
    for name, body in files.items():
        tab.route(f"http://site/{name}", lambda route, _, body=body: route.fulfill(body=body, content_type="text/html"))
    tab.goto("http://site/")
    inside = tab.frames[1]
    for model in ("kannala_brandt", "brown_conrady", "pinhole"):
        inside.select_option("#model", model)
        settled(inside)
        inside.wait_for_function("document.documentElement.scrollHeight === innerHeight", timeout=5 * SECOND)
        assert inside.evaluate("[...document.querySelectorAll('pre')].every((e) => e.scrollWidth <= e.clientWidth)")
    tab.close()
