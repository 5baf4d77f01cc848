# SPDX-License-Identifier: Apache-2.0
import starpos.instrument.instrument_file
from starpos.averaging.average import Average as Average
from starpos.averaging.average import average as average
from starpos.calibration.camera import calibrate_camera as calibrate_camera
from starpos.calibration.misalignment import calibrate_at as calibrate_at
from starpos.calibration.misalignment import turn as turn
from starpos.detection import Detection as Detection
from starpos.detection import detect as detect
from starpos.earth.place import Place as Place
from starpos.earth.refraction import Atmosphere as Atmosphere
from starpos.earth.vertical import Deflection as Deflection
from starpos.earth.vertical import geodetic as geodetic
from starpos.errors import StarposError as StarposError
from starpos.fix.fix import Fix as Fix
from starpos.fix.fix import InDegrees as InDegrees
from starpos.fix.fix import PlaceFix as PlaceFix
from starpos.fix.solution import Solution as Solution
from starpos.fix.solution import Status as Status
from starpos.fix.solver import Solver as Solver
from starpos.frames.frame import Frame as Frame
from starpos.frames.frame import Stars as Stars
from starpos.frames.reading import read_frame as read_frame
from starpos.gnss.receiver import GnssTrack as GnssTrack
from starpos.gnss.receiver import read_gnss_csv as read_gnss_csv
from starpos.instrument.camera import Camera as Camera
from starpos.instrument.inclinometer import Tilt as Tilt
from starpos.instrument.instrument import Calibration as Calibration
from starpos.instrument.instrument import Instrument as Instrument
from starpos.instrument.tilt_log import TiltLog as TiltLog
from starpos.instrument.tilt_table import read_tilt_csv as read_tilt_csv
from starpos.navigation.estimate import VoyageFix as VoyageFix
from starpos.navigation.voyage import Voyage as Voyage
from starpos.night.at_mark import deflection as deflection
from starpos.night.by_satellites import locate as locate
from starpos.night.night import Night as Night
from starpos.night.night import Shot as Shot
from starpos.night.opening import NightOnDisk as NightOnDisk
from starpos.night.opening import open_night as open_night
from starpos.night.together import sights as sights
from starpos.night.under_way import navigate as navigate
from starpos.night.work import identify as identify
from starpos.satellites.locating import SatelliteFix as SatelliteFix
from starpos.session.replay import PlayedNight as PlayedNight
from starpos.session.replay import replay as replay
from starpos.simulation.scene import scene_of as scene_of
from starpos.simulation.scene import write_night as write_night
from starpos.sky.catalogue import Catalogue as Catalogue
from starpos.sky.catalogue import load_catalogue as load_catalogue
from starpos.sky.site import Site as Site
from starpos.zenith.adjustment import DeflectionSession as DeflectionSession

read_instrument = starpos.instrument.instrument_file.read
write_instrument = starpos.instrument.instrument_file.write

__version__: str
__all__: list[str]
