# SPDX-License-Identifier: Apache-2.0
"""A browser with the page of a real dashboard, which real messages fill."""

import json
import shutil
import signal

import pytest
from browser import CHROMIUM, OK, STALE_AFTER_S, Instrument, Page

from starpos_testing.lacking import lacks, require
from starpos_testing.nodes import Listener, Process, take_domain


@pytest.fixture(scope="module")
def listener():
    take_domain()
    listener = Listener()
    yield listener
    listener.close()


@pytest.fixture(scope="module")
def node(listener):
    """The dashboard as a process; its address."""
    require("tornado")
    parameters = (
        "port:=0",
        f"stale_after:={STALE_AFTER_S}",
        "rate:=20.0",
        "image_rate:=5.0",
        "image_side:=800",
    )
    process = Process("starpos_dashboard.main", "dashboard", parameters)
    listener.wait_for_state("dashboard: Page", OK)
    yield listener.states["dashboard: Page"].message.split()[-1]
    status, output = process.end(signal.SIGINT, signal.SIGINT)
    assert status == 0 and "Traceback" not in output, output


@pytest.fixture(scope="session")
def driver(tmp_path_factory):
    require("selenium")
    for program, package in (("chromium", "chromium"), ("chromedriver", "chromium-driver")):
        if not shutil.which(program):
            lacks(package)
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for argument in (*CHROMIUM, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    yield driver
    driver.quit()


@pytest.fixture
def page(driver, node, listener):
    """A fresh page of a working instrument; at the end: nothing came from elsewhere, and no error in its console."""
    page = Page(driver, Instrument(listener), node)
    page.instrument.works()
    driver.get_log("performance"), driver.get_log("browser")
    driver.get(node)
    page.shows(status_word="Fix")
    yield page
    # the next test's page remembers nothing
    page.run("localStorage.clear()")
    events = [json.loads(entry["message"])["message"] for entry in driver.get_log("performance")]
    asked = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
    assert asked and all(url.startswith(node + "/") for url in asked), asked
    troubles = [e for e in driver.get_log("browser") if e["level"] in ("SEVERE", "WARNING")]
    # on a busy machine a frame may have aged when the page comes for it
    assert [e for e in troubles if "there is no frame now" not in e["message"]] == []
    assert driver.title == "starpos"
    driver.get("about:blank")
    for publisher in page.instrument.publishers.values():
        listener.node.destroy_publisher(publisher)
