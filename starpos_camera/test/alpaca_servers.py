# SPDX-License-Identifier: Apache-2.0
"""Alpaca servers for tests: the simulators of PyPI's alpaca-simulators, and one that says whatever a test asks for."""

import json
import socket
import sqlite3
import struct
import subprocess
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import yaml

from starpos_testing.lacking import require

WIDTH, HEIGHT = 64, 48
# Where an asymmetric picture has its light; it is black elsewhere.
TOP_ROW, LEFT_COLUMN = 1.0, 0.25


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Simulator:
    """Cameras 0 (monochrome), 1 (Bayer, offset 1 in x) and 2 (colour), which look at a sky of their own: no network."""

    def __init__(self, folder: Path):
        require("alpaca", "alpaca_simulators")
        import alpaca_simulators

        template = Path(alpaca_simulators.__file__).parent / "config" / "template.yaml"
        config = yaml.safe_load(template.read_text(encoding="utf-8"))
        light = np.zeros((HEIGHT, WIDTH))
        light[0], light[1:, 0] = TOP_ROW, LEFT_COLUMN
        camera = config["devices"]["camera"][0] | {
            "cameraxsize": WIDTH,
            "cameraysize": HEIGHT,
            "numx": WIDTH,
            "numy": HEIGHT,
            "pixel_defects": {"picture": {"type": "light_distribution", "distribution_map": light.tolist()}},
        }
        devices = config["devices"]
        config["devices"] = {name: devices[name] for name in ("telescope", "focuser")} | {
            "camera": {
                0: camera,
                1: camera | {"sensortype": 2, "bayeroffsetx": 1},
                2: camera | {"sensortype": 1},
            }
        }
        config["devices"]["telescope"][0] |= {"declination": 89.0, "focallength": 0.05, "tracking": False}
        # Gaia is asked over the network otherwise.
        config["tap_source"] = str(folder / "sky.sqlite")
        # Without a star the simulator's sky has no light.
        with sqlite3.connect(config["tap_source"]) as sky:
            sky.execute("CREATE TABLE gaia_sources (ra REAL, dec REAL, phot_g_mean_mag REAL)")
            places = ((float(ra), 87.0 + ra % 3) for ra in range(360))
            sky.executemany("INSERT INTO gaia_sources VALUES (?, ?, 12.0)", places)
        self._config = folder / "simulators.yaml"
        self._config.write_text(yaml.safe_dump(config), encoding="utf-8")
        self._port = free_port()
        self.address = f"127.0.0.1:{self._port}"
        self._process = None

    def start(self):
        options = ["--host", "127.0.0.1", "--port", str(self._port), "--config", str(self._config)]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "alpaca_simulators.run_simulator", *options],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        log = []
        while not log or "Uvicorn running" not in log[-1]:
            log.append(self._process.stderr.readline())
            assert log[-1], "".join(log)
        # A full pipe would stop it.
        self._reader = threading.Thread(target=self._process.stderr.read)
        self._reader.start()

    def kill(self):
        if self._process:
            self._process.kill()
            self._process.wait()
            self._reader.join()
            self._process.stderr.close()
            self._process = None

    def client(self, number: int = 0):
        """Another program that uses the camera."""
        from alpaca.camera import Camera

        return Camera(self.address, number)


def image_bytes(pixels: np.ndarray, sent_as: int, **changes) -> bytes:
    """A picture as ImageBytes; `pixels` (height, width) of the type that `sent_as` names."""
    height, width = pixels.shape
    head = {"version": 1, "error": 0, "client": 0, "server": 0, "begin": 44, "element": 2, "sent_as": sent_as}
    head |= {"rank": 2, "columns": width, "rows": height, "planes": 0}
    return struct.pack("<11i", *(head | changes).values()) + np.ascontiguousarray(pixels.T).tobytes()


class Liar:
    """A server that takes pictures, until a test sets other answers.

    values   by the member's name in small letters; a function is called for the value
    answers  by the same name: functions that answer the request by themselves
    picture  bytes, of the content type `kind`
    """

    def __init__(self):
        self.values = {
            "connected": False,
            "camerastate": lambda: 0 if time.time() > self.started_s + self.exposure_s else 2,
            "cameraxsize": WIDTH,
            "cameraysize": HEIGHT,
            "sensortype": 0,
            "imageready": lambda: time.time() > self.started_s + self.exposure_s,
            "gain": 0,
        }
        self.started_s = self.exposure_s = 0.0
        self.picture = image_bytes(np.zeros((HEIGHT, WIDTH), np.uint16), 8)
        self.kind = "application/imagebytes"
        self.answers = {}
        self.asked = []
        liar = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            # Header and body in one packet: the second waits for an acknowledgement.
            wbufsize = -1

            def log_message(self, *_):
                """Not on standard error."""

            def do_GET(self):
                member = urlsplit(self.path).path.rsplit("/", 1)[1]
                liar.asked.append(member)
                if member in liar.answers:
                    return liar.answers[member](self)
                if member == "imagearray":
                    return self.answer(liar.picture, liar.kind)
                if member not in liar.values:
                    return self._json({"ErrorNumber": 0x400, "ErrorMessage": f"{member} is not implemented"})
                value = liar.values[member]
                value = value() if callable(value) else value
                return self._json({"Value": value, "ErrorNumber": 0, "ErrorMessage": ""})

            def do_PUT(self):
                member = urlsplit(self.path).path.rsplit("/", 1)[1]
                fields = parse_qs(self.rfile.read(int(self.headers["Content-Length"])).decode())
                given = {key.lower(): value[0] for key, value in fields.items()}
                if member == "gain":
                    liar.values["gain"] = min(100, int(given["gain"]))
                if member == "connected":
                    liar.values["connected"] = given["connected"] == "True"
                if member == "startexposure":
                    liar.started_s, liar.exposure_s = time.time(), float(given["duration"])
                self._json({"ErrorNumber": 0, "ErrorMessage": ""})

            def _json(self, reply):
                self.answer(json.dumps(reply).encode(), "application/json")

            def answer(self, body, kind):
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        # Its client hangs up on it.
        self._server.handle_error = lambda *_: None
        self.address = f"127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))
        self._thread.start()

    def close(self):
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
