# SPDX-License-Identifier: Apache-2.0
"""The sources by the name that the parameter `source` gives them."""

from starpos_camera.sources.alpaca import Alpaca
from starpos_camera.sources.files import Files
from starpos_camera.sources.gphoto2 import Gphoto2
from starpos_camera.sources.indi import Indi
from starpos_camera.sources.simulated import Simulated
from starpos_camera.sources.source import FrameSource
from starpos_camera.sources.video import Video

SOURCES: dict[str, type[FrameSource]] = {
    "files": Files,
    "simulated": Simulated,
    "alpaca": Alpaca,
    "gphoto2": Gphoto2,
    "indi": Indi,
    "video": Video,
}
