# SPDX-License-Identifier: Apache-2.0
"""An INDI driver (standard input and output) whose camera answers each exposure as STARPOS_LIES has it (JSON).

cut: bytes that the BLOB lacks; format; size: what it claims; header: cards of the FITS; exposure: a
state instead of a frame; connect: the state that connecting ends in.
"""

import base64
import io
import json
import os
import sys
import xml.etree.ElementTree as ET
from datetime import datetime, timezone

import numpy as np
from astropy.io import fits

LIES = json.loads(os.environ.get("STARPOS_LIES", "{}"))
DEVICE = "Liar"
PIXELS = np.arange(48, dtype=np.uint16).reshape(6, 8)


def say(text):
    sys.stdout.write(text)
    sys.stdout.flush()


def define(kind, name, members, perm="rw", state="Idle"):
    limits = ' format="%g" min="0" max="100" step="0"' if kind == "Number" else ""
    inner = "".join(f'<def{kind} name="{m}"{limits}>{v}</def{kind}>' for m, v in members.items())
    rule = ' rule="OneOfMany"' if kind == "Switch" else ""
    say(
        f'<def{kind}Vector device="{DEVICE}" name="{name}" state="{state}" perm="{perm}"{rule}>{inner}</def{kind}Vector>'
    )


def put(kind, name, state, **members):
    inner = "".join(f'<one{kind} name="{m}">{v}</one{kind}>' for m, v in members.items())
    say(f'<set{kind}Vector device="{DEVICE}" name="{name}" state="{state}">{inner}</set{kind}Vector>')


def define_all(connected):
    define("Switch", "CONNECTION", {"CONNECT": "On" if connected else "Off"})
    if connected:
        define("Number", "CCD_INFO", {"CCD_MAX_X": "8", "CCD_MAX_Y": "6"}, "ro")
        define("Number", "CCD_EXPOSURE", {"CCD_EXPOSURE_VALUE": "1"})
        define("BLOB", "CCD1", {"CCD1": ""}, "ro")


def connect() -> bool:
    """Whether it has worked."""
    if state := LIES.get("connect"):
        say(f'<message device="{DEVICE}" message="[ERROR] no camera on the bus"/>')
        put("Switch", "CONNECTION", state, CONNECT="Off")
        return False
    define_all(True)
    put("Switch", "CONNECTION", "Ok", CONNECT="On")
    return True


def expose(seconds):
    put("Number", "CCD_EXPOSURE", "Busy", CCD_EXPOSURE_VALUE=seconds)
    if state := LIES.get("exposure"):
        say(f'<message device="{DEVICE}" message="[ERROR] the shutter is stuck"/>')
        put("Number", "CCD_EXPOSURE", state, CCD_EXPOSURE_VALUE=0)
        return
    now = datetime.now(timezone.utc).isoformat()[:23]
    header = fits.Header({"DATE-OBS": now, "EXPTIME": float(seconds), **LIES.get("header", {})})
    file = io.BytesIO()
    fits.PrimaryHDU(PIXELS, header).writeto(file)
    data = file.getvalue()
    size = LIES.get("size", len(data))
    data = base64.encodebytes(data[: len(data) - LIES.get("cut", 0)]).decode()
    blob = f'<oneBLOB name="CCD1" size="{size}" format="{LIES.get("format", ".fits")}">\n{data}</oneBLOB>'
    say(f'<setBLOBVector device="{DEVICE}" name="CCD1" state="Ok">{blob}</setBLOBVector>')
    put("Number", "CCD_EXPOSURE", "Ok", CCD_EXPOSURE_VALUE=0)


def serve():
    parser, depth, connected = ET.XMLPullParser(("start", "end")), 0, False
    parser.feed("<commands>")
    while data := os.read(0, 4096):
        parser.feed(data)
        for event, element in parser.read_events():
            depth += 1 if event == "start" else -1
            if event == "start" or depth != 1:
                continue
            if element.tag == "getProperties":
                define_all(connected)
            elif element.get("name") == "CONNECTION":
                connected = connect()
            elif element.get("name") == "CCD_EXPOSURE":
                expose(element[0].text)


if __name__ == "__main__":
    serve()
