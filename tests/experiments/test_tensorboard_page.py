"""What a user sees of a run: the TensorBoard page in a headless Chromium."""

import shutil
import socket
import subprocess
import sys
import time

import codesign
import pytest
import torch

from torchmask.record import Record
from torchmask.tracking import RunLogger

BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--window-size=1600,1200",
]
# All text and all loaded images of the page, also of the parts that its components hide in shadow roots.
LOOK = """
const texts = [], images = [];
const visit = node => {
  if (node.nodeType === Node.TEXT_NODE) texts.push(node.textContent.trim());
  if (node.tagName === 'IMG' && node.complete && node.naturalWidth > 0) images.push([node.naturalWidth, node.src]);
  if (node.tagName === 'STYLE' || node.tagName === 'SCRIPT') return;
  if (node.shadowRoot) node.shadowRoot.childNodes.forEach(visit);
  node.childNodes.forEach(visit);
};
visit(document.body);
return [texts.filter(text => text).join(''), images];
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    assert codesign.main(["codesign", "--smoke", "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def address(run):
    """Of a TensorBoard on a free port of this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-W", "ignore", "-m", "tensorboard.main", "--logdir", run.parent, "--load_fast=false"]
    options = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([*command, "--host=127.0.0.1", f"--port={port}"], **options) as server:
        try:
            for _ in range(240):
                with socket.socket() as probe:
                    if probe.connect_ex(("127.0.0.1", port)) == 0:
                        break
                assert server.poll() is None, "TensorBoard ended"
                time.sleep(0.25)
            yield f"http://127.0.0.1:{port}/"
        finally:
            server.terminate()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for flag in [*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"]:
        options.add_argument(flag)
    browser = webdriver.Chrome(options=options, service=Service(DRIVER))
    yield browser
    browser.quit()


def look(browser, address, page, texts, n_images=0):
    """Open a page and wait until it shows all `texts` and that many images of the run; returns their widths."""
    browser.get("about:blank")  # the pages differ in their fragment alone
    browser.get(f"{address}#{page}")
    for _ in range(120):
        text, images = browser.execute_script(LOOK)
        widths = [width for width, source in images if "blob_key" in source]
        missing = [wanted for wanted in texts if wanted not in text]
        if not missing and len(widths) >= n_images:
            return widths
        time.sleep(0.5)
    pytest.fail(f"the page {page} lacks {missing} or images: it has {len(widths)}")


@pytest.mark.slow
@pytest.mark.skipif(not (BROWSER and DRIVER), reason="needs chromium and chromedriver")
def test_the_page_shows_images_and_scalars_in_their_groups(browser, address):
    look(browser, address, "timeseries", ["tiny/mask", "tiny/full", "design/relative_mse"])
    figures = [
        "figures/comparison",
        "figures/design/mask",
        "figures/observation/mask/mtf",
        "observation/first_frame",
    ]
    widths = look(browser, address, "images", figures, n_images=6)
    assert max(widths) > 500  # figures, at full resolution
    look(browser, address, "images&tagFilter=restoration", ["restoration/object", "tiny/mask", "tiny/full"], n_images=2)
    look(browser, address, "hparams", ["design.fill_factor", "design.method", "summary/score"])
    look(browser, address, "text", ["run/config", "run/environment", "comparison/table", "restoration/cost"])


def test_a_long_run_stays_far_below_20_mb(tmp_path):
    """Two restorations of 1000 iterations, with images that do not compress; the figures of a run add some 1.5 MB."""
    with RunLogger(tmp_path / "long", seed=0) as log:
        for stage in ("restoration/mask", "restoration/full"):
            for step in range(1, 1001):
                log(Record(stage, step, 1000, {"cost": 1.0 / step}, {"object": torch.rand(256, 256)}))
    assert 1e5 < sum(path.stat().st_size for path in (tmp_path / "long").rglob("events*")) < 5e6
