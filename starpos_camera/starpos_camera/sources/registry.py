# SPDX-License-Identifier: Apache-2.0
"""The sources by their name in the parameter `source`. A new camera needs a module in this folder and a line below."""

from starpos_camera.sources.alpaca import Alpaca
from starpos_camera.sources.aravis import Aravis
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
    "aravis": Aravis,
    "gphoto2": Gphoto2,
    "indi": Indi,
    "video": Video,
}
